"""Checkpoints: everything that a simulation needs to resume, in one NumPy archive without pickles."""

from __future__ import annotations

import dataclasses
import json
import warnings
from collections.abc import Sequence
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warp_corot.body.keyframes import Activation, followed_stress
from warp_corot.body.soft_body import SoftBody
from warp_corot.contact.options import Contact
from warp_corot.discretization.changing.passes import Findings
from warp_corot.elasticity import MODELS, ForceField, Model
from warp_corot.errors import InputError, StabilityWarning
from warp_corot.inputs.checks import checked_path
from warp_corot.io.files.quiet import bounded
from warp_corot.io.files.whole import written_whole
from warp_corot.materials.anisotropic import FibreReinforced, Orthotropic, TransverselyIsotropic
from warp_corot.materials.isotropic import Isotropic
from warp_corot.mesh import TetForest, TetMesh
from warp_corot.mesh.surfaces.marching import Detail
from warp_corot.remesh.conditions import Keys
from warp_corot.remesh.remeshing import OnlineRemesh
from warp_corot.simulation.simulation import Simulation
from warp_corot.solvers import INTEGRATORS

from . import contents

if TYPE_CHECKING:
    from warp_corot.remesh.changing import Changing

# --- trees of plain values, arrays and listed dataclasses: JSON, and the arrays beside it ----------------------------

Arrays = dict[str, np.ndarray]
#: The only key of what stands for an array in JSON; its value is the array's name.
ARRAY = "array"
#: The keys of what stands for a dataclass: its name and the values of its fields.
INSTANCE = ("kind of", "values")


def kinds() -> dict[str, Any]:
    """The dataclasses that checkpoints hold, by name: laws and integrators that are listed, materials, and parts."""
    listed: list[Any] = [*MODELS.values(), *INTEGRATORS.values(), Contact, Detail, Findings, Keys]
    listed += [Isotropic, TransverselyIsotropic, Orthotropic, FibreReinforced]
    return {kind.__name__: kind for kind in listed}


def split(tree: Any, name: str = "") -> tuple[Any, Arrays]:
    """A tree of dictionaries, lists, tuples and dataclasses without its arrays, and the arrays [any shape], named by
    the keys and numbers on the way to them, with dots; arrays of Warp are read.

    Raises:
        InputError: A dataclass that is none of `kinds`, such as a law of your own.
    """
    if isinstance(tree, wp.array):
        tree = tree.numpy()
    if isinstance(tree, np.ndarray):
        return {ARRAY: name}, {name: tree}
    if dataclasses.is_dataclass(tree):
        kind = type(tree).__name__
        if kinds().get(kind) is not type(tree):
            raise InputError(f"a {kind} cannot be saved; only {', '.join(kinds())}")
        values = {each.name: getattr(tree, each.name) for each in dataclasses.fields(tree)}
        tree = {INSTANCE[0]: kind, INSTANCE[1]: values}
    if isinstance(tree, np.generic):
        return tree.item(), {}
    if not isinstance(tree, dict | list | tuple):
        return tree, {}
    arrays: Arrays = {}
    plain: list[tuple[Any, Any]] = []
    for key, value in tree.items() if isinstance(tree, dict) else enumerate(tree):
        own, found = split(value, f"{name}.{key}" if name else str(key))
        plain.append((key, own))
        arrays |= found
    return dict(plain) if isinstance(tree, dict) else [own for _, own in plain], arrays


def joined(plain: Any, arrays: Arrays) -> Any:
    """The tree that ``split`` has split, with lists for tuples.

    Raises:
        KeyError: An array is missing.
    """
    if isinstance(plain, dict):
        if plain.keys() == {ARRAY}:
            return arrays[plain[ARRAY]]
        found = {key: joined(value, arrays) for key, value in plain.items()}
        return kinds()[found[INSTANCE[0]]](**found[INSTANCE[1]]) if found.keys() == set(INSTANCE) else found
    return [joined(value, arrays) for value in plain] if isinstance(plain, list) else plain


# --- the archive -----------------------------------------------------------------------------------------------------

Remesh = OnlineRemesh | Sequence[OnlineRemesh | None] | None

FORMAT = "warp-corot checkpoint"
#: What blades continue from.
OF_BLADES = ("kept", "every", "unchanged")
#: The version of checkpoints that is written, and the only one that is read.
VERSION = 14


