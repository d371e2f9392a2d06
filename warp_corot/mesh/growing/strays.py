"""Strays: cut-off tips of a body that is one piece, which would be pieces of the mesh."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .cut import face_pairs, linked

if TYPE_CHECKING:
    from warp_corot.domain import Domain

#: A piece that holds less than this share of the body is a stray.
STRAY = 1.0e-4
#: Meshes of more elements keep their strays; the search would take long.
MOST_ELEMENTS = 100_000


def strays(tets: np.ndarray, held: np.ndarray, given_up: np.ndarray, domain: Domain) -> np.ndarray:
    """Which elements are strays, bool [n]; none if the body is not known to be one piece.

    Args:
        tets: int32 [n, 4].
        held: Volume that each holds [n].
        given_up: Which are not part of the mesh, bool [n].
        domain: The body.
    """
    found = np.zeros(len(tets), bool)
    closed = getattr(domain.kind, "closed", None)
    if closed is None or closed.pieces > 1 or len(tets) > MOST_ELEMENTS:
        return found
    kept = np.flatnonzero(~given_up)
    piece = linked(face_pairs(tets[kept]), len(kept))
    volumes = np.bincount(piece, held[kept])
    found[kept] = (volumes < STRAY * volumes.sum())[piece]
    return found
