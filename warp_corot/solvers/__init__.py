"""Time integrators, one file each. A new one is listed here."""

from warp_corot.inputs import choices
from warp_corot.solvers.explicit.symplectic_euler import SymplecticEuler
from warp_corot.solvers.implicit.schemes import (
    BDF2,
    BackwardEuler,
    GeneralizedAlpha,
    ImplicitIntegrator,
    Newmark,
    QuasiStatic,
)
from warp_corot.solvers.stability import largest_frequency

from .system import Integrator, Stepper

INTEGRATORS: dict[str, type[Integrator]] = {name: globals()[kind] for name, kind in choices.INTEGRATORS.items()}

__all__ = [
    "BDF2",
    "INTEGRATORS",
    "BackwardEuler",
    "GeneralizedAlpha",
    "ImplicitIntegrator",
    "Integrator",
    "Newmark",
    "QuasiStatic",
    "Stepper",
    "SymplecticEuler",
    "largest_frequency",
]
