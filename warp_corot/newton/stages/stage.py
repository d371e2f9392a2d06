"""USD stages as Newton's models: tetrahedra with the materials that Newton reads, rigid bodies, colliders, a ground.

A model is in its stage's own units: UsdPhysics gives all quantities in them, and Newton reads them unchanged. Only
defaults, here or in Newton, are lengths or masses in SI and are converted.
"""

from __future__ import annotations

import math
import re
import warnings
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_corot.errors import InputError
from warp_corot.inputs.selection import select_nodes
from warp_corot.io.files.quiet import quietly
from warp_corot.io.files.usd import first_message
from warp_corot.io.read.usd.scene import Scene
from warp_corot.io.write.usd.over import FollowingSurface
from warp_corot.newton.library import newton
from warp_corot.newton.scene import register_custom_attributes

from .material import Body, StageOptions, contact_law, give_material
from .start import check_colliders, check_ground, notes_of, staying, used_points

GRAVITY = 9.81
#: Distance at which soft bodies begin to push one another, over the mean edge of their tetrahedra.
THICKNESS = 0.1
#: Messages of Newton about things that are handled here.
_SEEN_TO = re.compile(
    r"non-unit (linear|mass) units are not supported|static xforms or the world are not supported|"
    r"cannot disable deformable particle collision|add_usd\(\) still reads them"
)


@dataclass(eq=False)
class StageModel:
    """A stage's model, and the role of each of the stage's prims.

    Attributes:
        scene: The stage.
        model: ``newton.Model``, in the stage's units.
        soft: Its soft bodies.
        rigid: Indices of rigid bodies by their prims' paths.
        surfaces: Meshes that follow: graphics of soft bodies first, then cloth.
        surface_points: For each graphics mesh, the index of each point among Newton's skinned points.
        cloth: For each cloth, the range of its particles in the model.
        ground: Corners of a ground plane that was added [4, 3], or None.
        margin: Distance within which contacts are searched.
        thickness: Distance at which soft bodies begin to push one another; None: they do not.
        cables: Paths of cables.
        notes: The choices that were made, one line each.
    """

    scene: Scene
    model: Any = None
    soft: list[Body] = field(default_factory=list)
    rigid: dict[str, int] = field(default_factory=dict)
    surfaces: list[FollowingSurface] = field(default_factory=list)
    surface_points: list[npt.NDArray[np.intp]] = field(default_factory=list)
    cloth: list[slice] = field(default_factory=list)
    ground: npt.NDArray[np.float64] | None = None
    margin: float = 0.0
    thickness: float | None = None
    cables: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def stage_model(scene: Scene, options: StageOptions, device: Any = None) -> StageModel:
    """Make the model of a stage.

    Raises:
        InputError: Something that Newton cannot read, a material that is not positive definite, or a ground that cuts a
            body.
    """
    made, units = StageModel(scene), scene.units
    repaired = sum(prim.repaired for prim in scene.tets)
    if repaired:
        first = next(prim.path for prim in scene.tets if prim.repaired)
        warnings.warn(
            f"{scene.path}: {repaired} tetrahedra are wound wrongly and have been repaired (first in {first}); "
            "Newton would leave them out",
            UserWarning,
            stacklevel=2,
        )
    builder = _builder(scene, options)
    found = _add_usd(builder, scene)
    if options.gravity is not None:
        builder.gravity = tuple(g / units.metres for g in options.gravity)
    _find_bodies(made, builder, found)
    gravity = float(np.linalg.norm(builder.gravity)) * units.metres
    for body in made.soft:
        note = give_material(body, builder, scene, options, gravity or GRAVITY)
        made.notes += [note] if note else []
    held = _hold(made, builder, found, options)
    _stand(made, builder, options, held)
    made.notes += notes_of(made, builder, options)
    _set_contacts(made, builder)
    register_custom_attributes(builder)
    check_colliders(builder, scene.path)
    try:
        made.model = model = builder.finalize(device=device)
    except (RuntimeError, ValueError) as error:
        raise InputError(f"{scene.path}: {error}") from None
    stiffness, damping = contact_law(made.soft)
    model.soft_contact_ke, model.soft_contact_kd = stiffness / units.kilograms, damping / units.kilograms
    model.soft_contact_kf /= units.kilograms
    _set_friction(made)
    model.particle_max_velocity /= units.metres
    made.margin = max(body.edge for body in made.soft) / units.metres
    _find_surfaces(made, found)
    if options.soft_contact and len(made.soft) + len(made.cloth) > 1 and model.edge_count:
        made.thickness = THICKNESS * min(body.edge for body in made.soft) / units.metres
    return made


