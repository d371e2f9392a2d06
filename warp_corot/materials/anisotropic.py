"""Materials with directions in rest space: transversely isotropic, orthotropic and fibre-reinforced ones."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from warp_corot.errors import InputError

from .isotropic import Field, Isotropic, Material, place, set_checked

Array = npt.NDArray[np.float64]

#: The largest cosine between two axes of a material, which limits how far they are from a right angle.
_RIGHT_ANGLE = 1e-3
#: Values down to this pass checks of "zero or more", because of rounding.
_BELOW = -1e-12
#: The entries of ``Directional.entries`` and of ``frames``, row by row, when elements carry them one by one.
STIFFNESS_ENTRIES = tuple(f"stiffness{n}" for n in range(9))
FRAME_ENTRIES = tuple(f"frame{n}" for n in range(9))


class Directional(Material):
    """A material with three axes at right angles, and up to nine numbers in them.

    Class attributes:
        positive: Which entries must be positive numbers of float32.
    """

    positive: ClassVar[tuple[int, ...]]

    @abstractmethod
    def entries(self) -> Array:
        """The numbers that kernels read of each element, [..., 9]."""

    @abstractmethod
    def fields_of_entries(self, entries: Array) -> dict[str, Array]:
        """The fields that give these ``entries``, [..., 9], by name."""

    @abstractmethod
    def frames(self) -> Array:
        """The axes in rest space as the columns of proper rotations, [..., 3, 3]."""

    @abstractmethod
    def directions_of(self, frames: Array) -> dict[str, Array]:
        """The fields that give these ``frames``, [..., 3, 3], by name."""


def any_across(along: Array) -> Array:
    """A direction at right angles to each of some directions of length one, [..., 3]."""
    # The first is perpendicular to the axis that is farthest from it.
    across = np.cross(along, np.eye(3)[np.abs(along).argmin(axis=-1)])
    return across / np.linalg.norm(across, axis=-1, keepdims=True)


def unit(vectors: Array, name: str) -> Array:
    """Vectors [..., 3] of length one; those of length one are not changed, so that repetition changes nothing.

    Raises:
        InputError: One has length zero.
    """
    largest = np.abs(vectors).max(axis=-1, keepdims=True)
    zero = np.argwhere(largest[..., 0] == 0)
    if len(zero):
        rank = 2 if name == "axes" else 1
        where = place(zero[0][: largest.ndim - rank], largest.shape[: largest.ndim - rank])
        raise InputError(f"{name}{where} has length zero; it must have a nonzero length")
    # Scaling comes first, so that no square overflows or underflows.
    scaled = vectors / largest
    norm = np.linalg.norm(scaled, axis=-1, keepdims=True)
    return np.where(np.abs(largest * norm - 1.0) < 1e-14, vectors, scaled / norm)


class Anisotropic(Directional):
    """A material with three axes of symmetry at right angles. In these axes its compliance is

        e_i = s_i / E_i - sum_(j != i) nu_ji / E_j s_j,    2 e_ij = s_ij / G_ij,    nu_ij / E_i = nu_ji / E_j,

    so that nu_ij is the contraction along axis j over the stretch along axis i under tension along axis i.
    """

    #: A quantity that must be positive, besides the moduli, for a positive definite stiffness; ``_margin`` is its
    #: value.
    condition: ClassVar[str]
    positive: ClassVar[tuple[int, ...]] = (0, 1, 2, 6, 7, 8)

    @abstractmethod
    def constants(self) -> tuple[Array, Array, Array]:
        """E_1, E_2, E_3 [Pa]; nu_12, nu_13, nu_23; G_12, G_13, G_23 [Pa]; each [..., 3]."""

    @abstractmethod
    def fields_of(self, constants: tuple[Array, Array, Array]) -> dict[str, Array]:
        """The fields that give these ``constants``, by name."""

    def entries(self) -> Array:
        return self.stiffness()

    def fields_of_entries(self, entries: Array) -> dict[str, Array]:
        return self.fields_of(constants_of(entries))

    def stiffness(self) -> Array:
        """C_11, C_22, C_33, C_12, C_13, C_23, G_12, G_13, G_23 in the material's axes [Pa], [..., 9]."""
        young, poisson, shear = self.constants()
        r12, r13, r23 = _symmetric_ratios(young, poisson)
        det = _determinant(r12, r13, r23)
        e1, e2, e3 = (np.sqrt(young[..., i]) for i in range(3))
        return _stacked(
            e1**2 * (1 - r23**2) / det,
            e2**2 * (1 - r13**2) / det,
            e3**2 * (1 - r12**2) / det,
            e1 * e2 * (r12 + r13 * r23) / det,
            e1 * e3 * (r13 + r12 * r23) / det,
            e2 * e3 * (r23 + r12 * r13) / det,
            *(shear[..., i] for i in range(3)),
        )

    @property
    def isotropic(self) -> Isotropic:
        """The isotropic material of the same density with the nearest stiffness: Voigt's average over directions."""
        c = self.stiffness()
        bulk = (c[..., :3].sum(-1) + 2.0 * c[..., 3:6].sum(-1)) / 9.0
        mu = (c[..., :3].sum(-1) - c[..., 3:6].sum(-1) + 3.0 * c[..., 6:].sum(-1)) / 15.0
        young, poisson = 9.0 * bulk * mu / (3.0 * bulk + mu), (1.5 * bulk - mu) / (3.0 * bulk + mu)
        return Isotropic(young, poisson, self.density, self.toughness)

    def _margin(self) -> Array:
        young, poisson, _shear = self.constants()
        r12, r13, r23 = _symmetric_ratios(young, poisson)
        return np.min(np.stack([1 - r12**2, 1 - r13**2, 1 - r23**2, _determinant(r12, r13, r23)]), axis=0)

    def _check_definite(self) -> None:
        if self.functions:
            return  # a body checks the values of functions
        margin = self._margin()
        bad = np.argwhere(~(margin > 0))
        if len(bad):
            where = place(bad[0], margin.shape)
            raise InputError(
                f"the stiffness{where} is not positive definite: {self.condition} is {margin[tuple(bad[0])]:.3g}; "
                "it must be above zero"
            )


