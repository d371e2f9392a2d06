"""Static answers and implicit integrators on the command line."""

from __future__ import annotations

import argparse

from warp_corot.errors import InputError, UnstableError
from warp_corot.simulation.simulation import Simulation
from warp_corot.simulation.static import solve_static
from warp_corot.solvers import INTEGRATORS, QuasiStatic

#: The integrators that users choose from.
STEPPING = tuple(name for name, integrator in INTEGRATORS.items() if integrator is not QuasiStatic)
#: The step of implicit integrators if none is given [s].
IMPLICIT_DT = 0.01


def check_implicit(args: argparse.Namespace, *, touches: bool, remeshes: bool) -> None:
    """Check the options for static answers.

    Args:
        args: The options.
        touches, remeshes: Whether other options ask for contact, or for remeshing.

    Raises:
        InputError: Options that exclude each other.
    """
    if not is_static(args):
        # The simulation reports what an integrator cannot do.
        return
    for name in ("integrator", "dt", "damping", "viscosity"):
        if getattr(args, name) is not None:
            raise InputError(f"--static has no steps in time; leave out --{name}")
    if touches:
        raise InputError(
            "--static does not support contact; leave out --ground, --drop, --tool, --touch and --self-contact"
        )
    if remeshes:
        raise InputError("--static does not support remeshing; leave out --remesh")


def rest(args: argparse.Namespace, sim: Simulation) -> list[str]:
    """With --static, find where bodies are at rest before anything moves them; returns a line for each.

    Raises:
        UnstableError: No state at rest was found for a body.
    """
    if not is_static(args):
        return []
    lines = []
    for body, model in zip(sim.bodies, sim.models, strict=True):
        report = solve_static(body, model=model, gravity=sim.gravity)
        if not report.converged:
            raise UnstableError(f"--static: {report.message}")
        lines.append(
            f"at rest after {report.iterations} iterations of Newton's method, {report.linear_iterations} linear, "
            f"{report.time:.2f} s"
        )
    return lines


def solved(sim: Simulation) -> str | None:
    """The cost of implicit steps, in words; None for explicit ones."""
    solves = sim.solves
    if solves is None or not solves.steps:
        return None
    words = f"{solves.iterations / solves.steps:.3g} iterations of Newton's method"
    words += f" and {solves.linear_iterations / solves.steps:.3g} linear ones a step"
    return words + (f"; {solves.unfinished} steps did not converge" if solves.unfinished else "")


def is_static(args: argparse.Namespace) -> bool:
    return bool(getattr(args, "static", False))


def integrator_name(args: argparse.Namespace) -> str:
    return args.integrator or "symplectic-euler"
