"""Implicit time integrators as tables of coefficients; ``kernels.implicit.steps`` defines rows and columns."""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import numpy.typing as npt

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_count, checked_number
from warp_corot.kernels.implicit import steps as kernels
from warp_corot.solvers.system import Integrator, Stepper

from .preconditioners import check_preconditioner

if TYPE_CHECKING:
    from warp_corot.solvers.system import System

#: The shortest step whose inverse square float32 can hold [s].
SHORTEST = 1e-15

#: The default tolerance of schemes of second order.
TOLERANCE = 1e-4

Table = npt.NDArray[np.float64]


@dataclass(frozen=True)
class ImplicitIntegrator(Integrator):
    """The common part of all implicit integrators. Steps of any length are stable.

    Each step solves M a + D v + f(u) = loads by Newton's method, with conjugate gradients for the linear systems.

    Attributes:
        dt: Time step [s].
        damping: Rate of mass-proportional damping >= 0 [1/s].
        viscosity: Viscous over elastic stress at one strain >= 0 [s], as for ``SymplecticEuler``.
        tolerance: None: one iteration of Newton's method, a linear solve, as is usual in interactive simulation, and
            more only where it goes too far with a law other than ``Corotated`` and without contact. ``BackwardEuler``
            bears that with long steps, and it is the default there; the others need short ones. A
            number: iterations with a line search on the energy until the residual is less than this share of the
            forces, or the last one moves no node by more than this share of the largest displacement.
        iterations: Maximum number of iterations of Newton's method in a step, with a tolerance.
        linear_tolerance: Residual of the linear solve over its right side, without a tolerance.
        linear_iterations: Maximum number of iterations of a linear solve.
        preconditioner: "multigrid", "diagonal", or None: multigrid or the assembled matrix on a forest, whichever has
            been faster, and the diagonal's blocks on a general mesh.

    Raises:
        InputError: A value out of its range.
    """

    dt: float = 0.01
    damping: float = 0.0
    viscosity: float = 0.0
    tolerance: float | None = None
    iterations: int = 20
    linear_tolerance: float = 1e-4
    linear_iterations: int = 1000
    preconditioner: str | None = None

    is_implicit: ClassVar[bool] = True
    #: The number of vectors that a step keeps for the next one.
    history: ClassVar[int] = 0
    #: Whether velocities are the motion of the step over dt, so that steps of one iteration are linearised in the state
    #: to which the whole body will turn, and viscous forces turn as in the middle of the step.
    turns: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if self.dt is None or not SHORTEST <= checked_number(self.dt, "dt", "s") < math.inf:
            raise InputError(f"dt is {self.dt}; {type(self).__name__} needs a step of {SHORTEST:g} s or more")
        for name, unit in (("damping", "1/s"), ("viscosity", "s")):
            value = getattr(self, name)
            if not 0 <= checked_number(value, name, unit) < math.inf:
                raise InputError(f"{name} is {value}; it must be zero or a positive number [{unit}]")
        for name in ("tolerance", "linear_tolerance"):
            value = getattr(self, name)
            if not (name == "tolerance" and value is None) and not 0.0 < checked_number(value, name) < 1.0:
                raise InputError(f"{name} is {value}; it must be between 0 and 1")
        for name in ("iterations", "linear_iterations"):
            checked_count(getattr(self, name), name, least=1)
        check_preconditioner(self.preconditioner)

    def stable_step(self, frequency: float) -> float:
        """Infinite: any step is stable."""
        return math.inf

    @property
    def settles_contact(self) -> bool:
        """Whether nodes that are touched take velocities of backward Euler."""
        return False

    @property
    def is_at_stage(self) -> bool:
        """Whether forces are balanced before the end of the step."""
        return False

    @abstractmethod
    def scheme(self, dt: float) -> Table:
        """Coefficients of a step that continues from the one before, float64 [ROWS, COLUMNS]."""

    def start(self, dt: float) -> Table:
        """The same for a first step: backward Euler's."""
        return backward_euler(dt)

    def bind(self, system: System) -> Stepper:
        from .stepper import ImplicitStepper

        return ImplicitStepper(system, self)


def table(**rows: tuple[float, ...]) -> Table:
    """A table of named rows, with zeros where there are fewer than four numbers."""
    made = np.zeros((kernels.ROWS, kernels.COLUMNS))
    for name, row in rows.items():
        made[int(getattr(kernels, name)), : len(row)] = row
    return made


def backward_euler(
    dt: float, *, first: tuple[float, ...] = (), second: tuple[float, ...] = (), guess: float = 0.0
) -> Table:
    """a = (v_after - v) / dt, v_after = d / dt, with the vectors for another scheme."""
    inverse = 1.0 / dt
    return table(
        ACCELERATION=(inverse**2, -inverse),
        RATE=(inverse,),
        VELOCITY=(inverse,),
        FIRST=first,
        SECOND=second,
        STAGE=(1.0, guess),
    )


@dataclass(frozen=True)
class BackwardEuler(ImplicitIntegrator):
    """v_after = v + dt a(u_after), u_after = u + dt v_after: first order; damps motion that it does not resolve."""

    turns: ClassVar[bool] = True

    def scheme(self, dt: float) -> Table:
        return backward_euler(dt)


