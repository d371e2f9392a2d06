"""Materials."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .errors import InputError


@dataclass(frozen=True, eq=False)
class Isotropic:
    """An isotropic elastic material, uniform or with a value per element, per world, or both.

    Attributes:
        young: Young's modulus E > 0 [Pa], a number, [T], [worlds, 1] or [worlds, T].
        poisson: Poisson's ratio, -1 < nu < 0.5, as ``young``.
        density: Mass per rest volume > 0 [kg/m^3], as ``young``.

    Raises:
        InputError: A value out of its range, or arrays of more than two dimensions.
    """

    young: float | npt.NDArray[np.floating]
    poisson: float | npt.NDArray[np.floating]
    density: float | npt.NDArray[np.floating]

    def __post_init__(self) -> None:
        for name, unit, low, high in (
            ("young", "Pa", 0.0, np.inf),
            ("poisson", "", -1.0, 0.5),
            ("density", "kg/m^3", 0.0, np.inf),
        ):
            try:
                values = np.asarray(getattr(self, name), dtype=np.float64)
            except (TypeError, ValueError):
                raise InputError(f"{name} is {getattr(self, name)!r}; it must be a number or an array") from None
            if values.ndim > 2:
                raise InputError(f"{name} has shape {values.shape}; it must be a number or have one entry per element")
            bad = np.flatnonzero(~(np.isfinite(values) & (values > low) & (values < high)))
            if len(bad):
                bound = f"above {low:g}" if high == np.inf else f"above {low:g} and below {high:g}"
                where = f" of element {bad[0] % values.shape[-1]}" if values.ndim else ""
                if values.ndim == 2:
                    where = f"{where if values.shape[1] > 1 else ''} in world {bad[0] // values.shape[1]}"
                value = values.ravel()[bad[0]]
                raise InputError(f"{name}{where} is {value:g}{' ' + unit if unit else ''}; it must be {bound}")
            object.__setattr__(self, name, values if values.ndim else float(values))

    @property
    def mu(self) -> float | npt.NDArray[np.floating]:
        """Second Lamé parameter (shear modulus) [Pa]."""
        return self.young / (2.0 * (1.0 + self.poisson))

    @property
    def lam(self) -> float | npt.NDArray[np.floating]:
        """First Lamé parameter [Pa]."""
        return self.young * self.poisson / ((1.0 + self.poisson) * (1.0 - 2.0 * self.poisson))