@dataclass(frozen=True, eq=False)
class TransverselyIsotropic(Anisotropic):
    """A material with fibres: it has one stiffness along them and another one in all directions across.

    Every number may be given per element, per world or as a function of the rest position, as in ``Isotropic``.

    Attributes:
        young_along: Young's modulus along the fibres, E_f > 0 [Pa].
        young_across: Young's modulus across the fibres, E_t > 0 [Pa].
        poisson_along: nu_ft: contraction across over stretch along the fibres, under tension along them.
        poisson_across: nu_tt: contraction across over stretch across, under tension across, -1 < nu_tt < 1.
        shear_along: Shear modulus G_ft > 0 of planes that contain the fibres [Pa]; across it is E_t / (2 (1 + nu_tt)).
        direction: Direction of the fibres in rest space, of any nonzero length: [3], [T, 3], [worlds, T, 3] or a
            function ``f(points [n, 3]) -> [n, 3]``.
        density: Mass per rest volume > 0 [kg/m^3].
        toughness: Energy that a cut takes for its area >= 0 [J/m^2].

    Raises:
        InputError: A value out of its range, a stiffness that is not positive definite, or a direction that is zero or
            not finite.
    """

    components: ClassVar[dict[str, tuple[int, ...]]] = {"direction": (3,)}
    condition: ClassVar[str] = "1 - poisson_across - 2 poisson_along^2 young_across / young_along"

    young_along: Field
    young_across: Field
    poisson_along: Field
    poisson_across: Field
    shear_along: Field
    direction: Field
    density: Field
    toughness: Field = 0.0

    def __post_init__(self) -> None:
        for name in ("young_along", "young_across", "shear_along"):
            set_checked(self, name, "Pa", 0.0, np.inf)
        set_checked(self, "poisson_along", "", -np.inf, np.inf)
        set_checked(self, "poisson_across", "", -1.0, 1.0)
        set_checked(self, "direction", "", -np.inf, np.inf)
        set_checked(self, "density", "kg/m^3", 0.0, np.inf)
        set_checked(self, "toughness", "J/m^2", 0.0, np.inf, has_low=True)
        if not callable(self.direction):
            object.__setattr__(self, "direction", unit(self.direction, "direction"))
        self._check_definite()

    def constants(self) -> tuple[Array, Array, Array]:
        transverse = self.young_across / (2.0 * (1.0 + self.poisson_across))
        return (
            _stacked(self.young_along, self.young_across, self.young_across),
            _stacked(self.poisson_along, self.poisson_along, self.poisson_across),
            _stacked(self.shear_along, self.shear_along, transverse),
        )

    def fields_of(self, constants: tuple[Array, Array, Array]) -> dict[str, Array]:
        young, poisson, shear = constants
        return {
            "young_along": young[..., 0],
            "young_across": young[..., 1],
            "poisson_along": poisson[..., 0],
            "poisson_across": poisson[..., 2],
            "shear_along": shear[..., 0],
        }

    def directions_of(self, frames: Array) -> dict[str, Array]:
        return {"direction": frames[..., 0]}

    def _margin(self) -> Array:
        ratio = np.asarray(self.young_across) / self.young_along
        return 1.0 - self.poisson_across - 2.0 * np.asarray(self.poisson_along) ** 2 * ratio

    def frames(self) -> Array:
        along = self.direction
        across = any_across(along)  # any two directions across will do
        return np.stack([along, across, np.cross(along, across)], axis=-1)


