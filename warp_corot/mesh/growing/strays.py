"""Strays: cut-off tips of a body that is one piece, which would be pieces of the mesh."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from warp_corot.mesh.pieces import face_pairs, linked

if TYPE_CHECKING:
    from warp_corot.domain import Domain

#: A piece that holds less than this share of the body is a stray.
STRAY = 2.0e-4
#: Meshes of more elements keep their strays; the search would take long.
MOST_ELEMENTS = 100_000
#: Strays that together hold more than this share of the body are named.
NAMED = 1.0e-4


def strays(tets: np.ndarray, held: np.ndarray, given_up: np.ndarray, domain: Domain) -> tuple[np.ndarray, str]:
    """Which elements are strays, bool [n], and a sentence about them, empty if they hold next to nothing. None are if
    the body is not known to be one piece.

    Args:
        tets: int32 [n, 4].
        held: Volume that each holds [n].
        given_up: Which are not part of the mesh, bool [n].
        domain: The body.
    """
    found = np.zeros(len(held), bool)
    if getattr(domain.kind, "closed", None) is None or len(tets) > MOST_ELEMENTS:
        return found, ""
    pairs = face_pairs(tets)
    kept = np.flatnonzero(~given_up)
    _, piece = np.unique(linked(pairs[~given_up[pairs].any(axis=1)], len(held))[kept], return_inverse=True)
    # Parts of a surface that touch or cross are one piece of the body.
    kind: Any = domain.kind
    if not piece.any() or kind.joined[0] > 1:
        return found, ""
    volumes = np.bincount(piece, held[kept])
    stray = volumes < STRAY * volumes.sum()
    found[kept] = stray[piece]
    share = float(volumes[stray].sum() / volumes.sum())
    if share <= NAMED:
        return found, ""
    return found, (
        f"{np.count_nonzero(stray)} pieces of the mesh, tips of the body that are thinner than its tetrahedra, touch "
        f"the rest by less than a face and are left out: {share:.2%} of the volume; more tetrahedra would help"
    )
