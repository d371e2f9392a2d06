"""Checkpoints: everything that a simulation needs to resume, in one NumPy archive without pickles."""

from __future__ import annotations

import dataclasses
import json
import warnings
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warp_corot.body.activation import Activation, followed_stress
from warp_corot.body.soft_body import SoftBody
from warp_corot.elasticity import MODELS, ForceField, Model
from warp_corot.errors import InputError, StabilityWarning
from warp_corot.inputs.checks import checked_path
from warp_corot.io.files.quiet import bounded
from warp_corot.io.files.whole import written_whole
from warp_corot.materials.anisotropic import Orthotropic, TransverselyIsotropic
from warp_corot.materials.isotropic import Isotropic
from warp_corot.materials.reinforced import FibreReinforced
from warp_corot.mesh import TetForest, TetMesh
from warp_corot.remesh.online import OnlineRemesh
from warp_corot.simulation.simulation import Simulation
from warp_corot.solvers import INTEGRATORS

from .contact import blades_of, obstacles_of, pack_blades, pack_contact, unpack_blades, unpack_contact
from .mesh import pack_mesh, unpack_mesh
from .remesh import pack_changing, remesh_options, unpack_changing

if TYPE_CHECKING:
    from warp_corot.remesh.changing import Changing

Remesh = OnlineRemesh | Sequence[OnlineRemesh | None] | None

FORMAT = "warp-corot checkpoint"
#: The version of checkpoints that is written, and the only one that is read.
VERSION = 11

#: What the guard continues from.
GUARDED = ("scale", "drift", "lately", "counted", "work")

MATERIALS = {kind.__name__: kind for kind in (Isotropic, TransverselyIsotropic, Orthotropic, FibreReinforced)}


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
    arrays: dict[str, np.ndarray] = {}
    header: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "device": str(sim.device),
        "stable_dt": sim.stable_dt,
        "steps_before_reset": sim.steps_before_reset,
        "time_before_reset": sim.time_before_reset,
        "gravity": sim.gravity,
        "integrator": described_of(sim.integrator, INTEGRATORS),
        "deterministic": sim.deterministic,
        "worlds": sim.worlds,
        "bodies": [],
        "kept": sorted(sim.kept),
        "running": sim.running.state,
    } | ({"in_parts": True} if in_parts else {})
    for name, array in sim.kept.items():
        arrays[f"kept.{name}"] = array.numpy()
    for name, values in sim.guard.state.items():
        arrays[f"guard.{name}"] = values
    packed = zip(sim.bodies, sim.models, sim.fields, sim.remeshing.changing, strict=True)
    for number, (body, model, field, changing) in enumerate(packed):
        header["bodies"].append(pack_body(body, model, field, changing, f"body{number}.", arrays))
    header["cuts"] = None
    if sim.remeshing.are_cut:
        header["cuts"] = pack_blades(sim.blades, arrays) | {"stable_steps": sim.stable_steps}
    header["contact"] = pack_contact(sim.contact, sim.grasps, arrays)
    arrays["header"] = np.frombuffer(json.dumps(header).encode(), np.uint8)
    write_archive(target, arrays)


def pack_body(
    body: SoftBody,
    model: Model,
    field: ForceField,
    changing: Changing | None,
    prefix: str,
    arrays: dict[str, np.ndarray],
    *,
    with_mesh: bool = True,
) -> dict[str, Any]:
    """Put a body, with its mesh or without, into arrays whose names begin with ``prefix``.

    Returns the remaining data for JSON.
    """
    body.state.adopt_positions()
    mesh, material = body.mesh, body.material
    if changing is not None:
        mesh, material = changing.forest.source, changing.carried_material.given
    described = {
        "model": described_of(model, MODELS),
        "mesh": pack_mesh(mesh, prefix, arrays) if with_mesh else None,
        "material": _name_of(material, MATERIALS),
        "threads": body.threads,
        "trajectories": 0,
        "activations": len(body.conditions.activations),
        "field": sorted(field.state),
        "remesh": None,
    }
    for material_field in dataclasses.fields(material):
        arrays[prefix + material_field.name] = np.asarray(getattr(material, material_field.name))
    arrays[prefix + "world_starts"] = body.conditions.world_starts.numpy()
    for name, array in field.state.items():
        arrays[f"{prefix}field.{name}"] = array.numpy()
    if changing is None:
        described["trajectories"] = len(body.conditions.trajectories)
        _pack_state(body, prefix, arrays)
    else:
        described["remesh"] = pack_changing(changing, f"{prefix}remesh.", arrays)
    return described


