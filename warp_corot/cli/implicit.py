"""Implicit integrators on the command line."""

from __future__ import annotations

import argparse

from warp_corot.simulation.simulation import Simulation
from warp_corot.simulation.solves import Solves


def solved(sim: Simulation, static: bool) -> str | None:
    """The cost of implicit steps, or of the states of rest after the first, in words; None for explicit ones."""
    solves = sim.solves
    if solves is None or not solves.steps:
        return None
    words = f"{solves.iterations / solves.steps:.3g} iterations of Newton's method"
    words += f" and {solves.linear_iterations / solves.steps:.3g} linear ones a {'frame' if static else 'step'}"
    if static:
        return words + unfinished(solves, "later frames", "show more frames (--fps), which are nearer to one another")
    return words + unfinished(solves, "steps", "shorten the steps (--dt), or raise linear_iterations in Python")


def unfinished(solves: Solves, what: str, cure: str) -> str:
    """The number of unfinished solves, and what helps; empty if there are none."""
    if not solves.unfinished:
        return ""
    return f"; {solves.unfinished} of {solves.steps} {what} ended before their linear solve converged; {cure}"


def is_static(args: argparse.Namespace) -> bool:
    return bool(getattr(args, "static", False))


def integrator_name(args: argparse.Namespace) -> str:
    return args.integrator or "symplectic-euler"
