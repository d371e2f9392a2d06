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
    from warp_corot.discretization.discretization import Discretization


def law_field(
    law: str,
    discretization: Discretization,
    *,
    stress: wp.Function,
    differential: wp.Function,
    energy: wp.Function,
    cauchy: wp.Function,
    deterministic: bool = False,
) -> LawField:
    """The fastest force field of a law on a discretization.

    Args:
        law: Its name among those that run in lanes on the CPU, a key of ``kernels.elements.law_lanes.LAWS``.
        discretization: The mesh and the material.
        stress, differential, energy, cauchy: The law, functions of ``kernels.elements.constitutive``.
        deterministic: As for every field.
    """
    functions = {"stress": stress, "differential": differential, "energy": energy, "cauchy": cauchy}
    if discretization.device.is_cpu:
        return LawLanesField(discretization, law=law, **functions, deterministic=deterministic)
    kind: type[LawField] = LawField
    if isinstance(discretization.mesh, TetForest) and (deterministic or discretization.prefers_subtrees):
        kind = LawSubtreeField
    elif not deterministic:
        kind = LawGeneralField
    return kind(discretization, **functions, deterministic=deterministic)
