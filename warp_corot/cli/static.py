"""``--static``: bodies at rest."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from warp_corot.errors import InputError, UnstableError
from warp_corot.inputs.stopwatch import WATCH
from warp_corot.simulation.beginning import bring_to_rest
from warp_corot.simulation.simulation import Simulation
from warp_corot.simulation.static import solve_static
from warp_corot.solvers import BackwardEuler, Integrator, QuasiStatic

from .bodies import RunBody
from .implicit import is_static
from .ranks import are_several
from .touching import RunContact


def check_static(args: argparse.Namespace, *, touches: bool, remeshes: bool) -> None:
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
    if touches and args.drop is not None:
        raise InputError("--static has no fall; leave out --drop (--ground lets the bodies stand on the ground)")
    if touches and are_several():
        raise InputError("--static with contact runs in one process, and there are several ranks")
    if remeshes:
        raise InputError("--static does not support remeshing; leave out --remesh")


def rest(args: argparse.Namespace, sim: Simulation) -> list[str]:
    """With --static, find where bodies are at rest before anything moves them; returns a line for each.

    Raises:
        UnstableError: No state at rest was found for a body.
    """
    if not is_static(args):
        return []
    if sim.contact is not None:
        return [_rest_in_contact(sim)]
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


def _rest_in_contact(sim: Simulation) -> str:
    """Bring all bodies to rest on what they touch; returns a line."""
    began = WATCH.clock()
    found = bring_to_rest(sim)
    if not found.converged.all():
        raise UnstableError(f"--static: {found.message}")
    return (
        f"at rest in contact after {found.iterations} long steps, {found.linear_iterations} linear iterations, "
        f"{WATCH.clock() - began:.2f} s"
    )


def static_integrator(args: argparse.Namespace, bodies: Sequence[RunBody], touched: RunContact) -> Integrator:
    """The steps from one frame of a static answer to the next; there are none for bodies that only contact holds.

    Raises:
        InputError: They do not stay at rest, as something moves.
    """
    held = all(body.soft.conditions.held_mask().any() for body in bodies)
    if touched.contact is None or held:
        return QuasiStatic(1.0 / args.fps)
    if moves(bodies, touched):
        raise InputError(
            "--static: tools and loads that move can only follow bodies that are held; add --fix, or leave out --static"
        )
    return BackwardEuler(1.0 / args.fps)  # makes no step


def moves(bodies: Sequence[RunBody], touched: RunContact) -> bool:
    """Whether loads or tools move, so that bodies at rest follow them from frame to frame."""
    return touched.moves or any(body.loads for body in bodies)
