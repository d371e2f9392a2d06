"""The bodies of a run: from options and an input to a mesh with its material, supports, loads and remeshing."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_corot.body.soft_body import SoftBody
from warp_corot.domain.units import pressure
from warp_corot.elasticity import MODELS, Corotated, Model
from warp_corot.errors import InputError
from warp_corot.holding.choice import Supports, supports_of
from warp_corot.materials.isotropic import Isotropic
from warp_corot.remesh.remeshing import OnlineRemesh
from warp_corot.simulation.parts import checked_gravity

from .input_file import InputFile, bodies_in, open_input, refuse_options, with_unit
from .input_mesh import InputMesh, find_organ, find_subject, mixed_material, region_entries
from .options import STIFFNESS_PER_WEIGHT, is_static
from .patches import BodyPatches, Load, loads_of, move_patches, ramp_of, up_of

#: A density below this [kg/m^3] is most likely meant in g/cm^3.
LIGHT = 5.0


@dataclass(eq=False)
class RunBody:
    """A body of a run.

    Attributes:
        args: Its options.
        subject: The mesh, and its defaults.
        opened: Its input.
        model: Its elastic model.
        remesh: Its remeshing, if any.
        loads: Its loads.
        patches: Its patches.
        held: Its fixed nodes, mask [N].
        held_words: Text for the summary: "standing on its lowest 10 %", "free".
        lies: Whether it needs a ground to lie on.
        soft: The body itself.
        probes: Its probes.
    """

    args: argparse.Namespace
    opened: InputFile
    model: Model
    remesh: OnlineRemesh | None
    loads: list[Load]
    subject: InputMesh = field(init=False)
    patches: BodyPatches = field(init=False)
    held: npt.NDArray[np.bool_] = field(init=False)
    held_words: str = ""
    lies: bool = False
    soft: SoftBody = field(init=False)
    probes: list[str] = field(default_factory=list)


def asked_bodies(args: argparse.Namespace) -> list[RunBody]:
    """The bodies of an input, with their options checked as far as possible without meshes."""
    model = model_of(args.model, args.rotation_level, args.dilatation)
    opened = open_input(args.input)
    refuse_options(args, opened)
    remesh, loads = remesh_of(args, opened.kind), loads_of(args)
    return [RunBody(own, part, model, remesh, loads) for part, own in bodies_in(with_unit(opened, args), args)]


def find_body(body: RunBody) -> InputMesh:
    args = body.args
    find = find_subject if body.opened.kind in ("box", "tets") else find_organ
    subject = find(body.opened, args)
    for output in (args.output, *(args.also or ())):
        if subject.source and output is not None and output.exists() and output.samefile(subject.source):
            raise InputError(f"{output}: is the input; it must be another file")
    return subject


def find_patches(bodies: Sequence[RunBody]) -> None:
    """Find the patches of all bodies of an input; each body gets the loads and probes on its patches."""
    args = bodies[0].args
    probes, loads = list(args.probe or ()), bodies[0].loads
    for body in bodies:
        gravity = gravity_of(args, body.subject)
        body.patches = BodyPatches(body.subject, up_of(body.subject, gravity), args.patch or ())
        body.loads, body.probes = loads, probes
        if len(bodies) > 1:
            body.loads = [load for load in loads if body.patches.nodes(load.patch).any()]
            body.probes = [text for text in probes if body.patches.has(text)]
    for load in loads:
        if not any(load in body.loads for body in bodies):
            raise InputError(f"--{load.kind} {load.patch!r}: there are no nodes in it")
    for text in probes:
        if not any(text in body.probes for body in bodies):
            raise InputError(f"--probe {text!r}: is in none of the bodies")


def make_body(body: RunBody, duration: float, *, alone: bool) -> None:
    """Make the body with its fixed nodes and moving patches; if it is alone, it may lie on a ground."""
    args, subject = body.args, body.subject
    gravity = gravity_of(args, subject)
    material, chosen = _material(args, subject, body.patches)
    # A ground carries the body in place of fixed nodes.
    free = args.fix is None and (args.ground is not None or args.drop is not None)
    expressions = ["none"] if free else args.fix
    if expressions is None and subject.fix is not None:
        expressions = [subject.fix]
    if expressions is None:
        may_lie = alone and not (body.loads or args.no_ground or is_static(args))
        holds, stiffer = held_by_default(subject, material, gravity, may_stiffen=chosen is not None, may_lie=may_lie)
        body.held, body.lies = holds.nodes, bool(holds.lies)
        body.held_words = "lying on a ground" if holds.lies else holds.words
        if stiffer > 1.0:
            material, chosen = _material(args, subject, body.patches, stiffer)
    else:
        moved = any(load.kind != "press" for load in body.loads)
        nodes = body.held = np.logical_or.reduce([body.patches.nodes(expression) for expression in expressions])
        said = " or ".join(expressions)
        if nodes.sum() == len(subject.used):
            raise InputError(f"expression {said!r}: holds all {nodes.sum()} nodes; at least one must be free to move")
        if not nodes.any() and not (moved or free):
            subject.notes.append(f"no node is held ({said!r}): the body falls freely")
        body.held_words = f"held where {said}" if nodes.any() else "free, nothing is held"
        if free:
            subject.notes.append("the ground carries the body, and nothing is fixed (--fix)")
    if chosen is not None:
        rest = " of the others" if subject.labels else ""
        subject.notes.append(f"Young's modulus{rest} is {pressure(chosen)}, chosen for the weight (--young)")
    body.soft = SoftBody(subject.mesh, material, device=args.device, threads=args.threads)
    body.soft.fix(body.held)
    fixed = None if args.fix is None else body.held
    move_patches(body.soft, body.loads, body.patches, ramp_of(args, duration), fixed)
    if args.ramp is not None and args.ramp > duration:
        share = duration / args.ramp
        subject.notes.append(f"--ramp is {args.ramp:g} s, longer than the run: loads reach {share:.0%} of their values")
    if args.density is not None and args.density < LIGHT:
        subject.notes.append(
            f"--density is {args.density:g} kg/m^3, far less than water; write {args.density:g}g/cm3 for g/cm^3"
        )


def gravity_of(args: argparse.Namespace, subject: InputMesh) -> np.ndarray:
    given = subject.gravity if args.gravity is None else tuple(args.gravity)
    return np.array(checked_gravity(given, subject.mesh.up_axis))


def model_of(name: str, rotation_level: int | float | str | None, dilatation: str | None) -> Model:
    """The elastic model of the options.

    Raises:
        InputError: Rotations of a level, for a model without rotations.
    """
    options: dict[str, Any] = {} if dilatation is None else {"dilatation": dilatation}
    if rotation_level is None:
        return MODELS[name](**options)
    if name != "corotated":
        raise InputError(f"--rotation-level is {rotation_level}, but only --model corotated has rotations, not {name}")
    return Corotated(rotation_level=rotation_level, **options)


def _material(
    args: argparse.Namespace, subject: InputMesh, patches: BodyPatches, stiffer: float = 1.0
) -> tuple[Isotropic, float | None]:
    """The material, and Young's modulus [Pa] if it was chosen for the body's weight, times a factor."""
    density = subject.density if args.density is None else args.density
    poisson = subject.poisson if args.poisson is None else args.poisson
    Isotropic(1.0, poisson, density)  # both must be checked before they are used
    young = subject.young if args.young is None else args.young
    mesh, named = subject.mesh, {entry.name for entry in subject.labels}
    there = np.unique(mesh.labels).tolist() if named and mesh.labels is not None else []
    covered = bool(named) and all(number and mesh.label_names[number - 1] in named for number in there)
    if covered and args.young is not None:
        raise InputError("--young is given, but --materials gives each label its own")
    chosen = None
    if young is None:
        # The body sags visibly, and stands; to two digits.
        g = 9.81 if args.gravity is None else float(np.linalg.norm(args.gravity)) or 9.81
        young = float(f"{STIFFNESS_PER_WEIGHT * density * g * subject.height:.1e}")
        young = float(f"{stiffer * young:.1e}")
        chosen = None if covered else young
    material = Isotropic(young, poisson, density)
    mixed = [(subject.mesh.elements_of(entry.name), entry) for entry in subject.labels]
    mixed += region_entries(patches.tetrahedra, args.region or ())
    if mixed:
        material = mixed_material(material, mixed, len(subject.mesh.tets))
    if args.toughness is not None:
        material = replace(material, toughness=args.toughness)
    return material, chosen


# --- fixed nodes: by ``--fix``, or chosen if it is not given ---------------------------------------------------------

#: Factor on the stiffness that is needed at least.
MORE = 1.05


def held_by_default(
    subject: InputMesh, material: Isotropic, gravity: npt.NDArray[np.float64], *, may_stiffen: bool, may_lie: bool
) -> tuple[Supports, float]:
    """The support of the body, and a factor on its stiffness: above one if no patch would support it with its present
    stiffness.

    Args:
        subject: Gets notes on the choice and its reasons.
        material: The body's material.
        gravity: Acceleration [m/s^2].
        may_stiffen: Whether Young's modulus was not given.
        may_lie: Whether the body may lie on a ground.
    """
    holds = supports_of(
        subject.mesh,
        young=material.young,
        density=material.density,
        gravity=gravity,
        surface=subject.surface,
        may_lie=may_lie,
    )
    if holds.lies:
        subject.notes.append(
            f"the body lies on a ground, since {holds.lies}, and nothing is fixed (--no-ground or --fix holds it)"
        )
        return holds, 1.0
    lines = holds.reasons()
    subject.notes += [*lines[:-1], f"{lines[-1]} (--fix chooses others)"]
    if not (1.0 < holds.stiffer < np.inf):
        return holds, 1.0
    if may_stiffen:
        subject.notes.append(
            f"it is {holds.stiffer:.2g} times as stiff as the default for its weight, so that this supports it"
        )
        return holds, MORE * holds.stiffer
    sag = max(hold.sag for hold in holds.pieces)
    subject.notes.append(
        f"the body is so soft that it sags by about {sag:.0%} of its height; make it {holds.stiffer:.2g} times as "
        "stiff (--young), or fix more of it (--fix)"
    )
    return holds, 1.0


# --- ``--remesh`` ----------------------------------------------------------------------------------------------------


def remesh_of(args: argparse.Namespace, kind: str) -> OnlineRemesh | None:
    """The remeshing that the options request, None for none.

    Args:
        args: The command's arguments.
        kind: Kind of input: "box", "tets", "surface" or "scan".

    Raises:
        InputError: An option that is out of its range or has no effect, or a mesh that cannot be remeshed.
    """
    if not args.remesh:
        return None
    if kind == "tets":
        raise InputError(
            f"--remesh is for box, surfaces and scans, whose meshes are bisected cubes; {args.input} has its own "
            "tetrahedra"
        )
    asked = {name: getattr(args, name) for name in ("refine_above", "simplify_below", "capacity")}
    asked |= {"every": args.remesh_every}
    asked |= dict(zip(("min_level", "max_level"), args.remesh_levels or (None, None), strict=True))
    return OnlineRemesh(**{name: value for name, value in asked.items() if value is not None})
