"""``warp-corot simulate``: a mesh in, an animation out."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from contextlib import closing, nullcontext
from typing import TYPE_CHECKING

from warp_corot.errors import InputError, UnstableError
from warp_corot.inputs.stopwatch import WATCH
from warp_corot.simulation.simulation import Simulation

from .about import about
from .bodies import RunBody
from .exit_status import early_end
from .previews import Previews, check_preview
from .probing import Table
from .run_file import bodies_of, check_run_path, write_run
from .run_setup import RunSetup, set_up
from .static import rest
from .summary import summary, title_of

if TYPE_CHECKING:
    from warp_corot.io.write.animate import Progress, Recording
    from warp_corot.io.write.skins import OwnSurface
    from warp_corot.mesh.surfaces.bound import SurfaceMesh


def run(args: argparse.Namespace) -> int:
    """Run the command; returns the exit status.

    Raises:
        InputError: Bad options; nothing was simulated or written.
    """
    from warp_corot.io.write.animate import Recording

    options = bodies_of(args)
    shared = options[0]
    _check_output(args, shared)
    ready = set_up(options)
    done = Recording(shared.output)
    table = Table(shared.csv, ready.sim, ready.probes, ready.touched.obstacles) if shared.csv else None
    previews = Previews(shared, ready.count) if shared.preview and ready.sim.is_root else None
    try:
        if args.write_run is not None and ready.sim.is_root:
            write_run(args.write_run, options)
        with WATCH.part("solving"):
            rested = rest(shared, ready.sim)
        _record(args, shared, ready, done, table, previews)
        if previews is not None:
            with WATCH.part("drawing"):
                previews.draw(ready.bodies, title_of(ready.bodies, ready.sim.gravity))
    except (KeyboardInterrupt, UnstableError, OSError) as error:
        return early_end(error, done)
    print(summary(ready.bodies, ready.sim, done, ready.touched.rows, rested))
    return 0


def simulated(args: argparse.Namespace) -> Recording:
    """``run`` without a summary, for one run of many.

    Raises:
        InputError, UnstableError, OSError: The errors that would end the command.
    """
    from warp_corot.io.write.animate import Recording

    options = bodies_of(args)
    shared = options[0]
    _check_output(args, shared)
    # Runs that are compared have the same kind of steps.
    ready = set_up(options, chooses=False)
    done = Recording(shared.output)
    table = Table(shared.csv, ready.sim, ready.probes, ready.touched.obstacles) if shared.csv else None
    rest(shared, ready.sim)
    _record(args, shared, ready, done, table, None)
    return done


def _check_output(args: argparse.Namespace, shared: argparse.Namespace) -> None:
    """Check, before a long run, that its results can be written."""
    from warp_corot.io.files.whole import check_output
    from warp_corot.io.write import check_also
    from warp_corot.io.write.animate import frame_count
    from warp_corot.io.write.usd.pieces import PieceStore

    if shared.output is None:
        raise InputError("-o is missing; it must name the animation to write, for example -o out.usd")
    if shared.duration is not None:
        frame_count(shared.duration, shared.fps)
    PieceStore(shared.output)  # checks the path, and writes nothing before the first frame
    for other in shared.also or ():
        check_also(other)
    if shared.csv is not None:
        check_output(shared.csv, (".csv",))
    check_preview(shared)
    if args.write_run is not None:
        check_run_path(args.write_run, args.input)


def _record(
    args: argparse.Namespace,
    shared: argparse.Namespace,
    ready: RunSetup,
    done: Recording,
    table: Table | None,
    previews: Previews | None,
) -> None:
    """Step the simulation and write its frames."""
    from warp_corot.io.write.animate import progress_bar, record

    bodies, sim = ready.bodies, ready.sim
    with progress_bar(ready.count) as progress, nullcontext() if table is None else closing(table):
        record(
            sim,
            shared.output,
            duration=ready.duration or None,
            fps=shared.fps,
            surface=_surfaces(bodies, are_cut=sim.remeshing.are_cut),
            tets=any(body.args.draw_tets for body in bodies) or None,
            labels=any(body.args.draw_labels for body in bodies),
            also=shared.also or (),
            progress=_each_frame(progress, table, previews, bodies, sim),
            recording=done,
            about=about(args, bodies),
        )


def _surfaces(bodies: Sequence[RunBody], *, are_cut: bool) -> list[OwnSurface | SurfaceMesh | None] | None:
    """The smooth surfaces of bodies; None if none has any, so that tetrahedra are drawn. Of those that are cut it is
    that of the mesh."""
    skins = [None if are_cut else body.subject.skin for body in bodies]
    found = [
        None if body.args.draw_labels else skin or body.subject.surface
        for body, skin in zip(bodies, skins, strict=True)
    ]
    return found if any(surface is not None for surface in found) else None


def _each_frame(
    progress: Progress, table: Table | None, previews: Previews | None, bodies: Sequence[RunBody], sim: Simulation
) -> Progress:
    """The function that is called after each frame."""

    def called(frame: int, count: int) -> None:
        if table is not None:
            with WATCH.part("writing"):
                table.add()
        if previews is not None:
            with WATCH.part("drawing"):
                previews.add(frame, bodies, sim)
        progress(frame, count)

    return called