def _builder(scene: Scene, options: StageOptions) -> newton.ModelBuilder:
    """A builder with its defaults in the stage's units, and marks for materials that the stage does not give."""
    metres, kilograms = scene.units
    builder = newton.ModelBuilder(up_axis=scene.up_axis, gravity=_down(scene.up_axis, GRAVITY / metres))
    builder.default_particle_radius = options.radius / metres
    builder.default_tet_k_mu = builder.default_tet_k_lambda = builder.default_tet_density = math.nan
    builder.rigid_gap /= metres
    shape = builder.default_shape_cfg
    shape.density /= scene.units.density
    shape.ke, shape.kd, shape.kf = (value / kilograms for value in (shape.ke, shape.kd, shape.kf))
    return builder


def _down(axis: str, amount: float) -> tuple[float, float, float]:
    x, y, z = (-amount if name == axis else 0.0 for name in "XYZ")
    return x, y, z


def _add_usd(builder: newton.ModelBuilder, scene: Scene) -> dict[str, Any]:
    resolvers = [newton.usd.SchemaResolverNewton(), newton.usd.SchemaResolverPhysx()]
    with warnings.catch_warnings(record=True) as said, quietly():
        warnings.simplefilter("always")
        try:
            found = builder.add_usd(
                scene.stage,
                apply_up_axis_from_stage=True,
                load_static_visual_shapes=False,
                schema_resolvers=resolvers,
                return_deformable_results=True,
                only_load_enabled_rigid_bodies=True,
                ignore_paths=scene.skipped,
            )
        except ImportError:
            raise InputError("Newton reads stages with newton-usd-schemas: pip install newton-usd-schemas") from None
        except (RuntimeError, ValueError) as error:
            raise InputError(f"{scene.path}: {first_message(str(error))}") from None
        except Exception as error:  # of a value that Newton does not expect, such as one of an unknown type
            raise InputError(f"{scene.path}: Newton cannot read it: {first_message(str(error))}") from None
    for message in dict.fromkeys(str(warning.message) for warning in said):
        if not _SEEN_TO.search(message):
            warnings.warn(message, UserWarning, stacklevel=3)
    return found


def _find_bodies(made: StageModel, builder: newton.ModelBuilder, found: dict[str, Any]) -> None:
    made.rigid = dict(found["path_body_map"])
    for prim in made.scene.tets:
        ranges = found["path_soft_map"].get(prim.path)
        if ranges is None:
            made.notes.append(f"{prim.path} is not simulated: Newton takes it for graphics, or it is disabled")
            continue
        body = Body(prim, slice(*ranges["particle"]), slice(*ranges["tet"]))
        if body.tets.stop - body.tets.start != len(prim.tets):
            lost = len(prim.tets) - (body.tets.stop - body.tets.start)
            raise InputError(f"{made.scene.path}: {prim.path}: {lost} tetrahedra have too little volume for float32")
        made.soft.append(body)
    if not made.soft:
        raise InputError(f"{made.scene.path}: Newton takes none of its TetMesh prims for a soft body")


def _hold(made: StageModel, builder: newton.ModelBuilder, found: dict[str, Any], options: StageOptions) -> int:
    """Fix particles by an expression or by attachments to fixed bodies; returns their number.

    Infinitely stiff attachments to rigid bodies become as stiff as the tetrahedra around them.
    """
    held: set[int] = set()
    ranges = {body.prim.path: body for body in made.soft}
    for attachment in found["path_attachment_attrs"].values():
        body = ranges.get(attachment["src0"])
        done = attachment.get("attachment_particle_body_indices")
        if body is None or done or not attachment["enabled"] or attachment["type0"] != "point":
            continue
        inside = [i for i in attachment["indices0"] if 0 <= i < len(body.prim.points)]
        held |= {body.particles.start + i for i in inside}
    for index, stiffness in enumerate(builder.attachment_particle_body_stiffness):
        if math.isinf(stiffness):
            particle = builder.attachment_particle_body_particle[index]
            body = next(b for b in made.soft if b.particles.start <= particle < b.particles.stop)
            builder.attachment_particle_body_stiffness[index] = body.young * body.edge / made.scene.units.kilograms
    if options.fix is not None:
        chosen: set[int] = set()
        for body in made.soft:
            points = np.array(builder.particle_q[body.particles], dtype=np.float64) * made.scene.units.metres
            chosen |= set((np.flatnonzero(select_nodes(options.fix, points)) + body.particles.start).tolist())
        if not chosen:
            made.notes.append(f"no point is held by {options.fix!r}; coordinates are world ones in metres (--fix)")
        held |= chosen
    else:
        for body in made.soft:
            said = made.scene.held(body.prim.path)
            held |= set((said[said < len(body.prim.points)] + body.particles.start).tolist())
    for particle in held:
        builder.particle_mass[particle] = 0.0
    if held:
        made.notes.append(f"{len(held)} points of soft bodies are held")
    if len(held) == sum(body.particles.stop - body.particles.start for body in made.soft):
        raise InputError(f"{made.scene.path}: all points of soft bodies are held; at least one must be free to move")
    return len(held)


