"""The pieces of a mesh."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from warp_corot.mesh.growing.cut import face_pairs, linked


def pieces_of(tets: npt.NDArray[np.integer]) -> npt.NDArray[np.int32]:
    """The piece of each element, int32 [T]; the piece with most elements has the number 0.

    Elements that share a face belong to one piece. Parts that meet only in a node or an edge are different pieces,
    because one can rotate about it.

    Args:
        tets: Nodes of each element [T, 4].
    """
    piece = linked(face_pairs(tets), len(tets))
    rank = np.argsort(np.argsort(-np.bincount(piece), kind="stable"), kind="stable")
    return rank[piece].astype(np.int32)
