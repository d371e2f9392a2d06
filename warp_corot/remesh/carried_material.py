"""A body's material as its elements carry it through passes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ..materials import Isotropic, Material
from .plan import DevicePlan
from .pools import DeviceForest

if TYPE_CHECKING:
    from ..body import SoftBody


class CarriedMaterial:
    """What of an isotropic material varies from element to element.

    Attributes:
        given: The material that the body began with.
        values: What elements carry, by name, [T] each: Lamé's parameters times the filled share, and without it.
    """

    def __init__(self, body: SoftBody):
        self.given: Isotropic = body.material
        self.values: dict[str, npt.NDArray[np.floating]] = {}
        if body.material_stride:
            self.values = {"mu": body.mu.numpy(), "lam": body.lam.numpy()}
        if body.lame[2] and body.fill is not None:
            self.values |= {"own_mu": body.lame[0].numpy(), "own_lam": body.lame[1].numpy()}
        self._lame = ("own_mu", "own_lam") if "own_mu" in self.values else ("mu", "lam") if body.lame[2] else ()
        #: 2 mu + lambda [Pa] of all elements if they are alike, else 0.
        self.modulus = 0.0 if self.values else float(2.0 * body.mu.numpy()[0] + body.lam.numpy()[0])

    def density(self, count: int) -> npt.NDArray[np.float64]:
        """Mass per rest volume of what elements hold [kg/m^3], [count]."""
        return np.broadcast_to(self.given.density, (1, count))[0]

    def serve(self, body: SoftBody, plan: DevicePlan) -> None:
        """Let the body have what its present elements carry."""
        if body.material_stride:
            body.mu, body.lam = (plan.values[name] for name in ("mu", "lam"))
        if self._lame:
            body.lame = (*(plan.values[name] for name in self._lame), 1)

    def present(self, forest: DeviceForest) -> Material:
        """The material of the present elements."""
        leaves, carriage = forest.leaf_elements, forest.carriage
        density: Any = self.given.density
        if np.ndim(density):
            fill = carriage.values("fill")[leaves] if "fill" in carriage.names else 1.0
            density = carriage.arrays.density.numpy()[leaves] / fill
        if not self._lame:
            return Isotropic(self.given.young, self.given.poisson, density)
        mu, lam = (carriage.values(name)[leaves].astype(np.float64) for name in self._lame)
        return Isotropic(mu * (3.0 * lam + 2.0 * mu) / (lam + mu), 0.5 * lam / (lam + mu), density)
