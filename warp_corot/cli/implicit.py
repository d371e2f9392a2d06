"""Implicit integrators on the command line."""

from __future__ import annotations

import argparse

from warp_corot.simulation.simulation import Simulation


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
