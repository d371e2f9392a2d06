"""The choice of kernels for a constitutive law."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import warp as wp

from warp_corot.elasticity.model import LawField
from warp_corot.kernels.elements.law_lanes import LawInLanes
from warp_corot.mesh import TetForest

from .general import LawGeneralField
from .law_lanes import LawLanesField
from .subtrees import LawSubtreeField

if TYPE_CHECKING:
    from warp_corot.discretization.discretization import Discretization


class Law(NamedTuple):
    """A constitutive law of the package.

    Attributes:
        lanes: The law of ``kernels.elements.law_lanes`` that runs in lanes on the CPU.
        stress, differential, energy, cauchy: Functions of ``kernels.elements.constitutive``.
    """

    lanes: LawInLanes
    stress: wp.Function
    differential: wp.Function
    energy: wp.Function
    cauchy: wp.Function


def law_field(law: Law, discretization: Discretization, deterministic: bool = False) -> LawField:
    """The fastest force field of a law on a discretization.

    Args:
        law: The law.
        discretization: The mesh and the material.
        deterministic: As for every field.
    """
    functions = law._asdict()
    lanes = functions.pop("lanes")
    if discretization.device.is_cpu:
        return LawLanesField(discretization, law=lanes, **functions, deterministic=deterministic)
    kind: type[LawField] = LawField
    if isinstance(discretization.mesh, TetForest) and (deterministic or discretization.prefers_subtrees):
        kind = LawSubtreeField
    elif not deterministic:
        kind = LawGeneralField
    return kind(discretization, **functions, deterministic=deterministic)
