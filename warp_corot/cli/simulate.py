"""``warp-corot simulate``: a mesh in, an animation out."""

from __future__ import annotations

import argparse
import hashlib
from collections.abc import Sequence
from contextlib import closing, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from warp_corot.errors import InputError, UnstableError
from warp_corot.inputs.stopwatch import WATCH
from warp_corot.simulation.simulation import Simulation

from .bodies import RunBody
from .results import Previews, Table, check_preview
from .run_file import bodies_of, check_run_path, write_run
from .run_setup import RunSetup, rest, set_up
from .summary import summary, title_of
from .terminal import early_end

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
    from warp_corot.io.write.paraview import check_also
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


# --- the description of a run in its stage ---------------------------------------------------------------------------

#: Replacement for bytes that are not UTF-8, which USD's strings must be.
_ERRORS = "backslashreplace"


def about(args: argparse.Namespace, bodies: Sequence[RunBody]) -> dict[str, Any]:
    """The command, its run file if any, and for each body its input's name and hash, its supports and its loads; for
    the layer's custom data.

    Args:
        args: The command's arguments.
        bodies: The bodies that it simulates.
    """
    said: dict[str, Any] = {"command": _text(getattr(args, "command_line", "warp-corot simulate"))}
    if args.input.lower().endswith(".toml"):
        said |= {"runFile": _text(args.input), "run": _text(Path(args.input).read_text(encoding="utf-8"))}
    return said | {f"body{number}": _of_body(body) for number, body in enumerate(bodies, start=1)}


def _of_body(body: RunBody) -> dict[str, Any]:
    subject, args = body.subject, body.args
    said = {"name": _text(subject.name), "input": _text(args.input), "held": body.held.words}
    if subject.source is not None:
        said["inputSha256"] = _hash(subject.source)
    for name in ("scale", "unit"):
        if getattr(args, name, None) is not None:
            said[name] = getattr(args, name)
    loads = "; ".join(map(str, body.loads))
    return said | ({"loads": _text(loads)} if loads else {})


def _hash(path: Path) -> str:
    """SHA-256 of a file; for a folder, of the names and contents of its files in order."""
    if not path.is_dir():
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    digest = hashlib.sha256()
    for inside in sorted(each for each in path.rglob("*") if each.is_file()):
        digest.update(str(inside.relative_to(path)).encode(errors=_ERRORS) + bytes.fromhex(_hash(inside)))
    return digest.hexdigest()


def _text(text: str) -> str:
    return text.encode("utf-8", errors=_ERRORS).decode("utf-8")