def save_checkpoint(sim: Simulation, path: str | PathLike[str], *, in_parts: bool = False) -> None:
    """Write the simulation's state to ``path``, completely or not at all: to a temporary file, synced, then renamed.

    Args:
        sim, path: As above.
        in_parts: Whether several ranks shall have only parts of the bodies when they continue.

    Raises:
        InputError: The folder does not exist, the path is a folder, it cannot be written to, or an obstacle of a class
            of your own.
    """
    target = checked_path(path, "path")
    if not target.parent.is_dir():
        raise InputError(f"cannot save {target}: the folder {target.parent} does not exist")
    if target.is_dir():
        raise InputError(f"cannot save {target}: it is a folder")
    packed = zip(sim.bodies, sim.models, sim.fields, sim.remeshing.changing, strict=True)
    cuts: dict[str, Any] | None = None
    if sim.remeshing.are_cut:
        cuts = {"stable_steps": sim.stable_steps, "blades": []}
        if sim.blades is not None:
            cuts |= {name: getattr(sim.blades, name) for name in OF_BLADES}
            packed_blades = [contents.pack_tool(blade, True) | {"level": blade.level} for blade in sim.blades.blades]
            cuts["blades"] = packed_blades
    plain, arrays = split(
        {
            "format": FORMAT,
            "version": VERSION,
            "device": str(sim.device),
            "stable_dt": sim.stable_dt,
            "steps_before_reset": sim.steps_before_reset,
            "time_before_reset": sim.time_before_reset,
            "gravity": sim.gravity,
            "integrator": sim.integrator,
            "deterministic": sim.deterministic,
            "worlds": sim.worlds,
            "bodies": [pack_body(*each) for each in packed],
            "kept": sim.kept,
            "guard": sim.guard.state,
            "running": sim.running.state,
            "cuts": cuts,
            "contact": contents.pack_contact(sim.contact, sim.grasps),
        }
        | ({"in_parts": True} if in_parts else {})
    )
    arrays["header"] = np.frombuffer(json.dumps(plain).encode(), np.uint8)
    try:
        with written_whole(target) as part, part.open("wb") as file:
            np.savez(file, allow_pickle=False, **arrays)
    except OSError as error:
        raise InputError(f"cannot save {error}") from error


def pack_body(
    body: SoftBody, model: Model, field: ForceField, changing: Changing | None, *, with_mesh: bool = True
) -> dict[str, Any]:
    """A body, with its mesh or without, as a tree of plain values and arrays."""
    body.state.adopt_positions()
    mesh, material = body.mesh, body.material
    if changing is not None:
        mesh, material = changing.forest.source, changing.carried_material.given
    return {
        "model": model,
        "mesh": contents.pack_mesh(mesh) if with_mesh else None,
        "material": material,
        "threads": body.threads,
        "world_starts": body.conditions.world_starts,
        "field": field.state,
        "state": None if changing is not None else _pack_state(body),
        "remesh": None if changing is None else contents.pack_changing(changing),
    }


def _pack_state(body: SoftBody) -> dict[str, Any]:
    state, conditions, initial = body.state, body.conditions, body.state.initial
    return {
        "displacements": state.displacements,
        "velocities": state.velocities,
        "reactions": state.reactions,
        "constrained": body.constrained,
        "initial": None if initial is None else dict(zip(("displacements", "velocities"), initial, strict=True)),
        "loads": conditions.loads if conditions.has_loads else None,
        "activation": body.activation if body.discretization.has_activation else None,
        "trajectories": [
            dict(zip(("nodes", "times", "displacements"), (each.host_numbers, *each.keys()), strict=True))
            for each in conditions.trajectories
        ],
        "activations": [
            {"elements": each.numbers, "times": each.times, "stress": each.values} for each in conditions.activations
        ],
    }


