"""A soft matrix with families of fibres, as arteries and muscles have them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from warp_corot.errors import InputError

from .directional import Array, Directional, any_across, unit
from .isotropic import Field, Isotropic, set_checked

#: Values down to this pass checks of "zero or more", because of rounding; and directions are at right angles if their
#: inner product is below this.
_BELOW = -1e-12
_RIGHT_ANGLE = 1e-3


@dataclass(frozen=True, eq=False)
class FibreReinforced(Directional):
    """A soft matrix with one or two families of fibres, for the model ``HolzapfelGasserOgden``.

    Every number may be given per element, per world or as a function of the rest position, as in ``Isotropic``.

    Attributes:
        young: Young's modulus of the matrix > 0 [Pa].
        poisson: Poisson's ratio of the matrix, -1 < nu < 0.5.
        k1: Stiffness of each family of fibres > 0 [Pa].
        k2: How fast fibres stiffen > 0, without unit.
        direction: Direction of the fibres, or the one midway between two families, in rest space, of any nonzero
            length: [3], [T, 3], [worlds, T, 3] or a function ``f(points [n, 3]) -> [n, 3]``.
        density: Mass per rest volume > 0 [kg/m^3].
        kappa: Dispersion of the fibres' directions, 0 (all alike) to 1/3 (the same in all directions).
        angle: Angle of either family to ``direction`` [rad], 0 to pi/2; zero: there is one family.
        across: A direction in the plane of both families, at right angles to ``direction``, given likewise; zero: any,
            which is allowed where the angle is zero.
        toughness: Energy that a cut takes for its area >= 0 [J/m^2].

    Raises:
        InputError: A value out of its range, a direction that is zero or not finite, or directions that are not at
            right angles.
    """

    components: ClassVar[dict[str, tuple[int, ...]]] = {"direction": (3,), "across": (3,)}
    positive: ClassVar[tuple[int, ...]] = (0, 1)

    young: Field
    poisson: Field
    k1: Field
    k2: Field
    direction: Field
    density: Field
    kappa: Field = 0.0
    angle: Field = 0.0
    across: Field = (0.0, 0.0, 0.0)
    toughness: Field = 0.0

    def __post_init__(self) -> None:
        set_checked(self, "young", "Pa", 0.0, np.inf)
        set_checked(self, "poisson", "", -1.0, 0.5)
        set_checked(self, "k1", "Pa", 0.0, np.inf)
        set_checked(self, "k2", "", 0.0, np.inf)
        set_checked(self, "density", "kg/m^3", 0.0, np.inf)
        set_checked(self, "toughness", "J/m^2", 0.0, np.inf, has_low=True)
        set_checked(self, "kappa", "", _BELOW, 1.0 / 3.0 + 1e-9)
        set_checked(self, "angle", "rad", _BELOW, np.pi / 2 + 1e-9)
        for name in ("direction", "across"):
            set_checked(self, name, "", -np.inf, np.inf)
        if not callable(self.direction):
            object.__setattr__(self, "direction", unit(self.direction, "direction"))
        if not self.functions:
            self._check_across()

    @property
    def isotropic(self) -> Isotropic:
        """The matrix."""
        return Isotropic(self.young, self.poisson, self.density, self.toughness)

    def entries(self) -> Array:
        values = (self.k1, self.k2, self.kappa, self.angle, self.young, self.poisson, 0.0, 0.0, 0.0)
        return np.stack(np.broadcast_arrays(*(np.asarray(v, dtype=np.float64) for v in values)), axis=-1)

    def fields_of_entries(self, entries: Array) -> dict[str, Array]:
        names = ("k1", "k2", "kappa", "angle", "young", "poisson")
        found = {name: entries[..., n] for n, name in enumerate(names)}
        # Means of float32 may be beyond the limits by a rounding.
        return found | {
            "kappa": np.clip(found["kappa"], 0.0, 1.0 / 3.0),
            "angle": np.clip(found["angle"], 0.0, np.pi / 2),
        }

    def directions_of(self, frames: Array) -> dict[str, Array]:
        return {"direction": frames[..., 0], "across": frames[..., 1]}

    def frames(self) -> Array:
        along, across = np.broadcast_arrays(self.direction, self.across)
        across = np.where(np.any(across != 0, axis=-1, keepdims=True), across, any_across(along))
        # Removes rounding and small angles.
        across = across - np.sum(along * across, axis=-1, keepdims=True) * along
        across = across / np.linalg.norm(across, axis=-1, keepdims=True)
        return np.stack([along, across, np.cross(along, across)], axis=-1)

    def _check_across(self) -> None:
        size = np.linalg.norm(self.across, axis=-1)
        if np.any((size == 0) & (np.asarray(self.angle) > 0)):
            raise InputError("across is zero and angle is not; two families need a direction in their plane")
        cosine = np.abs(np.sum(self.direction * np.asarray(self.across), axis=-1)) / np.where(size > 0, size, 1.0)
        if np.any(cosine > _RIGHT_ANGLE):
            raise InputError(
                f"across is not at right angles to direction: the largest cosine is {cosine.max():.3g}; "
                f"it must be below {_RIGHT_ANGLE:g}"
            )