@dataclass(frozen=True, eq=False)
class Orthotropic(Anisotropic):
    """A material with three directions at right angles, each with its own stiffness.

    Moduli and ratios may be given per element, [T, 3], per world and element, [worlds, T, 3] or [worlds, 1, 3], or as
    functions of the rest position, ``f(points [n, 3]) -> [n, 3]``.

    Attributes:
        young: E_1, E_2, E_3 > 0 [Pa], [3].
        poisson: nu_12, nu_13, nu_23, [3]: nu_ij is the contraction along axis j over the stretch along axis i, under
            tension along axis i.
        shear: G_12, G_13, G_23 > 0 [Pa], [3].
        axes: Axes 1, 2 and 3 in rest space, a row each, at right angles and of any nonzero length: [3, 3],
            [T, 3, 3], [worlds, T, 3, 3] or a function ``f(points [n, 3]) -> [n, 3, 3]``. Fibres with active stress lie
            along the first.
        density: Mass per rest volume > 0 [kg/m^3].
        toughness: Energy that a cut takes for its area >= 0 [J/m^2].

    Raises:
        InputError: A value out of its range, a stiffness that is not positive definite, or axes that are zero, not
            finite or not at right angles.
    """

    components: ClassVar[dict[str, tuple[int, ...]]] = {"young": (3,), "poisson": (3,), "shear": (3,), "axes": (3, 3)}
    condition: ClassVar[str] = (
        "the least of 1 - nu_ij nu_ji and 1 - nu_12 nu_21 - nu_13 nu_31 - nu_23 nu_32 - 2 nu_12 nu_23 nu_31"
    )

    young: Field
    poisson: Field
    shear: Field
    axes: Field
    density: Field
    toughness: Field = 0.0

    def __post_init__(self) -> None:
        set_checked(self, "young", "Pa", 0.0, np.inf)
        set_checked(self, "poisson", "", -np.inf, np.inf)
        set_checked(self, "shear", "Pa", 0.0, np.inf)
        set_checked(self, "axes", "", -np.inf, np.inf)
        set_checked(self, "density", "kg/m^3", 0.0, np.inf)
        set_checked(self, "toughness", "J/m^2", 0.0, np.inf, has_low=True)
        if not callable(self.axes):
            object.__setattr__(self, "axes", _right_angled(unit(self.axes, "axes")))
        self._check_definite()

    def constants(self) -> tuple[Array, Array, Array]:
        return self.young, self.poisson, self.shear

    def fields_of(self, constants: tuple[Array, Array, Array]) -> dict[str, Array]:
        return dict(zip(("young", "poisson", "shear"), constants, strict=True))

    def directions_of(self, frames: Array) -> dict[str, Array]:
        return {"axes": np.swapaxes(frames, -1, -2)}

    def frames(self) -> Array:
        first, second = self.axes[..., 0, :], self.axes[..., 1, :]
        # Removes rounding and small angles; the sign of an axis does not matter.
        second = second - np.sum(first * second, axis=-1, keepdims=True) * first
        second /= np.linalg.norm(second, axis=-1, keepdims=True)
        return np.stack([first, second, np.cross(first, second)], axis=-1)


def constants_of(stiffness: Array) -> tuple[Array, Array, Array]:
    """``Anisotropic.constants`` from the values of ``Anisotropic.stiffness``, [..., 9]."""
    normal = stiffness[..., [0, 3, 4, 3, 1, 5, 4, 5, 2]].reshape(*stiffness.shape[:-1], 3, 3)
    compliance = np.linalg.inv(normal)
    young = 1.0 / np.diagonal(compliance, axis1=-2, axis2=-1)
    poisson = -compliance[..., [0, 0, 1], [1, 2, 2]] * young[..., [0, 0, 1]]
    return young, poisson, stiffness[..., 6:]


def _stacked(*values: npt.ArrayLike) -> Array:
    return np.stack(np.broadcast_arrays(*(np.asarray(v, dtype=np.float64) for v in values)), axis=-1)


def _symmetric_ratios(young: Array, poisson: Array) -> tuple[Array, Array, Array]:
    """nu_ij sqrt(E_j / E_i) for 12, 13, 23, which is symmetric in i and j."""
    e1, e2, e3 = (young[..., i] for i in range(3))
    n12, n13, n23 = (poisson[..., i] for i in range(3))
    return n12 * np.sqrt(e2 / e1), n13 * np.sqrt(e3 / e1), n23 * np.sqrt(e3 / e2)


def _determinant(r12: Array, r13: Array, r23: Array) -> Array:
    """The determinant of the compliance scaled to a diagonal of ones."""
    return 1.0 - r12**2 - r13**2 - r23**2 - 2.0 * r12 * r13 * r23


def _right_angled(axes: Array) -> Array:
    cosines = np.abs(axes @ np.swapaxes(axes, -1, -2) - np.eye(3)).max(axis=(-2, -1))
    bad = np.argwhere(cosines > _RIGHT_ANGLE)
    if len(bad):
        worst = cosines[tuple(bad[0])]
        raise InputError(
            f"axes{place(bad[0], cosines.shape)} are not at right angles: the cosine of two is {worst:.3g}; "
            f"it must be below {_RIGHT_ANGLE:g}"
        )
    return axes


# --- a soft matrix with families of fibres, as arteries and muscles have them -----------------------------------------


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
