"""``warp-corot simulate``: a mesh in, an animation out."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
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
from ..selection import select_nodes
from ..simulation import Simulation
from ..solvers import SymplecticEuler
from .compiling import compiling_said
from .label_materials import FORM, label_material
from .organs import MAX_LEVEL, TETS, find_organ, kind_of, refuse_options
from .say import EXIT_CODES, complain, interrupt_status
from .subject import STIFFNESS_PER_WEIGHT, Subject, find_subject
from .summary import pressure, summary

if TYPE_CHECKING:
    from ..io.animate import Progress, Recording

FPS = 24.0

#: More steps to a frame than this are said beforehand.
MANY_STEPS = 1e5


def add_parser(subparsers: argparse._SubParsersAction) -> argparse.ArgumentParser:
    """Add the command to ``warp-corot``."""
    parser = subparsers.add_parser(
        "simulate",
        help="let a soft body move and write it as a USD animation",
        description="Lets a soft body sag and sway under gravity and writes a USD animation, coloured by stress.",
        epilog=f"""examples:
  warp-corot simulate warp:bear -o bear.usd
  warp-corot simulate liver.msh --scale 0.001 --young 5000 --fix "z < zmin + 0.01" -o liver.usd --preview liver.png
  warp-corot simulate liver.stl --unit mm --tets 50000 -o liver.usd
  warp-corot simulate scan.nii.gz --labels liver=3kPa:0.45,vessel=30kPa:0.45 -o scan.usd
  warp-corot simulate box --model linear -o beam.usd

expressions for --fix:
  names      x y z (rest coordinates [m], after --scale), xmin xmax ymin ymax zmin zmax, pi, all, none
  operators  + - * / // % **   < <= > >= == !=   and or not   ( )
  functions  abs sqrt exp log sin cos tan atan2 hypot min max

a label in --labels is {FORM}: a name and the numbers of its voxels,
or a number for both; names alone are the volume's labels in ascending order.

warp:bear, warp:bunny and box have defaults of their own for body and motion.

