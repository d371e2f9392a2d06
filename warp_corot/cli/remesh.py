"""``--remesh``: its options, and its summary."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from warp_corot.errors import InputError
from warp_corot.remesh.online import OnlineRemesh

from .exit_status import as_options

if TYPE_CHECKING:
    from warp_corot.io.write.animate import Recording
    from warp_corot.simulation.simulation import Simulation

#: Names of Python's arguments on the command line.
ARGUMENTS = {
    "refine_above": "--refine-above",
    "simplify_below": "--simplify-below",
    "min_level": "--remesh-levels MIN",
    "max_level": "--remesh-levels MAX",
    "every": "--remesh-every",
    "capacity": "--capacity",
}
#: Options that need ``--remesh``.
OPTIONS = ("refine_above", "simplify_below", "remesh_levels", "remesh_every", "capacity")


def remesh_of(args: argparse.Namespace, kind: str) -> OnlineRemesh | None:
    """The remeshing that the options request, None for none.

    Args:
        args: The command's arguments.
        kind: Kind of input: "box", "tets", "surface" or "scan".

    Raises:
        InputError: An option that is out of its range or has no effect, or a mesh that cannot be remeshed.
    """
    if not args.remesh:
        for name in OPTIONS:
            if getattr(args, name) is not None:
                raise InputError(f"--{name.replace('_', '-')} is for --remesh, which is not given")
        return None
    if kind == "tets":
        raise InputError(
            f"--remesh is for box, surfaces and scans, whose meshes are bisected cubes; {args.input} has its own "
            "tetrahedra"
        )
    asked = {name: getattr(args, name) for name in ("refine_above", "simplify_below", "capacity")}
    asked |= {"every": args.remesh_every}
    asked |= dict(zip(("min_level", "max_level"), args.remesh_levels or (None, None), strict=True))
    with as_options(ARGUMENTS):
        return OnlineRemesh(**{name: value for name, value in asked.items() if value is not None})


def remesh_rows(sim: Simulation, done: Recording) -> list[tuple[str, str]]:
    """The mesh's changes for the summary; empty without remeshing."""
    changing = sim.remeshing.changing[0]
    if changing is None or not done.elements:
        return []
    options, first, last = changing.options, done.elements[0], done.elements[-1]
    limits = f"above {options.refine_above:g}, below {options.simplify_below:g}"
    low = "that of the start" if options.min_level is None else options.min_level
    levels = f"levels {low} to {options.max_level}"
    counts = f"{first} tetrahedra in the first frame, {max(done.elements)} at most, {last} in the last"
    return [("remeshing", counts), ("", f"every {options.every} steps, {limits}, {levels}")]
