"""Corotated linear elasticity, the paper's model: linear in a frame that rotates with the element or its ancestor."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Integral
from typing import TYPE_CHECKING

import warp as wp

from warp_corot.elasticity.anisotropic import AnisotropicField
from warp_corot.elasticity.corotated.fields import (
    CorotatedField,
    SubtreeField,
)
from warp_corot.elasticity.dilatation import AUTO, bind_law, check_dilatation
from warp_corot.elasticity.model import ForceField, Model
from warp_corot.elasticity.polar import METHODS, rotation_function
from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_choice, checked_count, checked_flag, shown
from warp_corot.kernels.elements.dilatation import VOLUME
from warp_corot.kernels.math.rotation import byers_xu, quick_rotation
from warp_corot.materials.anisotropic import Anisotropic
from warp_corot.mesh import TetForest
from warp_corot.mesh.lattice import MAX_LEVEL

if TYPE_CHECKING:
    from warp_corot.discretization.discretization import Discretization, Discretized


#: The tolerance of "auto" [rad]. The end of the paper's beam, which sinks by 87 mm, then has an error of 0.24 mm; with
#: a tolerance of 0.05 it is 0.04 mm, with 0.02 0.005 mm, and with level 3 0.47 mm.
AUTO_TOLERANCE = 0.1


@dataclass(frozen=True)
class CorotatedOptions(Model):
    """What fields read; ``corotated.model.Corotated`` explains it."""

    rotation_level: int | float | str | None = None
    rotation: str = "byers-xu"
    iterations: int | None = None
    subtrees: bool = True
    dilatation: str = AUTO

    def __post_init__(self) -> None:
        check_dilatation(self.dilatation)
        _check_level(self.rotation_level)
        checked_choice(self.rotation, "rotation", METHODS)
        if self.iterations is not None:
            rotation_function(self.rotation, checked_count(self.iterations, "iterations", 2))
        checked_flag(self.subtrees, "subtrees")

    @property
    def level(self) -> int | None:
        """The level of the tree at which rotations are shared, if there is one."""
        level = self.rotation_level
        return level if isinstance(level, Integral) else None

    @property
    def tolerance(self) -> float | None:
        """The largest angle between an ancestor's rotation and those of its leaves [rad], or None."""
        level = self.rotation_level
        if level is None or isinstance(level, Integral):
            return None
        return AUTO_TOLERANCE if level == "auto" else float(level)

    @property
    def own_rotation(self) -> wp.Function:
        """The device function that finds an element's own rotation."""
        rotation = rotation_function(self.rotation, self.iterations)
        return quick_rotation if rotation is byers_xu and self.subtrees else rotation


def _check_level(level: int | float | str | None) -> None:
    """Check a rotation level.

    Raises:
        InputError: It is not a rotation level.
    """
    if level is None or (isinstance(level, str) and level == "auto"):
        return
    if isinstance(level, Integral) and not isinstance(level, bool) and 0 <= level <= MAX_LEVEL:
        return
    if isinstance(level, float) and 0.0 < level <= 0.5:
        return
    raise InputError(
        f"rotation_level is {shown(level)}; it must be None, a whole number from 0 to {MAX_LEVEL}, "
        'a tolerance above 0 and up to 0.5 rad, or "auto"'
    )


@dataclass(frozen=True)
class Corotated(CorotatedOptions):
    """W = V (mu e:e + lambda/2 tr(e)^2) with e = sym(R^T F) - I and R the rotation of F.

    If every element has its own rotation, the force is the gradient of W and conserves linear and angular momentum.
    Shared rotations are cheaper; they conserve only linear momentum.

    Anisotropic materials always have own rotations and conserve both momenta, too (see ``AnisotropicField``).

    With the defaults, forests use the fast path: complete three-level subtrees as units of work. With another
    rotation or iterations, forces are computed leaf by leaf.

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
        fast = self.rotation == "byers-xu" and self.iterations is None and self.subtrees
        if isinstance(discretization.mesh, TetForest):
            if fast:
                return SubtreeField(discretization, self, deterministic)
        elif self.level is not None:
            raise InputError(f"rotation_level {self.rotation_level} needs a forest; a general mesh has no tree")
        elif fast and (discretization.device.is_cpu or not deterministic):
            return SubtreeField(discretization, self, deterministic)
        return CorotatedField(discretization, self, deterministic)

    def _bind_anisotropic(self, discretization: Discretization, deterministic: bool) -> AnisotropicField:
        if not isinstance(discretization.material, Anisotropic):
            name = type(discretization.material).__name__
            raise InputError(f"the material is {name}; only the model HolzapfelGasserOgden supports this material")
        if self.rotation_level is not None:
            raise InputError(f"rotation_level is {self.rotation_level!r}; with an anisotropic material it must be None")
        return AnisotropicField(discretization, self.own_rotation, deterministic)
