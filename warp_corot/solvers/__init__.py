"""Time integrators, one file each. A new one is listed here."""

from warp_corot.solvers.explicit.symplectic_euler import SymplecticEuler
from warp_corot.solvers.steps.stable_step import largest_frequency

from .integrator import Integrator, Stepper

INTEGRATORS: dict[str, type[Integrator]] = {"symplectic-euler": SymplecticEuler}

__all__ = ["INTEGRATORS", "Integrator", "Stepper", "SymplecticEuler", "largest_frequency"]
