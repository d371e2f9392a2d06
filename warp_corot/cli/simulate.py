"""``warp-corot simulate``: a mesh in, an animation out."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from contextlib import closing, nullcontext
from dataclasses import dataclass
from typing import TYPE_CHECKING

from warp_corot.errors import InputError, UnstableError
from warp_corot.inputs.device import checked_device
from warp_corot.simulation.simulation import Simulation

from .about import about
from .bodies import Body, asked_bodies, find_body, find_patches, make_body
from .compiling import compiling_said
from .loading import ramp_of
from .options import add_parser
from .pressing import press_patches
from .previews import Previews, check_preview
from .probing import Probe, Table, check_table_path
from .run_file import bodies_of, check_run_path, write_run
from .say import complain, interrupt_status, kept_so_far
from .stepping import make_simulation
from .summary import summary, title_of
from .waiting import progress_bar, waiting

if TYPE_CHECKING:
    from warp_corot.io.write.animate import Progress, Recording
    from warp_corot.io.write.skins import OwnSurface
    from warp_corot.mesh.surfaces.bound import SurfaceMesh

__all__ = ["add_parser", "run"]

#: The command says beforehand that a run will take long if a frame has more steps than this.
MANY_STEPS = 1e5


@dataclass(frozen=True, eq=False)
class Run:
    """A run that is ready to start.

    Attributes:
        bodies: What is simulated.
        sim: The simulation of all of them.
        probes: What the table tells of.
        duration: [s].
        count: How many frames follow the first.
    """

    bodies: Sequence[Body]
    sim: Simulation
    probes: Sequence[Probe]
    duration: float
    count: int


def run(args: argparse.Namespace) -> int:
    """Run the command; returns the exit status.

    Raises:
        InputError: Bad options; nothing has been simulated or written.
    """
    from warp_corot.io.write.animate import Recording

    options = bodies_of(args)
    shared = options[0]
    _check_output(args, shared)
    ready = _prepared(options)
    done = Recording(shared.output)
    table = Table(shared.csv, ready.sim, ready.probes) if shared.csv else None
    previews = Previews(shared, ready.count) if shared.preview else None
    try:
        if args.write_run is not None:
            write_run(args.write_run, options)
        _record(args, shared, ready, done, table, previews)
        if previews is not None:
            previews.draw(ready.bodies, title_of(ready.bodies))
    except KeyboardInterrupt as signalled:
        complain(f"interrupted; {kept_so_far(done)}", kind="")
        return interrupt_status(signalled)
    except UnstableError as error:
        complain(f"{error}; {kept_so_far(done)}")
        return 3
    except OSError as error:
        complain(str(error))
        return 1
    print(summary(ready.bodies, ready.sim, done))
    return 0


def _check_output(args: argparse.Namespace, shared: argparse.Namespace) -> None:
    """Say before a long run what would stop its results from being written."""
    from warp_corot.io.write import check_also
    from warp_corot.io.write.animate import frame_count
    from warp_corot.io.write.usd.pieces import PieceStore

    if shared.output is None:
        raise InputError("-o is needed: the animation to write, such as -o out.usd")
    if shared.duration is not None:
        frame_count(shared.duration, shared.fps)
    PieceStore(shared.output)  # checks, and writes nothing before the first frame
    for other in shared.also or ():
        check_also(other)
    if shared.csv is not None:
        check_table_path(shared.csv)
    check_preview(shared)
    if args.write_run is not None:
        check_run_path(args.write_run, args.input)


def _prepared(options: Sequence[argparse.Namespace]) -> Run:
    """Read and mesh the bodies, and set up their simulation.

    Args:
        options: Of each input.
    """
    shared = options[0]
    device = checked_device(shared.device)
    inputs = []
    for each in options:
        with waiting(f"reading {each.input}"):
            inputs.append(asked_bodies(each))
    bodies = [body for found in inputs for body in found]
    with compiling_said(device):
        for body in bodies:
            with waiting(f"meshing {body.args.input}"):
                body.subject = find_body(body)
        duration, count = _frames(shared, bodies)
        started = time.perf_counter()
        for found in inputs:
            find_patches(found)
        for body in bodies:
            make_body(body, duration)
        with waiting("preparing the simulation"):
            sim = make_simulation(shared, bodies)
        for body in bodies:
            press_patches(sim, body.soft, body.loads, body.patches, ramp_of(shared, duration))
        probes = [Probe(text, body.soft, body.patches) for body in bodies for text in body.probes]
    bodies[0].subject.times["body"] = time.perf_counter() - started
    steps = 1.0 / (shared.fps * sim.dt)
    if steps > MANY_STEPS:
        bodies[0].subject.notes.append(f"{steps:.2g} steps of {sim.dt:.2g} s make a frame: this will take long")
    _say_notes(bodies)
    return Run(bodies, sim, probes, duration, count)


def _frames(args: argparse.Namespace, bodies: Sequence[Body]) -> tuple[float, int]:
    """The duration [s], and how many frames follow the first."""
    from warp_corot.io.write.animate import frame_count

    duration = max(body.subject.duration for body in bodies) if args.duration is None else args.duration
    return duration, frame_count(duration, args.fps)


def _say_notes(bodies: Sequence[Body]) -> None:
    for body in bodies:
        name = f"{body.subject.name}: " if len(bodies) > 1 else ""
        for note in body.subject.notes:
            complain(f"{name}{note}", kind="note")


def _record(
    args: argparse.Namespace,
    shared: argparse.Namespace,
    ready: Run,
    done: Recording,
    table: Table | None,
    previews: Previews | None,
) -> None:
    """Step the simulation and write its frames."""
    from warp_corot.io.write.animate import record

    bodies, sim = ready.bodies, ready.sim
    with progress_bar(ready.count) as progress, nullcontext() if table is None else closing(table):
        record(
            sim,
            shared.output,
            duration=ready.duration,
            fps=shared.fps,
            surface=_surfaces(bodies),
            tets=any(body.args.draw_tets for body in bodies) or None,
            labels=any(body.args.draw_labels for body in bodies),
            also=shared.also or (),
            progress=_each_frame(progress, table, previews, bodies, sim),
            recording=done,
            about=about(args, bodies),
        )


def _surfaces(bodies: Sequence[Body]) -> list[OwnSurface | SurfaceMesh | None] | None:
    """The smooth surfaces of bodies; None if none has any, so that tetrahedra are drawn."""
    found = [None if body.args.draw_labels else body.subject.skin or body.subject.surface for body in bodies]
    return found if any(surface is not None for surface in found) else None


def _each_frame(
    progress: Progress, table: Table | None, previews: Previews | None, bodies: Sequence[Body], sim: Simulation
) -> Progress:
    """What is called after each frame."""

    def called(frame: int, count: int) -> None:
        if table is not None:
            table.add()
        if previews is not None:
            previews.add(frame, bodies, sim)
        progress(frame, count)

    return called
