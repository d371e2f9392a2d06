"""Materials of subtrees whose leaves share their dilatation, for launches that add its forces with a law's."""

from __future__ import annotations

from collections.abc import Callable

import warp as wp

from warp_corot.elasticity.structs import Kept
from warp_corot.kernels.elements.constitutive import IsotropicMaterial
from warp_corot.kernels.elements.dilatation import Dilatation
from warp_corot.kernels.subtrees.cpu import DilatingMaterial


class Dilating:
    """What the leaves of subtrees share, and the struct that kernels read.

    Args:
        of: What is shared.
        lam: Gives lambda [Pa] as elements hold it.
        tolerance: Of the corotated law, how near the root's rotation must be to be used [rad]; None: it never is.
    """

    def __init__(self, of: Dilatation, lam: Callable[[], wp.array], tolerance: float | None = None):
        self.of, self._lam = of, lam
        self._made = Kept(lambda isotropic, lam: _material(isotropic, lam, tolerance or 0.0))

    def material(self, isotropic: IsotropicMaterial) -> DilatingMaterial:
        """The struct of a material that has no lambda of its own."""
        made: DilatingMaterial = self._made(isotropic, self._lam())
        return made


def _material(isotropic: IsotropicMaterial, lam: wp.array, tolerance: float) -> DilatingMaterial:
    material = DilatingMaterial()
    material.isotropic, material.lam, material.tolerance = isotropic, lam, tolerance
    return material