def _stand(made: StageModel, builder: newton.ModelBuilder, options: StageOptions, held: int) -> None:
    """Add a ground plane if requested."""
    ground = options.ground
    stands = bool(held) or _something_stays(builder)
    if ground == "none" or (ground == "auto" and stands):
        if not stands:
            made.notes.append("nothing holds the bodies: they fall freely")
        return
    axis, units = "XYZ".index(made.scene.up_axis), made.scene.units
    x = np.array(builder.particle_q, dtype=np.float64)[used_points(made, builder)]
    radius = options.radius / units.metres
    lowest = min(float(x[:, axis].min()) - radius, made.scene.lowest(made.rigid))
    height = lowest if isinstance(ground, str) else ground / units.metres
    if not isinstance(ground, str):
        check_ground(made, builder, height, radius)
    builder.add_ground_plane(height=height)
    if isinstance(ground, str):
        made.notes.append(
            f"nothing supports the bodies: there is a ground at {'xyz'[axis]} = {height * units.metres:g} m (--ground)"
        )
    others = [(axis + 1) % 3, (axis + 2) % 3]
    middle, reach = x.mean(axis=0), 5.0 * float(np.ptp(x, axis=0).max())
    corners = np.full((4, 3), height)
    for column, signs in zip(others, ((-1, 1, 1, -1), (-1, -1, 1, 1)), strict=True):
        corners[:, column] = middle[column] + reach * np.array(signs)
    made.ground = corners


def _something_stays(builder: newton.ModelBuilder) -> bool:
    """Whether a collider does not fall: it has no body, a kinematic one, or one jointed to such a body."""
    collides = int(newton.ShapeFlags.COLLIDE_SHAPES) | int(newton.ShapeFlags.COLLIDE_PARTICLES)
    still = staying(builder)
    shapes = zip(builder.shape_body, builder.shape_flags, strict=True)
    return any(body in still and flags & collides for body, flags in shapes)


def _set_contacts(made: StageModel, builder: newton.ModelBuilder) -> None:
    """If no rigid body moves, make colliders without a stiffness of their own as stiff as the soft bodies."""
    if builder.body_count:
        return
    stiffness, damping = (value / made.scene.units.kilograms for value in contact_law(made.soft))
    default = builder.default_shape_cfg
    for shape in range(builder.shape_count):
        if builder.shape_material_ke[shape] == default.ke:
            builder.shape_material_ke[shape] = stiffness
        if builder.shape_material_kd[shape] == default.kd:
            builder.shape_material_kd[shape] = damping


def _set_friction(made: StageModel) -> None:
    """Set the friction of the soft bodies from the stage: one number in Newton, averaged with a shape's."""
    said = [made.scene.says(body.prim.path) for body in made.soft]
    given = [one["friction"] for one in said if "friction" in one]
    if given:
        made.model.soft_contact_mu = sum(given) / len(given)
    if given and (len(set(given)) > 1 or len(given) < len(said)):
        made.notes.append(f"soft bodies have one friction, the mean of those given: {made.model.soft_contact_mu:.3g}")


def _find_surfaces(made: StageModel, found: dict[str, Any]) -> None:
    """Find graphics meshes of the soft bodies, which Newton has bound to their tetrahedra."""
    from scipy.spatial import cKDTree

    start = 0
    starts = []
    for mesh in made.model.deformable_visual_meshes:
        starts.append(start)
        start += len(mesh.rest_vertices)
    for path, index in found["path_deformable_visual_map"].items():
        points = made.scene.world_points(path)
        rest = made.model.deformable_visual_meshes[index].rest_vertices.numpy()
        # Newton duplicates points at sharp edges; coincident points move alike.
        _, nearest = cKDTree(rest).query(points)
        made.surfaces.append(FollowingSurface(path, points))
        made.surface_points.append(nearest + starts[index])
    for path, ranges in found["path_cloth_map"].items():
        made.surfaces.append(FollowingSurface(path, made.scene.world_points(path)))
        made.cloth.append(slice(*ranges["particle"]))
    made.cables = list(found["path_cable_map"])


__all__ = ["StageModel", "StageOptions", "stage_model"]
