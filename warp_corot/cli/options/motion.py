"""Options that describe the motion of bodies, which ``simulate`` and ``view`` share."""

from __future__ import annotations

import argparse
from pathlib import Path

from warp_corot.cli.quantities import (
    acceleration,
    ground_height,
    metres,
    number,
    per_second,
    seconds,
    tool_shape,
    whole_number,
)
from warp_corot.inputs.choices import INTEGRATORS, REFINE_ABOVE, REMESH_EVERY, SIMPLIFY_BELOW

from .defaults import AUTO, FPS, IMPLICIT_DT, LOADS

#: The integrators that users choose from.
STEPPING = tuple(name for name in INTEGRATORS if name != "quasi-static")


def add_motion_options(parser: argparse.ArgumentParser) -> None:
    """Add the options to a parser."""
    motion = parser.add_argument_group("the motion")
    motion.add_argument(
        "--gravity",
        type=acceleration,
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="gravity [m/s^2] (default: 9.81 down the up axis, z if a file has none)",
    )
    _add_load_options(motion)
    motion.add_argument("--damping", type=per_second, metavar="C", help="mass-proportional damping [1/s] (default: 2)")
    motion.add_argument(
        "--viscosity",
        type=seconds,
        metavar="S",
        help="stiffness-proportional damping: viscous over elastic stress at one strain [s]; a vibration of angular "
        "frequency w decays by S w^2 / 2 (default: 0)",
    )
    motion.add_argument("--duration", type=seconds, metavar="T", help="simulated time [s] (default: 4)")
    motion.add_argument("--fps", type=number, default=FPS, metavar="F", help=f"frames per second (default: {FPS:g})")
    motion.add_argument(
        "--dt",
        type=seconds,
        help="time step [s], shortened so that a whole number of them makes a frame (default: the step follows the "
        f"state; {1e3 * IMPLICIT_DT:g} ms with an implicit --integrator)",
    )
    motion.add_argument(
        "--integrator",
        choices=STEPPING,
        help="explicit, symplectic-euler, whose steps are bound by the smallest element, or an implicit one for steps "
        "of any length (default: symplectic-euler, or backward-euler where explicit steps would be slower than real "
        "time and less than half as fast)",
    )

    _add_touch_options(parser.add_argument_group("contact"))
    _add_remesh_options(parser.add_argument_group("a mesh that follows the motion, of box, surfaces and scans"))


def _add_load_options(group: argparse._ArgumentGroup) -> None:
    """Add the options to a group of the command's parser."""
    for kind, (count, names) in LOADS.items():
        group.add_argument(
            f"--{kind}",
            action="append",
            nargs=1 + count,
            metavar=("PATCH", *names.split()),
            help={
                "pull": "move a patch by this much [m], for example 0 0 3cm",
                "twist": "turn a patch about its mean normal, counter-clockwise seen from outside",
                "press": "press on the surface of a patch, along its normals at rest; a negative pressure pulls",
            }[kind],
        )
    group.add_argument(
        "--ramp",
        type=seconds,
        metavar="T",
        help="time in which pulls, twists and pressures grow to their full values [s] (default: half of the duration)",
    )


def _add_touch_options(group: argparse._ArgumentGroup) -> None:
    """Add the options to a group of the command's parser."""
    group.add_argument(
        "--ground",
        type=ground_height,
        nargs="?",
        const=AUTO,
        metavar="HEIGHT",
        help="put a ground at this height against gravity [m], or just below the bodies (auto, the default height); "
        "bodies stand on it, and nothing is fixed without --fix",
    )
    group.add_argument(
        "--no-ground",
        action="store_true",
        help="hold a body that would lie on a ground, because it has no flat feet to stand on, at a flat region or a "
        "broad side",
    )
    group.add_argument(
        "--drop",
        type=metres,
        metavar="HEIGHT",
        help="let the bodies fall freely onto a ground this far below them [m]",
    )
    group.add_argument(
        "--tool",
        type=tool_shape,
        action="append",
        metavar="SHAPE",
        help="press with a rigid tool: sphere:r=5mm, capsule:r=4mm,l=100mm, cylinder:r=4mm,l=100mm or "
        "box:x=2cm,y=2cm,z=5mm, with its axis along z; a friction=MU of its own may follow; can be given several times",
    )
    group.add_argument(
        "--tool-path",
        type=Path,
        action="append",
        metavar="PATH.csv",
        help="how the tool moves: rows of time [s], x, y, z of its centre [m] and, if it turns, quaternions qx, qy, "
        "qz, qw; one row for a tool that stays; one path for each --tool, in the same order",
    )
    group.add_argument(
        "--touch", action="store_true", help="let the bodies touch one another; always on with a ground or a tool"
    )
    group.add_argument("--self-contact", action="store_true", help="let the bodies touch themselves, too")
    group.add_argument(
        "--friction", type=number, metavar="MU", help="coefficient of friction of all contacts (default: 0.3)"
    )


def _add_remesh_options(group: argparse._ArgumentGroup) -> None:
    """Add the options to a group of the command's parser."""
    group.add_argument(
        "--remesh",
        action="store_true",
        help="refine tetrahedra where they are stretched, and merge them again elsewhere",
    )
    group.add_argument(
        "--refine-above",
        type=number,
        metavar="X",
        help=f"bisect elements whose longest edge is more than X times as long as at rest (default: {REFINE_ABOVE:g})",
    )
    group.add_argument(
        "--simplify-below",
        type=number,
        metavar="X",
        help=f"merge elements whose longest edge is less than X times as long as at rest (default: {SIMPLIFY_BELOW:g})",
    )
    group.add_argument(
        "--remesh-levels",
        type=whole_number,
        nargs=2,
        metavar=("MIN", "MAX"),
        help="minimum and maximum number of bisections of a cube (default: nowhere fewer than at the start, and up to "
        "three more than its most)",
    )
    group.add_argument(
        "--remesh-every",
        type=whole_number,
        metavar="N",
        help=f"steps from one pass of remeshing to the next (default: {REMESH_EVERY})",
    )
    group.add_argument(
        "--capacity",
        type=whole_number,
        metavar="N",
        help="largest number of tetrahedra (default: four times the number at the start, or 100000)",
    )
