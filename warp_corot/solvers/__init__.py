"""Time integrators, one file each. A new one is listed here."""

from .integrator import Integrator, Stepper
from .stable_step import largest_frequency
from .symplectic_euler import SymplecticEuler

INTEGRATORS: dict[str, type[Integrator]] = {"symplectic-euler": SymplecticEuler}

__all__ = ["INTEGRATORS", "Integrator", "Stepper", "SymplecticEuler", "largest_frequency"]
