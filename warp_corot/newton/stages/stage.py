"""USD stages as Newton's models: tetrahedra with the materials that Newton reads, or defaults, rigid bodies, colliders
and a ground; and what users should know of the initial state: overlaps, and bodies that contact cannot feel.

A model is in its stage's own units: UsdPhysics gives all quantities in them, and Newton reads them unchanged. Only
defaults, here or in Newton, are lengths or masses in SI and are converted.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_vector
from warp_corot.inputs.selection import select_nodes
from warp_corot.io.files.quiet import quietly
from warp_corot.io.files.usd import first_message
from warp_corot.io.read.usd.scene import Scene, TetPrim
from warp_corot.io.write.usd.over import FollowingSurface
from warp_corot.materials.isotropic import Isotropic
from warp_corot.newton.library import newton
from warp_corot.newton.scene import register_custom_attributes

#: Young's modulus over the weight of a column as high as the body, if a stage gives no material.
STIFFNESS_PER_WEIGHT = 20.0
#: Fraction of critical damping of a body's slowest vibration, if no viscosity is given.
DAMPED_SHARE = 0.05
#: Stiffness of contact over Young's modulus times edge of a tetrahedron: it limits how deep bodies sink into the
#: ground.
CONTACT_STIFFNESS = 3.0
#: Defaults if a stage has no material and no option gives one; density in kg/m^3.
POISSON, DENSITY = 0.45, 1000.0
#: Newton's Young's modulus [Pa] and Poisson's ratio for a material without them.
FALLBACK = (1e6, 0.3)
GRAVITY = 9.81
#: Distance at which soft bodies begin to push one another, over the mean edge of their tetrahedra.
THICKNESS = 0.1
#: Messages of Newton about things that are handled here.
_SEEN_TO = re.compile(
    r"non-unit (linear|mass) units are not supported|static xforms or the world are not supported|"
    r"cannot disable deformable particle collision|add_usd\(\) still reads them"
)
#: Initial depth of a point in a collider, over the edge of its tetrahedra, that is reported.
TOUCHING = 0.05
#: Maximum of a collider's longest side over the cube root of its bounds' volume: Newton counts voxels one by one.
LONGEST = 1e5
#: Maximum number of names in a line.
_NAMES = 4


@dataclass(frozen=True)
class StageOptions:
    """Values for what the stage does not define, in SI units.

    Attributes:
        young: Young's modulus if the stage gives none [Pa]; None: from the weight for bodies without a material, 1 MPa
            for materials without it.
        poisson: The same for Poisson's ratio; None: 0.45 for bodies without a material, 0.3 for materials without it.
        density: The same for density [kg/m^3]; None: 1000.
        gravity: Acceleration [m/s^2], in place of the stage's own.
        viscosity: Viscous stress over elastic shear stress of one strain [s]; None: the slowest vibration
            of each body has a twentieth of critical damping.
        ground: Height of a ground plane [m]; "auto": below everything, if nothing in the stage supports the bodies;
            "none".
        fix: Expression for the nodes that are held; see ``select_nodes``.
        radius: Contact radius around each point of a soft body [m].
        soft_contact: Whether soft bodies and cloth touch one another, and themselves.
    """

    young: float | None = None
    poisson: float | None = None
    density: float | None = None
    gravity: tuple[float, float, float] | None = None
    viscosity: float | None = None
    ground: float | str = "auto"
    fix: str | None = None
    radius: float = 0.0
    soft_contact: bool = True

    def __post_init__(self) -> None:
        young, poisson, density = self.young, self.poisson, self.density
        # The constructor checks the values.
        Isotropic(_first(young, 1.0), _first(poisson, POISSON), _first(density, DENSITY))
        if self.viscosity is not None and not (math.isfinite(self.viscosity) and self.viscosity >= 0):
            raise InputError(f"viscosity is {self.viscosity:g}; it must be zero or a positive time in seconds")
        if self.gravity is not None:
            checked_vector(self.gravity, "gravity", "m/s^2")
        if not (math.isfinite(self.radius) and self.radius >= 0):
            raise InputError(f"radius is {self.radius:g}; it must be zero or a positive length in metres")


@dataclass(eq=False)
class Body:
    """A soft body of a stage.

    Attributes:
        prim: Its prim.
        particles, tets: Its ranges in the model.
        young, poisson: Young's modulus [Pa] and Poisson's ratio of its first tetrahedron.
        density: Mean density [kg/m^3].
        edge: Mean edge of its tetrahedra [m].
        given: Whether the stage gives the material.
    """

    prim: TetPrim
    particles: slice
    tets: slice
    young: float = math.nan
    poisson: float = math.nan
    density: float = math.nan
    edge: float = math.nan
    given: bool = True


class StageModel:
    """A stage's model, and the role of each of the stage's prims.

    Args:
        scene: The stage.
        options: Values for what it does not define.
        device: The device of the model.

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

    Raises:
        InputError: Something that Newton cannot read, a material that is not positive definite, or a ground that cuts a
            body.
    """

    def __init__(self, scene: Scene, options: StageOptions, device: Any = None):
        self.scene, self._options, self._axis = scene, options, "XYZ".index(scene.up_axis)
        self.soft, self.notes = list[Body](), list[str]()
        self.ground: npt.NDArray[np.float64] | None = None
        repaired = [prim for prim in scene.tets if prim.repaired]
        if repaired:
            warnings.warn(
                f"{scene.path}: {sum(prim.repaired for prim in repaired)} tetrahedra are wound wrongly and have been "
                f"repaired (first in {repaired[0].path}); Newton would leave them out",
                UserWarning,
                stacklevel=3,
            )
        units, self._builder = scene.units, _builder(scene, options)
        builder, found = self._builder, _add_usd(self._builder, scene)
        if options.gravity is not None:
            builder.gravity = tuple(g / units.metres for g in options.gravity)
        self.rigid: dict[str, int] = dict(found["path_body_map"])
        self._find_soft(found["path_soft_map"])
        gravity = float(np.linalg.norm(builder.gravity)) * units.metres
        for body in self.soft:
            self._give_material(body, gravity or GRAVITY)
        held = self._hold(found["path_attachment_attrs"].values())
        self._stand(held)
        self.notes += self._facts()
        stiffness, damping = (value / units.kilograms for value in self._contact_law())
        # If no rigid body moves, colliders without a stiffness of their own are as stiff as the soft bodies.
        if not builder.body_count:
            config = builder.default_shape_cfg
            for values, default, value in (
                (builder.shape_material_ke, config.ke, stiffness),
                (builder.shape_material_kd, config.kd, damping),
            ):
                values[:] = [value if own == default else own for own in values]
        register_custom_attributes(builder)
        self._check_colliders()
        try:
            self.model = model = builder.finalize(device=device)
        except (RuntimeError, ValueError) as error:
            raise InputError(f"{scene.path}: {error}") from None
        model.soft_contact_ke, model.soft_contact_kd = stiffness, damping
        model.soft_contact_kf /= units.kilograms
        # Newton has one number for soft bodies, averaged with a shape's.
        given = [said["friction"] for body in self.soft if "friction" in (said := scene.says(body.prim.path))]
        if given:
            model.soft_contact_mu = sum(given) / len(given)
        if given and (len(set(given)) > 1 or len(given) < len(self.soft)):
            self.notes.append(f"soft bodies have one friction, the mean of those given: {model.soft_contact_mu:.3g}")
        model.particle_max_velocity /= units.metres
        self.margin = max(body.edge for body in self.soft) / units.metres
        self._find_surfaces(found)
        several = options.soft_contact and len(self.soft) + len(self.cloth) > 1 and model.edge_count
        edge = min(body.edge for body in self.soft)
        self.thickness: float | None = THICKNESS * edge / units.metres if several else None

    # --- what there is -----------------------------------------------------------------------------------------------

    def _find_soft(self, of_prims: dict[str, Any]) -> None:
        for prim in self.scene.tets:
            ranges = of_prims.get(prim.path)
            if ranges is None:
                self.notes.append(f"{prim.path} is not simulated: Newton takes it for graphics, or it is disabled")
                continue
            body = Body(prim, slice(*ranges["particle"]), slice(*ranges["tet"]))
            if lost := len(prim.tets) - (body.tets.stop - body.tets.start):
                raise self._error(f"{prim.path}: {lost} tetrahedra have too little volume for float32")
            self.soft.append(body)
        if not self.soft:
            raise self._error("Newton takes none of its TetMesh prims for a soft body")

    def _find_surfaces(self, found: dict[str, Any]) -> None:
        """Find graphics meshes of the soft bodies, which Newton has bound to their tetrahedra, cloth and cables."""
        from scipy.spatial import cKDTree

        self.surfaces, self.surface_points = list[FollowingSurface](), list[npt.NDArray[np.intp]]()
        meshes = self.model.deformable_visual_meshes
        starts = np.cumsum([0, *(len(mesh.rest_vertices) for mesh in meshes)])
        for path, index in found["path_deformable_visual_map"].items():
            self.surfaces.append(FollowingSurface(path, self.scene.world_points(path)))
            # Newton duplicates points at sharp edges; coincident points move alike.
            _, nearest = cKDTree(meshes[index].rest_vertices.numpy()).query(self.surfaces[-1].points)
            self.surface_points.append(nearest + starts[index])
        cloth = found["path_cloth_map"]
        self.surfaces += [FollowingSurface(path, self.scene.world_points(path)) for path in cloth]
        self.cloth = [slice(*ranges["particle"]) for ranges in cloth.values()]
        self.cables: list[str] = list(found["path_cable_map"])

    def _points(self, body: Body) -> npt.NDArray[np.float64]:
        """Initial positions of a body's particles, float64 [N, 3]."""
        return np.array(self._builder.particle_q[body.particles], dtype=np.float64)

    def _used_points(self) -> npt.NDArray[np.bool_]:
        """All particles without those points of soft bodies that belong to no tetrahedron, bool [P]."""
        used = np.ones(self._builder.particle_count, bool)
        for body in self.soft:
            used[body.particles] = False
            used[np.unique(np.array(self._builder.tet_indices[body.tets]))] = True
        return used

    def _error(self, text: str) -> InputError:
        return InputError(f"{self.scene.path}: {text}")

    def _facts(self) -> Iterator[str]:
        """Facts that a user may not expect, one line each."""
        scene, options = self.scene, self._options
        if not scene.says_metres:
            yield "the stage has no metersPerUnit: by USD's default its unit is a centimetre"
        if len(scene.physics_scenes) > 1:
            yield f"gravity is from the first of {len(scene.physics_scenes)} physics scenes, {scene.physics_scenes[0]}"
        if scene.skipped:
            yield f"prototypes of point instancers are not simulated: {_names(scene.skipped)}"
        if scene.stopped:
            yield f"bodies and colliders do not follow the stage's animation, which is stopped: {_names(scene.stopped)}"
        used = self._used_points()
        for body in self.soft:
            if alone := np.count_nonzero(~used[body.particles]):
                yield f"{body.prim.path}: points in no tetrahedron, which stay where they are: {alone}"
            attribute = scene.stage.GetPrimAtPath(body.prim.path).GetAttribute("physics:collisionEnabled")
            if attribute and attribute.Get() is False:
                yield (
                    f"{body.prim.path} collides, though its collision is disabled: Newton has no such switch for points"
                )
        for name in ("young", "poisson", "density"):
            said = all(name in scene.says(body.prim.path) for body in self.soft)
            if said and getattr(options, name) is not None:
                yield f"--{name} is not used: the stage gives it for all soft bodies"
        if len(self.soft) > 1 and not options.soft_contact:
            yield "soft bodies touch colliders and rigid bodies, not one another"

    # --- materials ---------------------------------------------------------------------------------------------------

    def _give_material(self, body: Body, gravity: float) -> None:
        """Give a body the material values that the stage lacks, and its viscosity.

        Args:
            body: The body; its values are set.
            gravity: Acceleration [m/s^2].
        """
        builder, scene, options = self._builder, self.scene, self._options
        units, path, x = scene.units, body.prim.path, self._points(body)
        tets = np.array(builder.tet_indices[body.tets]).reshape(-1, 4) - body.particles.start
        volumes = 1.0 / (6.0 * np.abs(np.linalg.det(np.array(builder.tet_poses[body.tets]).reshape(-1, 3, 3))))
        body.edge = float((6.0 * math.sqrt(2.0) * volumes.mean()) ** (1 / 3)) * units.metres
        said, chosen = scene.says(path), []
        masses = np.array(builder.particle_mass[body.particles], dtype=np.float64)
        if "density" not in said:
            density = _first(options.density, DENSITY)
            # A body's masses exist already, with a default; those of other tetrahedra do not.
            lumped = np.bincount(tets.ravel(), np.repeat(volumes / 4.0, 4), minlength=len(x)).astype(np.float64)
            masses = lumped if np.isnan(masses).any() else masses / (masses.sum() / volumes.sum())
            masses *= density / units.density
            builder.particle_mass[body.particles] = masses.tolist()
            chosen.append(("density", f"density {density:g} kg/m^3"))
        body.density = float(masses.sum() / volumes.sum()) * units.density
        if not body.density > 0.0:
            raise self._error(f"{path}: has no mass; it must have a positive mass")
        size = np.ptp(x, axis=0) * units.metres
        lame = np.array(builder.tet_materials[body.tets], dtype=np.float64)
        body.given = not np.isnan(lame[:, :2]).any()
        if not {"young", "poisson"} <= said.keys():
            weight = float(f"{STIFFNESS_PER_WEIGHT * body.density * gravity * size[self._axis]:.1e}")
            young, poisson = FALLBACK if body.given else (weight, POISSON)
            young = said["young"] * units.pressure if "young" in said else _first(options.young, young)
            poisson = said["poisson"] if "poisson" in said else _first(options.poisson, poisson)
            lame[:, 0] = young / (2.0 * (1.0 + poisson)) / units.pressure
            lame[:, 1] = 2.0 * lame[:, 0] * poisson / (1.0 - 2.0 * poisson)
            taken = {"young": f"E = {young:g} Pa", "poisson": f"nu = {poisson:g}"}
            chosen[:0] = [(name, text) for name, text in taken.items() if name not in said]
        mu, lam = lame[:, 0] * units.pressure, lame[:, 1] * units.pressure
        if not (np.isfinite(lame[:, :2]).all() and (mu > 0.0).all() and (3.0 * lam + 2.0 * mu > 0.0).all()):
            raise self._error(
                f"{path}: its material is not positive definite, with Lame's parameters mu = {mu[0]:g} Pa and lambda = "
                f"{lam[0]:g} Pa; Young's modulus must be positive, Poisson's ratio in (-1, 0.5)"
            )
        body.young = float(mu[0] * (3 * lam[0] + 2 * mu[0]) / (lam[0] + mu[0]))
        body.poisson = float(lam[0] / (2 * (lam[0] + mu[0])))
        relaxation = options.viscosity
        if relaxation is None:
            slowest = 0.5 * math.pi * math.sqrt(body.young / body.density) / float(size.max())
            relaxation = 2.0 * DAMPED_SHARE / slowest
        lame[:, 2] = 2.0 * lame[:, 0] * relaxation
        builder.tet_materials[body.tets] = [tuple(row) for row in lame.tolist()]
        if chosen:
            missing = "a physics material with missing values" if body.given else "no physics material for a volume"
            values, names = ", ".join(text for _, text in chosen), ", ".join(f"--{name}" for name, _ in chosen)
            self.notes.append(f"{path} has {missing}: {values} ({names})")

    def _contact_law(self) -> tuple[float, float]:
        """Stiffness [N/m] of contact, and damping [N s/m] at half of critical, for the stiffest of the bodies."""
        body = max(self.soft, key=lambda one: one.young * one.edge)
        stiffness = CONTACT_STIFFNESS * body.young * body.edge
        return stiffness, math.sqrt(stiffness * body.density * body.edge**3)

    # --- supports ----------------------------------------------------------------------------------------------------

    def _hold(self, attachments: Iterable[dict[str, Any]]) -> int:
        """Fix particles by an expression or by attachments to fixed bodies; returns their number.

        Infinitely stiff attachments to rigid bodies become as stiff as the tetrahedra around them.
        """
        builder, scene, fix = self._builder, self.scene, self._options.fix
        held: set[int] = set()
        ranges = {body.prim.path: body for body in self.soft}
        for attachment in attachments:
            body = ranges.get(attachment["src0"])
            done = attachment.get("attachment_particle_body_indices")
            if body is None or done or not attachment["enabled"] or attachment["type0"] != "point":
                continue
            inside = [i for i in attachment["indices0"] if 0 <= i < len(body.prim.points)]
            held |= {body.particles.start + i for i in inside}
        stiffness = builder.attachment_particle_body_stiffness
        for index in np.flatnonzero(np.isinf(np.array(stiffness))):
            particle = builder.attachment_particle_body_particle[index]
            body = next(b for b in self.soft if b.particles.start <= particle < b.particles.stop)
            stiffness[index] = body.young * body.edge / scene.units.kilograms
        chosen: set[int] = set()
        for body in self.soft:
            if fix is None:
                said = scene.held(body.prim.path)
            else:
                said = np.flatnonzero(select_nodes(fix, self._points(body) * scene.units.metres))
            chosen |= set((said[said < len(body.prim.points)] + body.particles.start).tolist())
        if fix is not None and not chosen:
            self.notes.append(f"no point is held by {fix!r}; coordinates are world ones in metres (--fix)")
        held |= chosen
        for particle in held:
            builder.particle_mass[particle] = 0.0
        if held:
            self.notes.append(f"{len(held)} points of soft bodies are held")
        if len(held) == sum(body.particles.stop - body.particles.start for body in self.soft):
            raise self._error("all points of soft bodies are held; at least one must be free to move")
        return len(held)

    def _stand(self, held: int) -> None:
        """Add a ground plane if requested."""
        builder, ground, metres, axis = self._builder, self._options.ground, self.scene.units.metres, self._axis
        # A collider does not fall if it has no body, a kinematic one, or one jointed to such a body.
        collides, still = int(newton.ShapeFlags.COLLIDE_SHAPES | newton.ShapeFlags.COLLIDE_PARTICLES), staying(builder)
        shapes = zip(builder.shape_body, builder.shape_flags, strict=True)
        stands = bool(held) or any(body in still and flags & collides for body, flags in shapes)
        if ground == "none" or (ground == "auto" and stands):
            if not stands:
                self.notes.append("nothing holds the bodies: they fall freely")
            return
        x = np.array(builder.particle_q, dtype=np.float64)[self._used_points()]
        radius = self._options.radius / metres
        if isinstance(ground, str):
            height = min(float(x[:, axis].min()) - radius, self.scene.lowest(self.rigid))
            self.notes.append(
                f"nothing supports the bodies: there is a ground at {'xyz'[axis]} = {height * metres:g} m (--ground)"
            )
        else:
            height = ground / metres
            self._check_ground(height, radius)
        builder.add_ground_plane(height=height)
        middle, reach = x.mean(axis=0), 5.0 * float(np.ptp(x, axis=0).max())
        corners = middle + reach * np.roll([(0, -1, -1), (0, 1, -1), (0, 1, 1), (0, -1, 1)], axis, axis=1)
        corners[:, axis] = height
        self.ground = corners

    # --- checks ------------------------------------------------------------------------------------------------------

    def _check_ground(self, height: float, radius: float) -> None:
        """Check that a requested ground plane is below everything that can move, in the stage's units."""
        axis, metres, masses = self._axis, self.scene.units.metres, np.array(self._builder.particle_mass)
        found = []
        for body in self.soft:
            free = self._points(body)[masses[body.particles] > 0.0, axis]
            if len(free):
                found.append((float(free.min()) - radius, body))
        low, body = min(found, key=lambda one: one[0])
        if low < height - TOUCHING * body.edge / metres:
            raise InputError(
                f"ground is {height * metres:g} m; {body.prim.path} reaches down to {'xyz'[axis]} = "
                f"{_round(low * metres)} m, {(height - low) * metres:.3g} m below it, and would be thrown up; it must "
                f'be at most {_round(low * metres)}, or "auto" (--ground)'
            )

    def _check_colliders(self) -> None:
        """Check that Newton can divide the size of every collider into voxels: it must be finite, and not absurdly long
        and thin."""
        builder = self._builder
        divided = [getattr(newton.GeoType, name) for name in ("MESH", "CONVEX_MESH", "BOX", "ELLIPSOID")]
        shapes = zip(builder.shape_type, builder.shape_scale, builder.shape_source, builder.shape_label, strict=True)
        for kind, scale, data, label in shapes:
            points = getattr(data, "vertices", None)
            if kind not in divided or (points is not None and not len(points)):
                continue
            own = np.full(3, 2.0) if points is None else np.ptp(np.asarray(points, dtype=np.float64), axis=0)
            size = np.abs(own * np.asarray(scale, dtype=np.float64))
            if not np.isfinite(size).all():
                raise self._error(f"collider {label} must have a finite size")
            sides = np.maximum(size, 1e-6)
            if sides.max() > LONGEST * np.prod(sides) ** (1.0 / 3.0):
                raise self._error(f"collider {label} is {sides.max():.3g} long and {sides.min():.3g} thin")

    def warn_of_overlaps(self, contacts: newton.Contacts) -> None:
        """Warn of soft bodies that begin in colliders, from which contact will push them.

        Args:
            contacts: Contacts of the initial state.
        """
        model, metres = self.model, self.scene.units.metres
        count = min(int(contacts.soft_contact_count.numpy()[0]), contacts.soft_contact_max)
        fields = (contacts.soft_contact_particle, contacts.soft_contact_shape, contacts.soft_contact_body_pos)
        particle, shape, point = (array.numpy()[:count] for array in fields)
        normal = contacts.soft_contact_normal.numpy()[:count].astype(np.float64)
        x, point = model.particle_q.numpy().astype(np.float64)[particle], point.astype(np.float64)
        owner = model.shape_body.numpy()[shape]
        if (moving := owner >= 0).any():
            pose = model.body_q.numpy().astype(np.float64)[owner[moving]]
            point[moving] = Rotation.from_quat(pose[:, 3:]).apply(point[moving]) + pose[:, :3]
        gap = np.einsum("ci,ci->c", normal, x - point) - model.particle_radius.numpy()[particle]
        gap[model.particle_inv_mass.numpy()[particle] == 0.0] = np.inf
        for body in self.soft:
            inside = (particle >= body.particles.start) & (particle < body.particles.stop)
            inside &= gap < -TOUCHING * body.edge / metres
            for one in np.unique(shape[inside]):
                deep = -gap[inside & (shape == one)].min() * metres
                warnings.warn(
                    f"{body.prim.path} begins {deep:.3g} m deep in {model.shape_label[one]}, and contact will throw it "
                    "out",
                    UserWarning,
                    stacklevel=3,
                )


def _builder(scene: Scene, options: StageOptions) -> newton.ModelBuilder:
    """A builder with its defaults in the stage's units, and marks for materials that the stage does not give."""
    metres, kilograms = scene.units
    x, y, z = (-GRAVITY / metres * (name == scene.up_axis) for name in "XYZ")
    builder = newton.ModelBuilder(up_axis=scene.up_axis, gravity=(x, y, z))
    builder.default_particle_radius = options.radius / metres
    builder.default_tet_k_mu = builder.default_tet_k_lambda = builder.default_tet_density = math.nan
    builder.rigid_gap /= metres
    shape = builder.default_shape_cfg
    shape.density /= scene.units.density
    shape.ke, shape.kd, shape.kf = (value / kilograms for value in (shape.ke, shape.kd, shape.kf))
    return builder


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


def _first(given: float | None, default: float) -> float:
    return default if given is None else given


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


def _names(paths: list[str]) -> str:
    return ", ".join(paths[:_NAMES]) + (f" and {len(paths) - _NAMES} more" if len(paths) > _NAMES else "")


def _round(value: float) -> str:
    """A height with few digits, and never minus zero."""
    return f"{round(value, 9) + 0.0:.6g}"
