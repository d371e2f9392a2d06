"""The initial state of a stage's scene, as far as users should know: overlaps, and bodies that contact cannot feel."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from warp_corot.errors import InputError
from warp_corot.newton.library import newton

from .material import StageOptions

if TYPE_CHECKING:
    from .stage import StageModel

#: Initial depth of a point in a collider, over the edge of its tetrahedra, that is reported.
TOUCHING = 0.05
#: Maximum of a collider's longest side over the cube root of its bounds' volume: Newton counts voxels one by one.
LONGEST = 1e5
#: Maximum number of names in a line.
_NAMES = 4


def used_points(made: StageModel, builder: newton.ModelBuilder) -> npt.NDArray[np.bool_]:
    """A builder's particles without those points of soft bodies that belong to no tetrahedron, bool [P]."""
    used = np.ones(builder.particle_count, bool)
    for body in made.soft:
        used[body.particles] = False
        used[np.unique(np.array(builder.tet_indices[body.tets]))] = True
    return used


def check_colliders(builder: newton.ModelBuilder, source: Any) -> None:
    """Check that Newton can divide the size of every collider into voxels, in the stage's units.

    Args:
        builder: The builder with the colliders.
        source: The stage's file, for the message.

    Raises:
        InputError: A size is not finite, or absurdly long and thin.
    """
    divided = [getattr(newton.GeoType, name) for name in ("MESH", "CONVEX_MESH", "BOX", "ELLIPSOID")]
    shapes = zip(builder.shape_type, builder.shape_scale, builder.shape_source, builder.shape_label, strict=True)
    for kind, scale, data, label in shapes:
        points = getattr(data, "vertices", None)
        if kind not in divided or (points is not None and not len(points)):
            continue
        own = np.full(3, 2.0) if points is None else np.ptp(np.asarray(points, dtype=np.float64), axis=0)
        size = np.abs(own * np.asarray(scale, dtype=np.float64))
        if not np.isfinite(size).all():
            raise InputError(f"{source}: collider {label} must have a finite size")
        sides = np.maximum(size, 1e-6)
        if sides.max() > LONGEST * np.prod(sides) ** (1.0 / 3.0):
            raise InputError(f"{source}: collider {label} is {sides.max():.3g} long and {sides.min():.3g} thin")


def check_ground(made: StageModel, builder: newton.ModelBuilder, height: float, radius: float) -> None:
    """Check that a requested ground plane is below everything that can move, in the stage's units.

    Raises:
        InputError: It cuts a soft body, or is above one.
    """
    axis, metres = "XYZ".index(made.scene.up_axis), made.scene.units.metres
    x, masses = np.array(builder.particle_q, dtype=np.float64)[:, axis], np.array(builder.particle_mass)
    found = []
    for body in made.soft:
        free = x[body.particles][masses[body.particles] > 0.0]
        if len(free):
            found.append((float(free.min()) - radius, body))
    low, body = min(found, key=lambda one: one[0])
    if low < height - TOUCHING * body.edge / metres:
        raise InputError(
            f"ground is {height * metres:g} m; {body.prim.path} reaches down to {'xyz'[axis]} = {_round(low * metres)} "
            f"m, {(height - low) * metres:.3g} m below it, and would be thrown up; it must be at most "
            f'{_round(low * metres)}, or "auto" (--ground)'
        )
    for path, bounds in _falling(made, builder):
        if bounds[0, axis] < height - 0.01 * (bounds[1, axis] - bounds[0, axis]):
            deep = (height - bounds[0, axis]) * metres
            warnings.warn(f"{path} begins {deep:.3g} m deep in the ground (--ground)", UserWarning, stacklevel=4)


def warn_of_overlaps(made: StageModel, contacts: newton.Contacts) -> None:
    """Warn of soft bodies that begin in colliders, from which contact will push them.

    Args:
        made: The stage's model.
        contacts: Contacts of its initial state.
    """
    model, metres = made.model, made.scene.units.metres
    count = min(int(contacts.soft_contact_count.numpy()[0]), contacts.soft_contact_max)
    fields = (contacts.soft_contact_particle, contacts.soft_contact_shape, contacts.soft_contact_body_pos)
    particle, shape, point = (array.numpy()[:count] for array in fields)
    normal = contacts.soft_contact_normal.numpy()[:count].astype(np.float64)
    x = model.particle_q.numpy().astype(np.float64)[particle]
    gap = np.einsum("ci,ci->c", normal, x - _in_world(model, shape, point)) - model.particle_radius.numpy()[particle]
    gap[model.particle_inv_mass.numpy()[particle] == 0.0] = np.inf
    for body in made.soft:
        inside = (particle >= body.particles.start) & (particle < body.particles.stop)
        inside &= gap < -TOUCHING * body.edge / metres
        for one in np.unique(shape[inside]):
            deep = -gap[inside & (shape == one)].min() * metres
            warnings.warn(
                f"{body.prim.path} begins {deep:.3g} m deep in {model.shape_label[one]}, and contact will throw it out",
                UserWarning,
                stacklevel=3,
            )


