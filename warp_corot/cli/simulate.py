"""``warp-corot simulate``: a mesh in, an animation out."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..body import SoftBody
from ..device import checked_device
from ..elasticity import MODELS, Corotated, Model
from ..errors import InputError, UnstableError
from ..materials import Isotropic
from ..mesh import TetForest
from ..remesh.online import OnlineRemesh
from ..selection import select_nodes
from ..simulation import Simulation
from ..solvers import SymplecticEuler
from .compiling import compiling_said
from .label_materials import label_material
from .options import add_parser
from .organs import find_organ, kind_of, refuse_options
from .remesh import as_remesh_options, remesh_of
from .say import complain, interrupt_status
from .subject import Subject, find_subject
from .summary import pressure, summary

if TYPE_CHECKING:
    from ..io.animate import Progress, Recording

__all__ = ["add_parser", "run"]

#: More steps to a frame than this are said beforehand.
MANY_STEPS = 1e5


def run(args: argparse.Namespace) -> int:
    """Run the command; returns the exit status.

    Raises:
        InputError: Bad options; nothing has been simulated or written.
    """
    from ..io.animate import Recording, frame_count, record

    if args.duration is not None:
        frame_count(args.duration, args.fps)
    _check_output(args.output, args.preview)
    device = checked_device(args.device)
    model = _model(args.model, args.rotation_level)
    kind = kind_of(args.input)
    refuse_options(args, kind)
    remesh = remesh_of(args, kind)
    with compiling_said(device):
        subject = find_subject(args.input, args.scale) if kind == "tets" else find_organ(args, kind)
        if subject.source and args.output.exists() and args.output.samefile(subject.source):
            raise InputError(f"{args.output}: is the input, should be another file")
        duration = subject.duration if args.duration is None else args.duration
        count = frame_count(duration, args.fps)
        started = time.perf_counter()
        body, fixed = _make_body(args, subject)
        sim = _make_simulation(args, subject, body, model, remesh)
    subject.times["body"] = time.perf_counter() - started
    steps = 1.0 / (args.fps * sim.dt)
    if steps > MANY_STEPS:
        subject.notes.append(f"{steps:.2g} steps of {sim.dt:.2g} s make a frame: this will take long")
    for note in subject.notes:
        complain(note, kind="note")

    done = Recording(args.output)
    try:
        with progress_bar(count) as progress:
            record(
                sim,
                args.output,
                duration=duration,
                fps=args.fps,
                surface=None if args.draw_labels else subject.surface,
                tets=args.draw_tets or None,
                labels=args.draw_labels,
                progress=progress,
                recording=done,
            )
        if args.preview:
            _draw(args.preview, subject, sim)
    except KeyboardInterrupt as signalled:
        complain(f"interrupted; {kept_so_far(done)}", kind="")
        return interrupt_status(signalled)
    except UnstableError as error:
        complain(f"{error}; {kept_so_far(done)}")
        return 3
    except OSError as error:
        complain(str(error))
        return 1
    print(summary(subject, sim, done, fixed, args.preview))
    return 0


def _check_output(output: Path, preview: Path | None) -> None:
    """Say before a long run what would stop its results from being written."""
    from ..io.preview import check_picture_path
    from ..io.usd_pieces import PieceStore

    PieceStore(output)  # checks, and writes nothing before the first frame
    if preview is not None:
        if find_spec("matplotlib") is None:
            raise InputError('--preview needs Matplotlib: pip install "warp-corot[plot]"')
        check_picture_path(preview)


def _model(name: str, rotation_level: int | None) -> Model:
    if rotation_level is None:
        return MODELS[name]()
    if name != "corotated":
        raise InputError(f"--rotation-level is {rotation_level}, but only --model corotated has rotations, not {name}")
    return Corotated(rotation_level=rotation_level)


def _make_body(args: argparse.Namespace, subject: Subject) -> tuple[SoftBody, str]:
    """The body, and the expression that its fixed nodes come from."""
    material = _material(args, subject)
    used = subject.used
    expression = subject.fix if args.fix is None else args.fix
    chosen = expression if expression is not None else subject.lowest_part()
    fixed = select_nodes(chosen, subject.mesh.points, bounds=subject.bounds)
    held = int(fixed[used].sum())
    if expression is None:
        share = f"the lowest {subject.held_share:.0%} of the height".replace("%", " %")
        subject.notes.append(f'{share} is held, {held} nodes (--fix "{chosen}")')
    if held == len(used):
        raise InputError(f"expression {chosen!r}: holds all {held} nodes, at least one must be free to move")
    if held == 0:
        subject.notes.append(f"no node is held ({chosen!r}): the body falls freely")

    body = SoftBody(subject.mesh, material, device=args.device)
    body.fix(fixed)
    return body, f"{held} nodes ({chosen})"


def _material(args: argparse.Namespace, subject: Subject) -> Isotropic:
    density = subject.density if args.density is None else args.density
    poisson = subject.poisson if args.poisson is None else args.poisson
    Isotropic(1.0, poisson, density)  # both must be checked before they are used
    if subject.labels:
        assert isinstance(subject.mesh, TetForest)
        return label_material(subject.mesh, subject.labels, poisson, density)
    young = subject.young if args.young is None else args.young
    if young is None:
        young = subject.young_from_weight(density, args.gravity)
        subject.notes.append(f"Young's modulus is {pressure(young)}, chosen for its weight (--young)")
    return Isotropic(young, poisson, density)


def _make_simulation(
    args: argparse.Namespace, subject: Subject, body: SoftBody, model: Model, remesh: OnlineRemesh | None
) -> Simulation:
    """The simulation, its kernels compiled; a given step is shortened until a whole number of them makes a frame."""
    from ..io.animate import steps_per_frame

    damping = subject.damping if args.damping is None else args.damping
    gravity = subject.gravity if args.gravity is None else tuple(args.gravity)
    SymplecticEuler(args.dt, damping)  # checks both, the step before it is shortened
    tried = _tried_step(body, model, damping, remesh)
    steps = steps_per_frame(args.fps, args.dt or tried)  # refuses more than anybody can wait for
    dt = None if args.dt is None else 1.0 / (args.fps * steps)
    with as_remesh_options():
        return Simulation(body, model=model, integrator=SymplecticEuler(dt, damping), gravity=gravity, remesh=remesh)


def _tried_step(body: SoftBody, model: Model, damping: float, remesh: OnlineRemesh | None) -> float:
    """The length of a step [s] that was made at rest and without weight: it loads every kernel and moves nothing."""
    tried = body
    if remesh:
        # The body's own mesh is not to change before it begins.
        tried, remesh = SoftBody(body.mesh, body.material, device=body.device), replace(remesh, every=1)
        tried.fix(body.constrained)
    integrator = SymplecticEuler(damping=damping)
    with as_remesh_options():
        trial = Simulation(tried, model=model, integrator=integrator, gravity=(0, 0, 0), remesh=remesh)
    dt = trial.dt
    trial.step()
    trial.von_mises()
    if tried is body:
        body.displacements = body.velocities = np.zeros_like(body.mesh.points)
    return dt


@contextmanager
def progress_bar(count: int) -> Iterator[Progress]:
    from tqdm import tqdm

    form = "{desc}  {percentage:3.0f} % |{bar}| frame {n_fmt} of {total_fmt}, {remaining} left"
    with tqdm(desc="simulating", total=count, leave=False, disable=None, file=sys.stderr, bar_format=form) as bar:
        yield lambda frame, _: bar.update(frame - bar.n)


def kept_so_far(done: Recording) -> str:
    if not done.frames:
        return "no frame was written"
    return f"{done.frames} frames, {done.simulated:.3g} s, are kept in {done.path}"


def _draw(path: Path, subject: Subject, sim: Simulation) -> None:
    from ..io.colors import VertexAverage
    from ..io.preview import render_preview
    from ..io.skins import BoundSkins
    from ..mesh.surface import signed_volumes

    mesh = sim.body.mesh
    (skin,) = BoundSkins([mesh], subject.surface, changing=[mesh is not subject.mesh]).on([mesh])
    average = VertexAverage(mesh.tets, np.abs(signed_volumes(mesh.points, mesh.tets)), len(mesh.points))
    render_preview(
        path,
        skin.surface.moved(sim.body.displacements.numpy()),
        skin.surface.triangles,
        scalars=skin.values(average(sim.von_mises())),
        rest=skin.surface.points,
        up_axis=mesh.up_axis,
        title=f"{subject.name}, {sim.time:.3g} s",
    )