def load_checkpoint(
    path: str | PathLike[str], device: str | wp.Device | None = None, remesh: Remesh = None
) -> Simulation:
    """The simulation that ``save_checkpoint`` wrote; see ``Simulation.load``."""
    source = checked_path(path, "path")
    if not source.is_file():
        raise InputError(f"there is no checkpoint {source}")
    what = f"{source} is not a complete checkpoint of warp_corot"
    try:
        with bounded(source), np.load(source, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        for name, array in arrays.items():
            if not isinstance(array, np.ndarray):
                raise InputError(f"{what}: {name} is not an array")
        header = json.loads(arrays["header"].tobytes())
        if header["version"] != VERSION:
            raise InputError(f"{source} has version {header['version']}; this warp_corot reads version {VERSION} only")
        if header["format"] != FORMAT:
            raise InputError(what)
    except InputError:
        raise
    except Exception as error:  # any error of NumPy, zip files or JSON
        raise InputError(what) from error
    try:
        return _rebuilt_simulation(joined(header, arrays), device, remesh)
    except (LookupError, TypeError) as error:
        raise InputError(f"{what}: {error} is missing or wrong") from error
    except (ArithmeticError, AssertionError, AttributeError, MemoryError, RuntimeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{what}: {' '.join(str(error).split())[:160]}") from error


def _rebuilt_simulation(tree: dict[str, Any], device: str | wp.Device | None, remesh: Remesh) -> Simulation:
    place = tree["device"] if device is None else device
    touched, cuts, touching = tree["contact"], tree["cuts"], dict[str, Any]()
    blades: Any = None if cuts is None else list(map(contents.unpacked_tool, cuts["blades"]))
    if touched is not None:
        obstacles = list(map(contents.unpacked_tool, touched["obstacles"]))
        touching = {"obstacles": obstacles, "contact": touched["options"]}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", StabilityWarning)  # the warning was shown when the simulation was made
        sim = Simulation(
            [rebuilt_body(packed, tree["worlds"], place) for packed in tree["bodies"]],
            model=[packed["model"] for packed in tree["bodies"]],
            integrator=tree["integrator"],
            gravity=tree["gravity"],
            deterministic=tree["deterministic"],
            remesh=contents.remesh_options(tree["bodies"], place, remesh, touching.get("obstacles", ())),
            cuts=blades,
            **touching,
        )
    sim.steps_before_reset, sim.time_before_reset = tree["steps_before_reset"], tree["time_before_reset"]
    if tree["stable_dt"] is not None:
        sim.stable_dt = tree["stable_dt"]
    bodies = zip(tree["bodies"], sim.bodies, sim.fields, sim.remeshing.changing, strict=True)
    for packed, body, field, changing in bodies:
        if changing is not None and packed["remesh"] is not None:
            contents.unpack_changing(changing, packed["remesh"])
        body.conditions.world_starts.assign(packed["world_starts"].astype(np.float64))
        for name, values in packed["field"].items():
            field.state[name].assign(values)
    for name, values in tree["kept"].items():
        sim.kept[name].assign(values)
    if cuts is not None:
        sim.stable_steps = cuts["stable_steps"]
        if sim.blades is not None:
            for name, array in sim.blades.kept.items():
                array.assign(cuts["kept"][name])
            sim.blades.every, sim.blades.unchanged = int(cuts["every"]), int(cuts["unchanged"])
    contents.unpack_contact(sim.contact, touched)
    sim.guard.resume(**tree["guard"])
    sim.running.resume(**tree["running"])
    return sim


def rebuilt_body(
    packed: dict[str, Any], worlds: int, device: str | wp.Device, mesh: TetForest | TetMesh | None = None
) -> SoftBody:
    """The body that ``pack_body`` packed, with another mesh if it was packed without."""
    mesh = contents.unpack_mesh(packed["mesh"]) if mesh is None else mesh
    body = SoftBody(mesh, packed["material"], worlds=worlds, device=device, threads=packed["threads"])
    if packed["state"] is not None:
        _unpack_state(body, packed["state"])
    elif packed["remesh"]["loads"]:
        _ = body.loads  # made on first use
    return body


def _unpack_state(body: SoftBody, state: dict[str, Any]) -> None:
    if state["initial"] is not None:
        body.displacements = state["initial"]["displacements"][:, :3]
        body.velocities = state["initial"]["velocities"][:, :3]
        body.set_initial_state()
    body.fix(state["constrained"])
    for each in state["trajectories"]:
        body.follow(each["nodes"], times=each["times"], displacements=each["displacements"])
    if state["activation"] is not None:
        body.activation.assign(state["activation"])
    keys = [(each["elements"], Activation(each["times"], each["stress"])) for each in state["activations"]]
    body.conditions.set_activations([followed_stress(*each, body.device) for each in keys])
    if state["loads"] is not None:
        wp.copy(body.loads, wp.array(state["loads"][:, :3], dtype=wp.vec3, device=body.device))
    body.displacements = state["displacements"][:, :3]
    body.state.set_velocities(state["velocities"][:, :3])
    body.state.reactions.assign(state["reactions"])