def notes_of(made: StageModel, builder: newton.ModelBuilder, options: StageOptions) -> Iterator[str]:
    """Facts that a user may not expect, one line each."""
    scene = made.scene
    if not scene.says_metres:
        yield "the stage has no metersPerUnit: by USD's default its unit is a centimetre"
    if len(scene.physics_scenes) > 1:
        yield f"gravity is from the first of {len(scene.physics_scenes)} physics scenes, {scene.physics_scenes[0]}"
    if scene.skipped:
        yield f"prototypes of point instancers are not simulated: {_names(scene.skipped)}"
    if scene.stopped:
        yield f"bodies and colliders do not follow the stage's animation, which is stopped: {_names(scene.stopped)}"
    used = used_points(made, builder)
    for body in made.soft:
        if alone := np.count_nonzero(~used[body.particles]):
            yield f"{body.prim.path}: points in no tetrahedron, which stay where they are: {alone}"
        attribute = scene.stage.GetPrimAtPath(body.prim.path).GetAttribute("physics:collisionEnabled")
        if attribute and attribute.Get() is False:
            yield f"{body.prim.path} collides, though its collision is disabled: Newton has no such switch for points"
    given = {"young": options.young, "poisson": options.poisson, "density": options.density}
    for name, value in given.items():
        if value is not None and all(name in scene.says(body.prim.path) for body in made.soft):
            yield f"--{name} is not used: the stage gives it for all soft bodies"
    if len(made.soft) > 1 and not options.soft_contact:
        yield "soft bodies touch colliders and rigid bodies, not one another"
    yield from _narrow(made, builder, options.radius)


def _narrow(made: StageModel, builder: newton.ModelBuilder, radius: float) -> Iterator[str]:
    """Rigid bodies that can slip in between the points of a soft body."""
    for path, bounds in _falling(made, builder):
        width = float(np.sort(bounds[1] - bounds[0])[1]) * made.scene.units.metres
        body = max(made.soft, key=lambda one: one.edge)
        if width < body.edge and body.edge > 2.0 * radius:
            yield (
                f"{path} is {width:.3g} m wide and can slip in between the points of {body.prim.path}, {body.edge:.3g} "
                "m apart, because contact is only at points; a finer mesh or points with a radius help (--radius)"
            )


def staying(builder: newton.ModelBuilder) -> set[int]:
    """Bodies that do not fall: -1 for the world, kinematic bodies, and those jointed to these."""
    found = {-1} | {k for k, flags in enumerate(builder.body_flags) if flags & int(newton.BodyFlags.KINEMATIC)}
    joints = [
        (parent, child)
        for parent, child, kind in zip(builder.joint_parent, builder.joint_child, builder.joint_type, strict=True)
        if kind != newton.JointType.FREE
    ]
    before = 0
    while len(found) > before:
        before = len(found)
        found |= {child for parent, child in joints if parent in found}
    return found


def _falling(made: StageModel, builder: newton.ModelBuilder) -> Iterator[tuple[str, npt.NDArray[np.float64]]]:
    """Rigid bodies that can fall, with their bounds."""
    held = staying(builder)
    for path, index in made.rigid.items():
        bounds = None if index in held else made.scene.bounds(path)
        if bounds is not None:
            yield path, bounds


def _in_world(model: Any, shape: npt.NDArray[np.integer], point: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
    """Points given in the frames of the shapes' bodies, in the world, float64 [C, 3]."""
    found = point.astype(np.float64)
    body = model.shape_body.numpy()[shape]
    moving = body >= 0
    if moving.any():
        pose = model.body_q.numpy().astype(np.float64)[body[moving]]
        axis, w = pose[:, 3:6], pose[:, 6:]
        across = 2.0 * np.cross(axis, found[moving])
        found[moving] += w * across + np.cross(axis, across) + pose[:, :3]
    return found


def _names(paths: list[str]) -> str:
    return ", ".join(paths[:_NAMES]) + (f" and {len(paths) - _NAMES} more" if len(paths) > _NAMES else "")


def _round(value: float) -> str:
    """A height with few digits, and never minus zero."""
    return f"{round(value, 9) + 0.0:.6g}"