def _pack_state(body: SoftBody, prefix: str, arrays: dict[str, np.ndarray]) -> None:
    arrays[prefix + "displacements"] = body.state.displacements.numpy()
    arrays[prefix + "velocities"] = body.state.velocities.numpy()
    arrays[prefix + "reactions"] = body.state.reactions.numpy()
    arrays[prefix + "constrained"] = body.constrained
    if body.state.initial is not None:
        for name, array in zip(("displacements", "velocities"), body.state.initial, strict=True):
            arrays[f"{prefix}initial.{name}"] = array.numpy()
    if body.conditions.has_loads:
        arrays[prefix + "loads"] = body.conditions.loads.numpy()
    for k, trajectory in enumerate(body.conditions.trajectories):
        arrays[f"{prefix}trajectory{k}.nodes"] = trajectory.host_numbers
        times, displacements = trajectory.keys()
        arrays[f"{prefix}trajectory{k}.times"] = times
        arrays[f"{prefix}trajectory{k}.displacements"] = displacements
    if body.discretization.has_activation:
        arrays[prefix + "activation"] = body.activation.numpy()
    for k, activation in enumerate(body.conditions.activations):
        for name, of_it in (("elements", "numbers"), ("times", "times"), ("stress", "values")):
            arrays[f"{prefix}activation{k}.{name}"] = getattr(activation, of_it).numpy()


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
        check_version(header, source)
        if header["format"] != FORMAT:
            raise InputError(what)
    except InputError:
        raise
    except Exception as error:  # any error of NumPy, zip files or JSON
        raise InputError(what) from error
    try:
        return _rebuilt_simulation(header, arrays, device, remesh)
    except (LookupError, TypeError) as error:
        raise InputError(f"{what}: {error} is missing or wrong") from error
    except (ArithmeticError, AssertionError, AttributeError, MemoryError, RuntimeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{what}: {' '.join(str(error).split())[:160]}") from error


def check_version(header: dict[str, Any], source: Path) -> None:
    """Refuse a checkpoint of another version."""
    if header["version"] != VERSION:
        raise InputError(f"{source} has version {header['version']}; this warp_corot reads version {VERSION} only")


def _rebuilt_simulation(
    header: dict[str, Any], arrays: dict[str, np.ndarray], device: str | wp.Device | None, remesh: Remesh
) -> Simulation:
    place = header["device"] if device is None else device
    bodies, models = [], []
    for number, described in enumerate(header["bodies"]):
        bodies.append(rebuilt_body(described, f"body{number}.", arrays, header["worlds"], place))
        models.append(rebuilt(described["model"], MODELS))
    integrator = rebuilt(header["integrator"], INTEGRATORS)
    touching = obstacles_of(header["contact"], arrays)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", StabilityWarning)  # the warning was shown when the simulation was made
        sim = Simulation(
            bodies,
            model=models,
            integrator=integrator,
            gravity=header["gravity"],
            deterministic=header["deterministic"],
            remesh=remesh_options(header["bodies"], arrays, place, remesh, touching.get("obstacles", ())),
            cuts=blades_of(header["cuts"], arrays),
            **touching,
        )
    sim.steps_before_reset, sim.time_before_reset = header["steps_before_reset"], header["time_before_reset"]
    if header["stable_dt"] is not None:
        sim.stable_dt = header["stable_dt"]
    for number, (described, body, field) in enumerate(zip(header["bodies"], sim.bodies, sim.fields, strict=True)):
        if described["remesh"] is not None:
            changing = sim.remeshing.changing[number]
            assert changing is not None
            unpack_changing(changing, described["remesh"], f"body{number}.remesh.", arrays)
        body.conditions.world_starts.assign(arrays[f"body{number}.world_starts"].astype(np.float64))
        for name in described["field"]:
            field.state[name].assign(arrays[f"body{number}.field.{name}"])
    for name in header["kept"]:
        sim.kept[name].assign(arrays[f"kept.{name}"])
    if header["cuts"] is not None:
        sim.stable_steps = header["cuts"]["stable_steps"]
        unpack_blades(sim.blades, header["cuts"], arrays)
    unpack_contact(sim.contact, header["contact"], arrays)
    sim.guard.resume(**{name: arrays[f"guard.{name}"] for name in GUARDED})
    sim.running.resume(**header["running"])
    return sim


def rebuilt_body(
    described: dict[str, Any],
    prefix: str,
    arrays: dict[str, np.ndarray],
    worlds: int,
    device: str | wp.Device,
    mesh: TetForest | TetMesh | None = None,
) -> SoftBody:
    """The body that ``pack_body`` stored, with another mesh if it was stored without."""
    mesh = unpack_mesh(described["mesh"], prefix, arrays) if mesh is None else mesh
    material_kind = MATERIALS[described["material"]]
    material = material_kind(*(arrays[prefix + f.name][()] for f in dataclasses.fields(material_kind)))
    body = SoftBody(mesh, material, worlds=worlds, device=device, threads=described.get("threads"))
    if described["remesh"] is None:
        _unpack_state(body, described, prefix, arrays)
    elif described["remesh"]["loads"]:
        _ = body.loads  # made on first use
    return body


def _unpack_state(body: SoftBody, described: dict[str, Any], prefix: str, arrays: dict[str, np.ndarray]) -> None:
    if prefix + "initial.displacements" in arrays:
        body.displacements = arrays[prefix + "initial.displacements"][:, :3]
        body.velocities = arrays[prefix + "initial.velocities"][:, :3]
        body.set_initial_state()
    body.fix(arrays[prefix + "constrained"])
    for k in range(described["trajectories"]):
        motion = f"{prefix}trajectory{k}."
        body.follow(
            arrays[motion + "nodes"],
            times=arrays[motion + "times"],
            displacements=arrays[motion + "displacements"],
        )
    if prefix + "activation" in arrays:
        body.activation.assign(arrays[prefix + "activation"])
    activations = []
    for k in range(described["activations"]):
        elements, times, stress = (arrays[f"{prefix}activation{k}.{name}"] for name in ("elements", "times", "stress"))
        activations.append(followed_stress(elements, Activation(times, stress), body.device))
    body.conditions.set_activations(activations)
    if prefix + "loads" in arrays:
        wp.copy(body.loads, wp.array(arrays[prefix + "loads"][:, :3], dtype=wp.vec3, device=body.device))
    body.displacements = arrays[prefix + "displacements"][:, :3]
    body.state.set_velocities(arrays[prefix + "velocities"][:, :3])
    body.state.reactions.assign(arrays[prefix + "reactions"])


def described_of(thing: Any, names: dict[str, Any]) -> dict[str, Any]:
    """A listed dataclass of plain values or of other listed ones, for JSON: its name in the list and its values."""
    values = dataclasses.asdict(thing)
    for name in values:
        if type(getattr(thing, name)) in names.values():
            values[name] = described_of(getattr(thing, name), names)
    return {"name": _name_of(thing, names), "values": values}


def _name_of(thing: Any, names: dict[str, Any]) -> str:
    for name, cls in names.items():
        if type(thing) is cls:
            return name
    raise InputError(f"a {type(thing).__name__} cannot be saved; only {', '.join(c.__name__ for c in names.values())}")


def rebuilt(described: dict[str, Any], names: dict[str, Any]) -> Any:
    """What ``described_of`` has described."""
    values = described["values"]
    parts = {name: rebuilt(value, names) for name, value in values.items() if isinstance(value, dict)}
    return names[described["name"]](**(values | parts))


def write_archive(target: Path, arrays: dict[str, np.ndarray]) -> None:
    """Write arrays, completely or not at all.

    Raises:
        InputError: They cannot be written.
    """
    try:
        with written_whole(target) as part, part.open("wb") as file:
            np.savez(file, allow_pickle=False, **arrays)
    except OSError as error:
        raise InputError(f"cannot save {error}") from error
