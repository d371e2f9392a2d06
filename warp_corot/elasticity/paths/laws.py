"""Which kernels a constitutive law runs on."""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from warp_corot.elasticity.model import LawField
from warp_corot.mesh import TetForest

from .general import LawGeneralField
from .law_lanes import LawLanesField
from .subtrees import LawSubtreeField

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody


def law_field(
    law: str,
    body: SoftBody,
    *,
    stress: wp.Function,
    energy: wp.Function,
    cauchy: wp.Function,
    deterministic: bool = False,
) -> LawField:
    """The fastest force field of a law on a body.

    Args:
        law: Its name among those that run in lanes on the CPU, a key of ``kernels.elements.law_lanes.LAWS``.
        body: The body.
        stress, energy, cauchy: The law, functions of ``kernels.elements.constitutive``.
        deterministic: As for every field.
    """
    functions = {"stress": stress, "energy": energy, "cauchy": cauchy}
    if body.device.is_cpu:
        return LawLanesField(body, law=law, **functions, deterministic=deterministic)
    kind = LawField
    if isinstance(body.mesh, TetForest) and (deterministic or body.discretization.prefers_subtrees):
        kind = LawSubtreeField
    elif not deterministic:
        kind = LawGeneralField
    return kind(body, **functions, deterministic=deterministic)