@dataclass(frozen=True)
class GeneralizedAlpha(ImplicitIntegrator):
    """The method of Chung and Hulbert (1993): second order, with a chosen damping of fast vibrations.

    Attributes:
        spectral_radius: The factor of the fastest vibrations in each step, 0 to 1: 1 keeps energy, 0 damps most.
    """

    tolerance: float | None = TOLERANCE
    spectral_radius: float = 0.8

    history: ClassVar[int] = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 <= checked_number(self.spectral_radius, "spectral_radius") <= 1.0:
            raise InputError(f"spectral_radius is {self.spectral_radius}; it must be between 0 and 1")

    @property
    def settles_contact(self) -> bool:
        return self.is_at_stage

    @property
    def is_at_stage(self) -> bool:
        return self.spectral_radius > 0.0

    def scheme(self, dt: float) -> Table:
        rho = self.spectral_radius
        mass_share, force_share = (2.0 * rho - 1.0) / (rho + 1.0), rho / (rho + 1.0)
        gamma = 0.5 - mass_share + force_share
        return generalized_alpha(dt, 0.25 * (1.0 - mass_share + force_share) ** 2, gamma, mass_share, force_share)

    def start(self, dt: float) -> Table:
        return backward_euler(dt, first=(1.0 / dt**2, -1.0 / dt))


@dataclass(frozen=True)
class Newmark(ImplicitIntegrator):
    """u_after = u + dt v + dt^2 ((1/2 - beta) a + beta a_after), v_after = v + dt ((1 - gamma) a + gamma a_after).

    Attributes:
        beta, gamma: Newmark's parameters; 1/4 and 1/2, the average acceleration, keep the energy of linear motions,
            with second order.
    """

    tolerance: float | None = TOLERANCE
    beta: float = 0.25
    gamma: float = 0.5

    history: ClassVar[int] = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.5 <= checked_number(self.gamma, "gamma") <= 1.0:
            raise InputError(f"gamma is {self.gamma}; it must be between 0.5 and 1")
        if not 0.5 * self.gamma <= checked_number(self.beta, "beta") <= 1.0:
            raise InputError(f"beta is {self.beta}; it must be between gamma / 2 and 1 for steps of any length")

    @property
    def settles_contact(self) -> bool:
        return True

    def scheme(self, dt: float) -> Table:
        return generalized_alpha(dt, self.beta, self.gamma, 0.0, 0.0)

    def start(self, dt: float) -> Table:
        return backward_euler(dt, first=(1.0 / dt**2, -1.0 / dt))


def generalized_alpha(dt: float, beta: float, gamma: float, mass_share: float, force_share: float) -> Table:
    """With h1 the acceleration after the last step; forces are those at the stage, ``force_share`` before the end."""
    whole = 1.0 / (1.0 - force_share)  # the step's increment over the stage's
    of_step, of_velocity, of_before = whole / (beta * dt**2), -1.0 / (beta * dt), 1.0 - 0.5 / beta
    moves = (gamma * dt * of_step, 1.0 - gamma / beta, dt * (1.0 - 0.5 * gamma / beta))
    left = 1.0 - mass_share
    rest = 1.0 - force_share
    return table(
        ACCELERATION=(left * of_step, left * of_velocity, left * of_before + mass_share),
        RATE=(rest * moves[0], rest * moves[1] + force_share, rest * moves[2]),
        VELOCITY=moves,
        FIRST=(of_step, of_velocity, of_before),
        STAGE=(rest, 1.0),
    )


@dataclass(frozen=True)
class BDF2(ImplicitIntegrator):
    """The backward differentiation formula of two steps: second order; damps motion that it does not resolve."""

    tolerance: float | None = TOLERANCE

    history: ClassVar[int] = 2

    def scheme(self, dt: float) -> Table:
        """With h1 the displacement of the last step, and h2 the velocity before it."""
        inverse = 1.0 / dt
        return table(
            ACCELERATION=(2.25 * inverse**2, -2.0 * inverse, -0.75 * inverse**2, 0.5 * inverse),
            RATE=(1.5 * inverse, 0.0, -0.5 * inverse),
            VELOCITY=(1.5 * inverse, 0.0, -0.5 * inverse),
            FIRST=(1.0,),
            SECOND=(0.0, 1.0),
            STAGE=(1.0, 1.0),
        )

    def start(self, dt: float) -> Table:
        return backward_euler(dt, first=(1.0,), second=(0.0, 1.0))


@dataclass(frozen=True)
class QuasiStatic(ImplicitIntegrator):
    """A body at rest at every time: motion so slow that inertia is negligible.

    ``dt`` is only the time of keyframes from one state of rest to the next; velocities are zero. ``damping`` and
    ``viscosity`` do nothing. ``Simulation.solves`` counts steps that did not come to rest. Every body needs held nodes.
    """

    tolerance: float | None = 1e-6
    iterations: int = 100

    def scheme(self, dt: float) -> Table:
        return table(STAGE=(1.0, 0.0))

    def start(self, dt: float) -> Table:
        return self.scheme(dt)

    def bind(self, system: System) -> Stepper:
        for body in system.bodies:
            held = system.ranks.owned(body).whole.conditions.held_mask().reshape(body.worlds, -1)
            if not system.ranks.max(np.asarray(held.any(axis=1))).all():
                raise InputError("no node of the body is held; QuasiStatic needs some in each world")
        return super().bind(system)
