"""``warp-corot simulate``: a mesh in, an animation out."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from warp_corot.body.soft_body import SoftBody
from warp_corot.elasticity import MODELS, Corotated, Model
from warp_corot.errors import InputError, UnstableError
from warp_corot.holding.choice import NAMED
from warp_corot.inputs.device import checked_device
from warp_corot.materials.isotropic import Isotropic
from warp_corot.remesh.online import OnlineRemesh
from warp_corot.simulation.parts import checked_gravity
from warp_corot.simulation.simulation import Simulation
from warp_corot.solvers import SymplecticEuler

from .about import about
from .applies import refuse_options
from .compiling import compiling_said
from .holding import Held, held_as_told, held_by_default, up_of
from .label_materials import covers_all, label_material, region_material
from .loading import Load, loads_of, move_patches, press_patches
from .opened import Opened, open_input
from .options import add_parser
from .organs import find_organ
from .patches import Patches
from .previews import Previews, check_preview
from .probing import Probe, Table, check_table_path, probes_body
from .remesh import as_remesh_options, remesh_of
from .run_file import bodies_of, check_run_path, write_run
from .say import complain, interrupt_status
from .several import bodies_in
from .subject import Subject, find_subject
from .summary import pressure, summary
from .waiting import waiting

if TYPE_CHECKING:
    from warp_corot.io.write.animate import Progress, Recording
    from warp_corot.io.write.skins import OwnSurface
    from warp_corot.mesh.surfaces.bound import SurfaceMesh

__all__ = ["add_parser", "run"]

#: More steps to a frame than this are said beforehand.
MANY_STEPS = 1e5


@dataclass(eq=False)
class Body:
    """A body of a run.

    Attributes:
        args: Its options.
        subject: What is simulated, and defaults for it.
        opened: Its input.
        model: Its elastic model.
        remesh: How its mesh follows the motion, if it does.
        loads: What is done to it.
        patches: Its patches.
        held: What holds it.
        soft: The body itself.
        probes: What is measured of it.
    """

    args: argparse.Namespace
    opened: Opened
    model: Model
    remesh: OnlineRemesh | None
    loads: list[Load]
    subject: Subject = field(init=False)
    patches: Patches = field(init=False)
    held: Held = field(init=False)
    soft: SoftBody = field(init=False)
    probes: list[str] = field(default_factory=list)


def run(args: argparse.Namespace) -> int:
    """Run the command; returns the exit status.

    Raises:
        InputError: Bad options; nothing has been simulated or written.
    """
    from warp_corot.io.write.animate import Recording, frame_count, record

    options = bodies_of(args)
    shared = options[0]
    if shared.output is None:
        raise InputError("-o is needed: the animation to write, such as -o out.usd")
    if shared.duration is not None:
        frame_count(shared.duration, shared.fps)
    _check_output(shared)
    if args.write_run is not None:
        check_run_path(args.write_run, args.input)
    device = checked_device(shared.device)
    inputs = []
    for each in options:
        with waiting(f"reading {each.input}"):
            inputs.append(_checked(each))
    bodies = [body for found in inputs for body in found]
    with compiling_said(device):
        for body in bodies:
            with waiting(f"meshing {body.args.input}"):
                body.subject = _found(body)
        duration, count = _frames(shared, bodies)
        started = time.perf_counter()
        for found in inputs:
            _find_patches(found)
        for body in bodies:
            _make_body(body, duration)
        with waiting("preparing the simulation"):
            sim = _make_simulation(shared, bodies)
        ramp = _ramp(shared, duration)
        for body in bodies:
            press_patches(sim, body.soft, body.loads, body.patches, ramp)
        probes = [Probe(text, body.soft, body.patches) for body in bodies for text in body.probes]
    bodies[0].subject.times["body"] = time.perf_counter() - started
    steps = 1.0 / (shared.fps * sim.dt)
    if steps > MANY_STEPS:
        bodies[0].subject.notes.append(f"{steps:.2g} steps of {sim.dt:.2g} s make a frame: this will take long")
    _say_notes(bodies)

    done = Recording(shared.output)
    table = Table(shared.csv, sim, probes) if shared.csv else None
    previews = Previews(shared, count) if shared.preview else None
    try:
        if args.write_run is not None:
            write_run(args.write_run, options)
        with progress_bar(count) as progress, nullcontext() if table is None else closing(table):
            record(
                sim,
                shared.output,
                duration=duration,
                fps=shared.fps,
                surface=_surfaces(bodies),
                tets=any(body.args.draw_tets for body in bodies) or None,
                labels=any(body.args.draw_labels for body in bodies),
                also=shared.also or (),
                progress=_each_frame(progress, table, previews, bodies, sim),
                recording=done,
                about=about(args, bodies),
            )
        if previews is not None:
            previews.draw(bodies, _preview_title(bodies))
    except KeyboardInterrupt as signalled:
        complain(f"interrupted; {kept_so_far(done)}", kind="")
        return interrupt_status(signalled)
    except UnstableError as error:
        complain(f"{error}; {kept_so_far(done)}")
        return 3
    except OSError as error:
        complain(str(error))
        return 1
    print(summary(bodies, sim, done))
    return 0


def _checked(args: argparse.Namespace) -> list[Body]:
    """The bodies of an input, their options looked at as far as that goes before there are meshes."""
    model = _model(args.model, args.rotation_level)
    opened = open_input(args.input)
    refuse_options(args, opened)
    remesh, loads = remesh_of(args, opened.kind), loads_of(args)
    return [Body(own, part, model, remesh, loads) for part, own in bodies_in(opened, args)]


def _found(body: Body) -> Subject:
    args = body.args
    find = find_subject if body.opened.kind in ("box", "tets") else find_organ
    subject = find(body.opened, args)
    for output in (args.output, *(args.also or ())):
        if subject.source and output.exists() and output.samefile(subject.source):
            raise InputError(f"{output}: is the input, should be another file")
    return subject


def _frames(args: argparse.Namespace, bodies: Sequence[Body]) -> tuple[float, int]:
    """The duration [s], and how many frames follow the first."""
    from warp_corot.io.write.animate import frame_count

    duration = max(body.subject.duration for body in bodies) if args.duration is None else args.duration
    return duration, frame_count(duration, args.fps)


def _ramp(args: argparse.Namespace, duration: float) -> float:
    return 0.5 * duration if args.ramp is None else args.ramp


def _say_notes(bodies: Sequence[Body]) -> None:
    for body in bodies:
        name = f"{body.subject.name}: " if len(bodies) > 1 else ""
        for note in body.subject.notes:
            complain(f"{name}{note}", kind="note")


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


def _check_output(args: argparse.Namespace) -> None:
    """Say before a long run what would stop its results from being written."""
    from warp_corot.io.write import check_also
    from warp_corot.io.write.usd.pieces import PieceStore

    PieceStore(args.output)  # checks, and writes nothing before the first frame
    for other in args.also or ():
        check_also(other)
    if args.csv is not None:
        check_table_path(args.csv)
    check_preview(args)


def _model(name: str, rotation_level: int | None) -> Model:
    if rotation_level is None:
        return MODELS[name]()
    if name != "corotated":
        raise InputError(f"--rotation-level is {rotation_level}, but only --model corotated has rotations, not {name}")
    return Corotated(rotation_level=rotation_level)


def _find_patches(bodies: Sequence[Body]) -> None:
    """Find the patches of all bodies of an input, each of which has the loads and probes whose patch it has."""
    args = bodies[0].args
    probes, loads = list(args.probe or ()), bodies[0].loads
    if probes and args.csv is None:
        raise InputError("--probe is for --csv, which is not given")
    for body in bodies:
        gravity = _gravity(args, body.subject)
        body.patches = Patches(body.subject, up_of(body.subject, gravity), args.patch or ())
        body.loads, body.probes = loads, probes
        if len(bodies) > 1:
            body.loads = [load for load in loads if body.patches.nodes(load.patch).any()]
            body.probes = [text for text in probes if probes_body(text, body.patches)]
    for load in loads:
        if not any(load in body.loads for body in bodies):
            raise InputError(f"--{load.kind} {load.patch!r}: there are no nodes in it")
    for text in probes:
        if not any(text in body.probes for body in bodies):
            raise InputError(f"--probe {text!r}: is in none of the bodies")


def _make_body(body: Body, duration: float) -> None:
    """Make the body, held, and have its patches move as told."""
    args, subject = body.args, body.subject
    gravity = _gravity(args, subject)
    material, chosen = _material(args, subject, body.patches)
    expressions = args.fix if args.fix is not None else None if subject.fix is None else [subject.fix]
    if expressions is None:
        body.held, stiffer = held_by_default(subject, material, gravity, may_stiffen=chosen is not None)
        if stiffer > 1.0:
            material, chosen = _material(args, subject, body.patches, stiffer)
    else:
        moved = any(load.kind != "press" for load in body.loads)
        body.held = held_as_told(subject, body.patches, expressions, moved)
    if chosen is not None:
        rest = " of the others" if subject.labels else ""
        subject.notes.append(f"Young's modulus{rest} is {pressure(chosen)}, chosen for the weight (--young)")
    body.soft = SoftBody(subject.mesh, material, device=args.device)
    body.soft.fix(body.held.nodes)
    move_patches(body.soft, body.loads, body.patches, _ramp(args, duration))


def _gravity(args: argparse.Namespace, subject: Subject) -> np.ndarray:
    given = subject.gravity if args.gravity is None else tuple(args.gravity)
    return np.array(checked_gravity(given, subject.mesh.up_axis))


def _material(
    args: argparse.Namespace, subject: Subject, patches: Patches, stiffer: float = 1.0
) -> tuple[Isotropic, float | None]:
    """The material, and Young's modulus [Pa] where it was chosen for the body's weight, so many times as stiff."""
    density = subject.density if args.density is None else args.density
    poisson = subject.poisson if args.poisson is None else args.poisson
    Isotropic(1.0, poisson, density)  # both must be checked before they are used
    young = subject.young if args.young is None else args.young
    covered = bool(subject.labels) and covers_all(subject.mesh, subject.labels)
    if covered and args.young is not None:
        raise InputError("--young is given, but --materials gives each label its own")
    chosen = None
    if young is None:
        young = float(f"{stiffer * subject.young_from_weight(density, args.gravity):.1e}")
        chosen = None if covered else young
    if subject.labels:
        material = label_material(subject.mesh, subject.labels, young, poisson, density)
    else:
        material = Isotropic(young, poisson, density)
    if args.region:
        material = region_material(subject.mesh, patches, args.region, material)
    return material, chosen


def _make_simulation(args: argparse.Namespace, bodies: Sequence[Body]) -> Simulation:
    """The simulation, its kernels compiled; a given step is shortened until a whole number of them makes a frame."""
    from warp_corot.io.write.animate import steps_per_frame

    first = bodies[0].subject
    damping = first.damping if args.damping is None else args.damping
    viscosity = args.viscosity or 0.0
    SymplecticEuler(args.dt, damping, viscosity)  # checks all, the step before it is shortened
    tried = min(_tried_step(body, damping, viscosity) for body in bodies)
    steps = steps_per_frame(args.fps, args.dt or tried)  # refuses more than anybody can wait for
    dt = None if args.dt is None else 1.0 / (args.fps * steps)
    with as_remesh_options():
        return Simulation(
            [body.soft for body in bodies],
            model=[body.model for body in bodies],
            integrator=SymplecticEuler(dt, damping, viscosity),
            gravity=_gravity(args, first),
            remesh=[body.remesh for body in bodies] if any(body.remesh for body in bodies) else None,
        )


def _tried_step(one: Body, damping: float, viscosity: float) -> float:
    """The length of a step [s] that was made at rest and without weight: it loads every kernel and moves nothing."""
    tried = body = one.soft
    model, remesh = one.model, one.remesh
    if remesh:
        # The body's own mesh is not to change before it begins.
        tried, remesh = SoftBody(body.mesh, body.material, device=body.device), replace(remesh, every=1)
        tried.fix(body.constrained)
    integrator = SymplecticEuler(damping=damping, viscosity=viscosity)
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


def _preview_title(bodies: Sequence[Body]) -> str:
    names, held = [body.subject.name for body in bodies], bodies[0].held
    left = len(names) - NAMED
    name = ", ".join(names[:NAMED]) + (f" and {left} more" if left > 0 else "")
    return f"{name}, {(held.title or held.words) if len(bodies) == 1 else 'dots where they are held'}"
