"""A shared dilatation for launches on the CPU that add its forces together with a law's."""

from __future__ import annotations

from collections.abc import Callable

import warp as wp

from warp_corot.elasticity.structs import Kept
from warp_corot.inputs.cpu_threads import Team
from warp_corot.kernels.elements.constitutive import IsotropicMaterial
from warp_corot.kernels.elements.dilatation import Dilatation
from warp_corot.kernels.elements.dilatation_lanes import GROUPS
from warp_corot.kernels.subtrees.cpu import DilatingMaterial

from .grouped import GroupedLanes


class Dilating:
    """The shared dilatation, and the structs that kernels read.

    Args:
        of: The shared dilatation.
        lam: Gives lambda [Pa] as elements hold it.
        groups: The leaves outside subtrees, if they share it in groups.
    """

    def __init__(self, of: Dilatation, lam: Callable[[], wp.array], groups: GroupedLanes | None):
        self.of, self.groups, self._lam = of, groups, lam
        self._made = Kept(_material)

    def material(self, isotropic: IsotropicMaterial, tolerance: float | None = None) -> DilatingMaterial:
        """The struct of subtrees.

        Args:
            isotropic: The material, without lambda.
            tolerance: For the corotated law, the largest angle at which the root's rotation is used [rad]; None: never.
        """
        made: DilatingMaterial = self._made(isotropic, self._lam(), tolerance)
        return made

    def parts(self, team: Team, worlds: int) -> list[Dilating]:
        """The same, each with some of the groups of all worlds."""
        groups = self.groups
        if groups is None or not groups.count:
            return [self] * team.parts
        bounds = team.bounds(groups.count, GROUPS, worlds)
        return [Dilating(self.of, self._lam, groups.part(*each)) for each in bounds]

    def derive(self, isotropic: IsotropicMaterial) -> None:
        """Launch the sorting of the groups' leaves; may be recorded."""
        if self.groups is not None:
            self.groups.derive(isotropic, self._lam())


def _material(isotropic: IsotropicMaterial, lam: wp.array, tolerance: float | None) -> DilatingMaterial:
    material = DilatingMaterial()
    material.isotropic, material.lam, material.tolerance = isotropic, lam, tolerance or 0.0
    return material
