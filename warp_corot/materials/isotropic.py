"""Materials: the common base class and isotropic materials; ``anisotropic`` has the others."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Self

import numpy as np
import numpy.typing as npt

from warp_corot.errors import InputError

#: A number, an array, or a function of rest positions [m], float64 [n, 3] -> [n], which a body evaluates at its
#: elements' centroids when it is made.
Field = Any

Values = float | npt.NDArray[np.floating]


class Material(ABC):
    """The base class of materials: frozen dataclasses whose fields are uniform or vary from element to element.

    Class attributes:
        components: Shape of one value of each field that is not a number.
    """

    components: ClassVar[dict[str, tuple[int, ...]]] = {}

    density: Field
    toughness: Field

    @property
    @abstractmethod
    def isotropic(self) -> Isotropic:
        """The nearest isotropic material."""

    @property
    def functions(self) -> tuple[str, ...]:
        """Fields given as functions of the rest position."""
        return tuple(f.name for f in fields(self) if callable(getattr(self, f.name)))  # type: ignore[arg-type]

    def at(self, points: npt.NDArray[np.float64]) -> Self:
        """The same material with values in place of functions.

        Args:
            points: Rest positions, one for each element [m], [n, 3].

        Raises:
            InputError: A function gives values with another shape, or out of their range.
        """
        found = {}
        for name in self.functions:
            wanted = (len(points), *self.components.get(name, ()))
            given = getattr(self, name)(points)
            try:
                values = np.asarray(given, dtype=np.float64)
            except (TypeError, ValueError):
                raise InputError(
                    f"{name} gives {given!r} at {len(points)} rest positions; it must be numbers"
                ) from None
            if values.shape != wanted:
                raise InputError(
                    f"{name} gives shape {values.shape} at {len(points)} rest positions; it must be {list(wanted)}"
                )
            found[name] = values
        return replace(self, **found) if found else self  # type: ignore[type-var]

    def check_shapes(self, worlds: int, count: int) -> None:
        """Check that there is one value for each element, or one for all.

        Raises:
            InputError: An array does not broadcast to [worlds, count].
        """
        for field in fields(self):  # type: ignore[arg-type]
            shape, tail = np.shape(getattr(self, field.name)), self.components.get(field.name, ())
            head = shape[: len(shape) - len(tail)]
            of_worlds = f"[{', '.join(map(str, (worlds, 1, *tail)))}]"
            if len(head) == 1 and head[0] != count:
                cure = f"; one for each of {worlds} worlds is {of_worlds}" if head[0] == worlds > 1 else ""
                raise InputError(f"{field.name} has {head[0]} entries; the mesh has {count} elements{cure}")
            if len(head) == 2 and (head[0] not in (1, worlds) or head[1] not in (1, count)):
                raise InputError(
                    f"{field.name} has shape {shape}; there are {worlds} worlds of {count} elements: "
                    f"it must be {[count, *tail]}, {of_worlds} or {[worlds, count, *tail]}"
                )


@dataclass(frozen=True, eq=False)
class Isotropic(Material):
    """An isotropic elastic material, uniform or with values per element, per world, or both.

    Attributes:
        young: Young's modulus E > 0 [Pa], a number, [T], [worlds, 1], [worlds, T], or a function of the rest position:
            ``f(points [n, 3]) -> [n]``, evaluated at the elements' centroids when a body is made.
        poisson: Poisson's ratio, -1 < nu < 0.5, as ``young``.
        density: Mass per rest volume > 0 [kg/m^3], as ``young``.
        toughness: Energy that a cut takes for its area >= 0 [J/m^2], as ``young``.

    Raises:
        InputError: A value out of its range, or arrays of more than two dimensions.
    """

    young: Field
    poisson: Field
    density: Field
    toughness: Field = 0.0

    def __post_init__(self) -> None:
        set_checked(self, "young", "Pa", 0.0, np.inf)
        set_checked(self, "poisson", "", -1.0, 0.5)
        set_checked(self, "density", "kg/m^3", 0.0, np.inf)
        set_checked(self, "toughness", "J/m^2", 0.0, np.inf, has_low=True)

    @property
    def isotropic(self) -> Isotropic:
        return self

    @property
    def mu(self) -> Values:
        """Second Lamé parameter (shear modulus) [Pa]."""
        return self.young / (2.0 * (1.0 + self.poisson))

    @property
    def lam(self) -> Values:
        """First Lamé parameter [Pa]."""
        return self.young * self.poisson / ((1.0 + self.poisson) * (1.0 - 2.0 * self.poisson))


def set_checked(material: Material, name: str, unit: str, low: float, high: float, *, has_low: bool = False) -> None:
    """Replace a field by its values in float64, unless it is a function.

    Raises:
        InputError: No numbers, a wrong shape, or a value that is not between ``low`` and ``high``, or ``low`` itself if
            it ``has_low``.
    """
    given = getattr(material, name)
    if callable(given):
        return
    tail = material.components.get(name, ())
    try:
        values = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{name} is {given!r}; it must be a number or an array") from None
    head = values.shape[: max(values.ndim - len(tail), 0)]
    if len(head) > 2 or values.shape != head + tail:
        wanted = f"be {list(tail)} or have {list(tail)}" if tail else "be a number or have one entry"
        raise InputError(f"{name} has shape {values.shape}; it must {wanted} per element")
    bad = np.argwhere(~(np.isfinite(values) & ((values > low) | has_low & (values == low)) & (values < high)))
    if len(bad):
        value = values[tuple(bad[0])]
        if low == -np.inf and high == np.inf:
            bound = "finite"
        else:
            above = f"{'at least' if has_low else 'above'} {low:g}"
            bound = above if high == np.inf else f"{above} and below {high:g}"
        what = f"{name}{place(bad[0][: len(head)], head)}"
        raise InputError(f"{what} is {value:g}{' ' + unit if unit else ''}; it must be {bound}")
    object.__setattr__(material, name, values if values.ndim else float(values))


def place(index: npt.NDArray[np.integer], head: tuple[int, ...]) -> str:
    """In words, which one of the values [T] or [worlds, T] the index refers to."""
    if not head:
        return ""
    where = f" of element {index[-1]}" if head[-1] > 1 or len(head) == 1 else ""
    return where + (f" in world {index[0]}" if len(head) == 2 else "")
