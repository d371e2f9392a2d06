"""Which kernels a constitutive law runs on."""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from ..mesh import TetForest
from .law_general import LawGeneralField
from .law_subtrees import LawSubtreeField
from .model import LawField

if TYPE_CHECKING:
    from ..body import SoftBody


def law_field(
    body: SoftBody, *, stress: wp.Function, energy: wp.Function, cauchy: wp.Function, deterministic: bool = False
) -> LawField:
    """The fastest force field of a law on a body.

    Args:
        body: The body.
        stress, energy, cauchy: The law, functions of ``kernels.constitutive``.
        deterministic: As for every field.
    """
    kind = LawField
    if body.device.is_cuda:
        if isinstance(body.mesh, TetForest):
            kind = LawSubtreeField
        elif not deterministic:
            kind = LawGeneralField
    return kind(body, stress=stress, energy=energy, cauchy=cauchy, deterministic=deterministic)
