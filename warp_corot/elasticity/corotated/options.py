"""The options of the corotated model."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Integral

import warp as wp

from warp_corot.elasticity.dilatation import AUTO, check_dilatation
from warp_corot.elasticity.model import Model
from warp_corot.elasticity.polar import METHODS, rotation_function
from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_choice, checked_count, checked_flag, shown
from warp_corot.kernels.math.rotation import byers_xu, quick_rotation
from warp_corot.mesh.forest import MAX_LEVEL

STIFFNESSES = ("factored", "sparse", "dense")
#: The tolerance of "auto" [rad]. The end of the paper's beam, which sinks by 87 mm, then has an error of 0.24 mm; with
#: a tolerance of 0.05 it is 0.04 mm, with 0.02 0.005 mm, and with level 3 0.47 mm.
AUTO_TOLERANCE = 0.1


@dataclass(frozen=True)
class CorotatedOptions(Model):
    """What fields read; ``corotated.model.Corotated`` explains it."""

    rotation_level: int | float | str | None = None
    rotation: str = "byers-xu"
    iterations: int | None = None
    stiffness: str = "factored"
    subtrees: bool = True
    dilatation: str = AUTO

    def __post_init__(self) -> None:
        check_dilatation(self.dilatation)
        _check_level(self.rotation_level)
        checked_choice(self.rotation, "rotation", METHODS)
        if self.iterations is not None:
            rotation_function(self.rotation, checked_count(self.iterations, "iterations", 2))
        checked_choice(self.stiffness, "stiffness", STIFFNESSES)
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
