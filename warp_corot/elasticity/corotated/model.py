"""Corotated linear elasticity, the paper's model: linear in a frame that rotates with the element or its ancestor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from warp_corot.elasticity.dilatation import bind_law
from warp_corot.elasticity.model import ForceField
from warp_corot.errors import InputError
from warp_corot.kernels.elements.dilatation import VOLUME
from warp_corot.kernels.math.rotation import quick_rotation
from warp_corot.materials.anisotropic import Anisotropic
from warp_corot.mesh import TetForest

from .anisotropic import AnisotropicField, AnisotropicSimd8Field
from .anisotropic_cuda import AnisotropicCudaField
from .elements import CorotatedField, LeafField, Simd8Field
from .general import CorotatedGeneralField
from .options import CorotatedOptions
from .subtrees import SubtreeField

if TYPE_CHECKING:
    from warp_corot.discretization.discretization import Discretization, Discretized


@dataclass(frozen=True)
class Corotated(CorotatedOptions):
    """W = V (mu e:e + lambda/2 tr(e)^2) with e = sym(R^T F) - I and R the rotation of F.

    If every element has its own rotation, the force is the gradient of W and conserves linear and angular momentum.
    Shared rotations are cheaper; they conserve only linear momentum.

    Anisotropic materials always have own rotations and conserve both momenta, too (see ``AnisotropicField``).

    With the defaults, forests use the fast path: complete three-level subtrees as units of work. With any other
    rotation, iterations or stiffness, forces are computed leaf by leaf.

    Attributes:
        rotation_level: None: every element has its own rotation. An int: the rotation of the ancestor at that level of
            the tree, or an element's own if it is above that level (forests only). Levels three or more above the
            leaves use the fast path; one or two levels above are computed leaf by leaf and are slower than own
            rotations. A float: the tolerance [rad] within which the rotation of the ancestor three levels up replaces
            the own rotations of its leaves. Each evaluation decides this for each subtree from its displacements, on
            the CPU; on CUDA every element has its own.
            "auto": 0.1. Then the error w of an element's rotation is at most 2 tolerance, and that of its stress at
            most (2 mu + 3 lambda) (3 w |U - I| + w^2 |U|); energies use own rotations.
        rotation: "byers-xu" (the paper's) or "svd" (McAdams et al. 2011).
        iterations: For "byers-xu": None iterates to the paper's tolerance 3.85e-5; an int from 2 to 12 is the number.
        stiffness: "factored" (sums and differences), "sparse" (the paper's explicit K_T by type, zeros skipped) or
            "dense" (the same with all 144 products); the last two for forests only. All agree to rounding.
        subtrees: False: leaf by leaf even if the fast path is possible, as in the paper; for comparison.
        dilatation: "element": each element has its own dilatation, tr(R^T F) - 3, as in the paper, and nearly
            incompressible tissue is too stiff. "shared": elements share their dilatations J - 1, see
            ``elasticity.dilatation``; slower. "auto": "shared" if the material is isotropic and Poisson's ratio is 0.45
            or more in any element.

    Raises:
        InputError: An option has another value.
    """

    def bind(self, body: Discretized | Discretization, *, deterministic: bool = False) -> ForceField:
        return bind_law(self._bind, VOLUME, self.dilatation, body, deterministic)

    def _bind(self, discretization: Discretization, deterministic: bool) -> CorotatedField | AnisotropicField:
        if discretization.is_anisotropic:
            return self._bind_anisotropic(discretization, deterministic)
        fast = self.rotation == "byers-xu" and self.iterations is None and self.stiffness == "factored"
        fast = fast and self.subtrees
        if isinstance(discretization.mesh, TetForest):
            if fast:
                return SubtreeField(discretization, self, deterministic)
        elif self.level is not None:
            raise InputError(f"rotation_level {self.rotation_level} needs a forest; a general mesh has no tree")
        elif self.stiffness != "factored":
            raise InputError(f"stiffness {self.stiffness!r} needs a forest; general elements have no three shapes")
        elif fast and discretization.device.is_cpu:
            return Simd8Field(discretization, self, deterministic)
        elif fast and not deterministic:
            return CorotatedGeneralField(discretization, self)
        return LeafField(discretization, self, deterministic)

    def _bind_anisotropic(self, discretization: Discretization, deterministic: bool) -> AnisotropicField:
        if not isinstance(discretization.material, Anisotropic):
            name = type(discretization.material).__name__
            raise InputError(f"the material is {name}; only the model HolzapfelGasserOgden supports this material")
        for name, given, wanted in (
            ("rotation_level", self.rotation_level, None),
            ("stiffness", self.stiffness, "factored"),
        ):
            if given != wanted:
                raise InputError(f"{name} is {given!r}; with an anisotropic material it must be {wanted!r}")
        quick = self.own_rotation is quick_rotation
        if quick and discretization.device.is_cuda and not deterministic:
            return AnisotropicCudaField(discretization)
        lanes = quick and discretization.device.is_cpu
        return (AnisotropicSimd8Field if lanes else AnisotropicField)(discretization, self.own_rotation, deterministic)