{EXIT_CODES}""",
    )
    parser.add_argument(
        "input",
        metavar="INPUT",
        help="tetrahedra: a USD file with a TetMesh, or a Mesh with tetraIndices; a file that meshio reads (.msh, "
        ".vtk, .vtu, ...); warp:bear, a toy bear; or box, the beam of Tagawa et al. 2013. A closed surface: .obj, "
        ".stl, .ply, .off, .glb, a USD file with Mesh prims alone; or warp:bunny. A segmented scan: .nii, .nii.gz, "
        ".mha, .mhd, .nrrd or .vti",
    )
    parser.add_argument(
        "-o", "--output", required=True, type=Path, metavar="OUT.usd", help="animation to write (.usd, .usdc or .usda)"
    )

    body = parser.add_argument_group("the body")
    body.add_argument("--scale", type=float, metavar="S", help="factor on the coordinates, e.g. 0.001 for a mesh in mm")
    body.add_argument(
        "--young",
        type=float,
        metavar="E",
        help=f"Young's modulus [Pa] (default: {STIFFNESS_PER_WEIGHT:g} times density, gravity and height, with which "
        "a body visibly sags and stands)",
    )
    body.add_argument("--poisson", type=float, metavar="NU", help="Poisson's ratio (default: 0.45)")
    body.add_argument("--density", type=float, metavar="RHO", help="mass density [kg/m^3] (default: 1000)")
    body.add_argument("--model", choices=MODELS, default="corotated", help="elastic model (default: corotated)")
    body.add_argument(
        "--rotation-level",
        type=int,
        metavar="L",
        help="corotated box: take rotations from the tree's level L only (default: every element has its own)",
    )
    body.add_argument(
        "--fix",
        metavar="EXPR",
        help='nodes that are held, such as "z < 0.01", or none (default: the lowest 2 %% of the height)',
    )

    _add_organ_options(parser.add_argument_group("a body from a surface or a scan"))

    motion = parser.add_argument_group("the motion")
    motion.add_argument(
        "--gravity",
        type=float,
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="[m/s^2] (default: 9.81 down the up axis, z where a file names none)",
    )
    motion.add_argument("--damping", type=float, metavar="C", help="mass-proportional damping [1/s] (default: 2)")
    motion.add_argument("--duration", type=float, metavar="T", help="simulated time [s] (default: 4)")
    motion.add_argument("--fps", type=float, default=FPS, metavar="F", help=f"frames per second (default: {FPS:g})")
    motion.add_argument(
        "--dt",
        type=float,
        help="time step [s], shortened so that a whole number makes a frame (default: a safe one, found)",
    )

    parser.add_argument("--device", help='"cpu", "cuda:0", ... (default: a GPU if there is one)')
    parser.add_argument("--preview", type=Path, metavar="FILE.png", help="also draw the last frame")
    return parser


def _add_organ_options(organ: argparse._ArgumentGroup) -> None:
    organ.add_argument(
        "--unit", choices=("mm", "cm", "m"), help="of the coordinates (default: what the file says, or m)"
    )
    organ.add_argument(
        "--tets",
        type=int,
        metavar="N",
        help=f"at most so many tetrahedra, and nearly as many (default: {TETS}, unless --max-level or --surface-error "
        "is given)",
    )
    organ.add_argument(
        "--cell-size", type=float, metavar="M", help="edge of the coarsest cubes [m] (default: by --tets)"
    )
    organ.add_argument(
        "--max-level",
        type=int,
        metavar="L",
        help=f"how often cubes are bisected at most, three times halve the edge (default: {MAX_LEVEL})",
    )
    organ.add_argument(
        "--surface-error",
        type=float,
        metavar="M",
        help="how far the surface may be from the given one [m] (default: as near as the rest allows)",
    )
    organ.add_argument(
        "--labels",
        metavar="LIST",
        help="of a scan: the labels that make the body and their materials, as in liver=3kPa:0.45,vessel@4=30kPa:0.45 "
        "(default: all, of one material)",
    )
    organ.add_argument(
        "--smoothing", type=float, metavar="M", help="take the steps of voxels off, over this length [m]"
    )
    organ.add_argument("--draw-tets", action="store_true", help="write the tetrahedra too, not the surface alone")
    organ.add_argument("--draw-labels", action="store_true", help="write a closed surface for each label")


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
    with compiling_said(device):
        subject = find_subject(args.input, args.scale) if kind == "tets" else find_organ(args, kind)
    if subject.source and args.output.exists() and args.output.samefile(subject.source):
        raise InputError(f"{args.output}: is the input, should be another file")
    duration = subject.duration if args.duration is None else args.duration
    count = frame_count(duration, args.fps)
    started = time.perf_counter()
    with compiling_said(device):
        body, fixed = _make_body(args, subject)
        sim = _make_simulation(args, subject, body, model)
    subject.times["body"] = time.perf_counter() - started
    steps = 1.0 / (args.fps * sim.dt)
    if steps > MANY_STEPS:
        subject.notes.append(f"{steps:.2g} steps of {sim.dt:.2g} s make a frame: this will take long")
    for note in subject.notes:
        complain(note, kind="note")

    done = Recording(args.output)
    try:
        with _progress_bar(count) as progress:
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
        complain(f"interrupted; {_kept(done)}", kind="")
        return interrupt_status(signalled)
    except UnstableError as error:
        complain(f"{error}; {_kept(done)}")
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
        subject.notes.append(f'the lowest 2 % of the height is held, {held} nodes (--fix "{chosen}")')
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


def _make_simulation(args: argparse.Namespace, subject: Subject, body: SoftBody, model: Model) -> Simulation:
    """The simulation with a whole number of steps to a frame, its kernels compiled."""
    from ..io.animate import steps_per_frame

    damping = subject.damping if args.damping is None else args.damping
    gravity = subject.gravity if args.gravity is None else tuple(args.gravity)
    SymplecticEuler(args.dt, damping)  # checks both, the step before it is shortened
    # At rest and without weight, a safe step loads every kernel and moves nothing.
    trial = Simulation(body, model=model, integrator=SymplecticEuler(damping=damping), gravity=(0, 0, 0))
    wanted = trial.dt if args.dt is None else args.dt
    dt = 1.0 / (args.fps * steps_per_frame(args.fps, wanted))
    sim = Simulation(body, model=model, integrator=SymplecticEuler(dt, damping), gravity=gravity)
    trial.step()
    trial.von_mises()
    body.displacements = body.velocities = np.zeros_like(body.mesh.points)
    return sim


@contextmanager
def _progress_bar(count: int) -> Iterator[Progress]:
    from tqdm import tqdm

    form = "{desc}  {percentage:3.0f} % |{bar}| frame {n_fmt} of {total_fmt}, {remaining} left"
    with tqdm(desc="simulating", total=count, leave=False, disable=None, file=sys.stderr, bar_format=form) as bar:
        yield lambda frame, _: bar.update(frame - bar.n)


def _kept(done: Recording) -> str:
    if not done.frames:
        return "no frame was written"
    return f"{done.frames} frames, {done.simulated:.3g} s, are kept in {done.path}"


def _draw(path: Path, subject: Subject, sim: Simulation) -> None:
    from ..io.colors import VertexAverage
    from ..io.preview import render_preview
    from ..io.skins import Skin, boundary_surface
    from ..mesh.surface import signed_volumes

    mesh = subject.mesh
    skin = Skin("surface", subject.surface or boundary_surface(mesh))
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
