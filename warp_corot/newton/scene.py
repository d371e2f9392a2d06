"""This package's meshes in Newton's scenes, and the solver's data in models and states: custom attributes in the
namespace ``warp_corot``."""

from __future__ import annotations

import math
from typing import Any, NamedTuple, TypedDict, Unpack

import numpy as np
import numpy.typing as npt
import warp as wp
from scipy.spatial.transform import Rotation

from warp_corot.discretization.discretization import centroids, lumped_masses
from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_indices, checked_number, checked_numbers, checked_vector, shown
from warp_corot.materials.isotropic import Isotropic
from warp_corot.mesh import TetForest, TetMesh
from warp_corot.mesh.topology import boundary_faces, right_handed, signed_volumes

from .library import newton

NAMESPACE = "warp_corot"

FOREST = f"{NAMESPACE}:forest"

#: Attributes of every tetrahedron in a state, with their types.
STATE = {"rotation": wp.quat, "stress": wp.mat33, "von_mises": wp.float32}


class Added(NamedTuple):
    """The result of adding a mesh: ranges of indices in the builder."""

    particles: range
    tetrahedra: range


class Placing(TypedDict, total=False):
    """Options of ``add_forest`` and ``add_mesh``."""

    pos: npt.ArrayLike
    rot: npt.ArrayLike
    vel: npt.ArrayLike
    k_damp: npt.ArrayLike
    fixed: npt.ArrayLike | None
    particle_radius: float | None
    surface: bool


def add_forest(builder: newton.ModelBuilder, mesh: TetForest, material: Isotropic, **placing: Unpack[Placing]) -> Added:
    """Add an adaptive forest. ``SolverCorotated`` steps it by its subtrees, several times as fast as other tetrahedra.

    For any other solver it consists of ordinary tetrahedra. Tetrahedra that are partly filled have the stiffness and
    mass of that part.

    Args:
        builder: The builder; it can be added to other builders and replicated afterwards.
        mesh: The forest.
        material: Its material; Lamé's parameters become ``k_mu`` and ``k_lambda``.
        placing: ``pos``: position of the mesh's origin [m], (0, 0, 0) by default. ``rot``: rotation, a unit quaternion
            (x, y, z, w). ``vel``: velocity of all its particles [m/s], zero. ``k_damp``: viscosity [Pa s], a number or
            [T], zero. ``fixed``: nodes without mass, which are kinematic: mask bool [N] or indices.
            ``particle_radius``: radius for contact [m], zero or positive; None: the builder's default. ``surface``:
            whether to add triangles and edges without stiffness at its boundary, for viewers and contact; True.

    Returns:
        The particles and tetrahedra, in the forest's order.

    Raises:
        InputError: Not a forest, an anisotropic material, an argument of the wrong type or shape or out of its range,
            or a position so far away that float32 cannot separate the corners of a tetrahedron. Then nothing was added.
    """
    if not isinstance(mesh, TetForest):
        raise InputError(f"mesh is a {type(mesh).__name__}; add_forest takes a TetForest, add_mesh any tetrahedra")
    added = _add(builder, mesh, material, **placing)
    register_forests(builder)
    row = {"forest": ForestName.of(mesh), "forest_particle": added.particles.start}
    row["forest_tet"] = added.tetrahedra.start
    builder.add_custom_values(**{f"{NAMESPACE}:{name}": value for name, value in row.items()})
    if mesh.fill is not None:
        values = builder.custom_attributes[f"{NAMESPACE}:fill"].values
        assert isinstance(values, dict)
        cut = np.flatnonzero(mesh.fill != 1.0)
        values.update(zip((cut + added.tetrahedra.start).tolist(), mesh.fill[cut].tolist(), strict=True))
    return added


def add_mesh(builder: newton.ModelBuilder, mesh: TetMesh, material: Isotropic, **placing: Unpack[Placing]) -> Added:
    """Add general tetrahedra. ``TetMesh`` has repaired wrongly wound ones, which Newton's builder leaves out.

    Arguments, result and errors are those of ``add_forest``.
    """
    if not isinstance(mesh, TetMesh):
        raise InputError(f"mesh is a {type(mesh).__name__}; add_mesh takes a TetMesh")
    return _add(builder, mesh, material, **placing)


def _add(
    builder: newton.ModelBuilder,
    mesh: TetForest | TetMesh,
    material: Isotropic,
    *,
    pos: npt.ArrayLike = (0.0, 0.0, 0.0),
    rot: npt.ArrayLike = (0.0, 0.0, 0.0, 1.0),
    vel: npt.ArrayLike = (0.0, 0.0, 0.0),
    k_damp: npt.ArrayLike = 0.0,
    fixed: npt.ArrayLike | None = None,
    particle_radius: float | None = None,
    surface: bool = True,
) -> Added:
    if not isinstance(builder, newton.ModelBuilder):
        raise InputError(f"builder is {builder!r}; it must be a newton.ModelBuilder")
    if not isinstance(material, Isotropic):
        raise InputError(f"material is a {type(material).__name__}; in Newton it must be Isotropic")
    material = material.at(centroids(mesh)) if material.functions else material
    material.check_shapes(1, len(mesh.tets))
    share, count = mesh_fill(mesh), len(mesh.tets)
    columns = [np.broadcast_to(np.ravel(share * a), count) for a in (material.mu, material.lam)]
    columns.append(np.broadcast_to(_damping(k_damp, count), count))
    velocity = tuple(checked_vector(vel, "vel", "m/s"))
    x = mesh.points @ _rotation(rot).T + checked_vector(pos, "pos")
    masses = lumped_masses(mesh, material).copy()
    if fixed is not None:
        masses[checked_indices(fixed, len(x), "node")] = 0.0
    if particle_radius is not None and not 0.0 <= checked_number(particle_radius, "particle_radius", "m") < np.inf:
        raise InputError(f"particle_radius is {particle_radius!r}; it must be zero or a positive number [m], or None")
    radii = None if particle_radius is None else [float(particle_radius)] * len(x)
    tets = outward_tets(mesh)
    _check_resolved(x, tets, pos)
    first, first_tet = builder.particle_count, builder.tet_count

    builder.add_particles([tuple(p) for p in x.tolist()], [velocity] * len(x), masses.tolist(), radii)
    # The same as ``add_tetrahedron`` does one by one.
    corners = x[tets]
    edges = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
    builder.tet_indices.extend(map(tuple, (tets + first).tolist()))
    builder.tet_poses.extend(np.linalg.inv(edges).tolist())
    builder.tet_activations.extend([0.0] * count)
    builder.tet_materials.extend(map(tuple, np.stack(columns, axis=1).tolist()))
    if surface:
        faces = boundary_faces(mesh.tets, mesh.points)[0] + first
        nothing = dict.fromkeys(("tri_ke", "tri_ka", "tri_kd", "tri_drag", "tri_lift"), [0.0] * len(faces))
        builder.add_triangles(*faces.T.tolist(), **nothing)
        sides = _edges_of(faces)
        nothing = dict.fromkeys(("rest", "edge_ke", "edge_kd"), [0.0] * len(sides))
        builder.add_edges(*sides.T.tolist(), **nothing)
    return Added(range(first, first + len(x)), range(first_tet, first_tet + count))


def _edges_of(faces: npt.NDArray[np.integer]) -> npt.NDArray[np.integer]:
    """Each edge of a surface as Newton's builder has it: opposite vertices, -1 where there is none, and the ends,
    [E, 4]."""
    sides = np.concatenate([np.roll(faces, -k, axis=1) for k in range(3)])
    ends = np.sort(sides[:, :2], axis=1)
    _, first, place = np.unique(ends, axis=0, return_index=True, return_inverse=True)
    second = np.full(len(first), -1)
    later = np.setdiff1d(np.arange(len(sides)), first)
    second[np.ravel(place)[later]] = sides[later, 2]
    return np.stack([sides[first, 2], second, sides[first, 0], sides[first, 1]], axis=1)


def mesh_fill(mesh: TetForest | TetMesh) -> Any:
    """Fraction of each element inside the body, float64 [T], or 1 if all elements are full."""
    fill = getattr(mesh, "fill", None)
    return 1.0 if fill is None else fill


def outward_tets(mesh: TetForest | TetMesh) -> npt.NDArray[np.int32]:
    """The mesh's elements with positive volume, as Newton needs them; half of a forest's are mirrored. int32 [T, 4]."""
    return right_handed(np.array(mesh.tets), signed_volumes(mesh.points, mesh.tets) < 0)


def _check_resolved(x: npt.NDArray[np.float64], tets: npt.NDArray[np.int32], pos: npt.ArrayLike) -> None:
    """Refuse a position where rounding to float32 changes the volume of a tetrahedron by more than a tenth."""
    volumes = signed_volumes(x, tets)
    rounded = signed_volumes(x.astype(np.float32).astype(np.float64), tets)
    if not (np.abs(rounded - volumes) < 0.1 * volumes).all():
        step = float(np.spacing(np.abs(x).max().astype(np.float32)))
        raise InputError(
            f"pos is {pos!r}: positions there are {step:.2g} m apart in float32, too coarse for tetrahedra of "
            f"{volumes.min():.2g} m^3; pos must be nearer to the origin"
        )


def _rotation(given: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """The matrix of a quaternion (x, y, z, w) with unit length to float32 rounding, float64 [3, 3]."""
    wanted = "it must be a unit quaternion (x, y, z, w)"
    rot = checked_numbers(given, "rot", "[4]").ravel()
    norm = float(np.linalg.norm(rot)) if rot.shape == (4,) else math.nan
    if not abs(norm - 1.0) <= 1e-3:
        raise InputError(f"rot is {shown(given)}, of length {norm:.4g}; {wanted}")
    return np.asarray(Rotation.from_quat(rot).as_matrix())


def _damping(given: npt.ArrayLike, count: int) -> npt.NDArray[np.float64]:
    """k_damp [Pa s], float64 [1] or [count]."""
    wanted = f"zero or positive [Pa s], a number or one for each of {count} tetrahedra"
    values = checked_numbers(given, "k_damp", wanted).ravel()
    bad = np.flatnonzero(~(np.isfinite(values) & (values >= 0)))
    if len(bad) or values.size not in (1, count):
        said = f"{values[bad[0]]:g} in {bad[0]}" if len(bad) else f"of shape {np.shape(given)}"
        raise InputError(f"k_damp is {said}; it must be {wanted}")
    return values


class ForestName(str):
    """The name of a forest in builders and models, with a reference to the forest.

    Newton keeps text unchanged; a model that was written to a file and read again has a plain ``str``.
    """

    forest: TetForest

    @classmethod
    def of(cls, forest: TetForest) -> ForestName:
        name = cls(f"forest of {len(forest.tets)} tetrahedra")
        name.forest = forest
        return name


def register_custom_attributes(builder: newton.ModelBuilder) -> None:
    """Let states carry results for each tetrahedron, as ``state.warp_corot``; call it before ``finalize``.

    ``rotation``: wp.quat [T], from rest to world. ``stress``: wp.mat33 [T], Cauchy stress in world axes [Pa].
    ``von_mises``: wp.float32 [T] [Pa]. All belong to the positions in the same state. They cost about one force
    evaluation a step. ``State.assign`` copies them. Newton 1.8's ``ViewerFile`` does not record namespaces, and could
    not load a model whose state attributes have none; ``SolverCorotated.write_attributes`` computes them again.
    """
    of_states = newton.Model.AttributeAssignment.STATE
    for name, dtype in STATE.items():
        _add_attribute(builder, name, dtype, assignment=of_states)


def register_forests(builder: newton.ModelBuilder) -> None:
    """Add attributes to the model for the forest and the fill of each tetrahedron."""
    if f"{NAMESPACE}:forest" in builder.custom_attributes:
        return
    builder.add_custom_frequency(newton.ModelBuilder.CustomFrequency(name="forest", namespace=NAMESPACE))
    _add_attribute(builder, "forest", str, FOREST, default="")
    for name, references in (("forest_particle", "particle"), ("forest_tet", "tetrahedron")):
        _add_attribute(builder, name, wp.int32, FOREST, references=references)
    _add_attribute(builder, "fill", wp.float32, default=1.0)


def _add_attribute(builder: newton.ModelBuilder, name: str, dtype: type, frequency: Any = None, **options: Any) -> None:
    """Add an attribute, of every tetrahedron unless there is another frequency."""
    frequency = newton.Model.AttributeFrequency.TETRAHEDRON if frequency is None else frequency
    attribute = newton.ModelBuilder.CustomAttribute(name, dtype, frequency, namespace=NAMESPACE, **options)
    builder.add_custom_attribute(attribute)


def attribute_of(owner: Any, name: str) -> Any:
    """An attribute in a model's or a state's namespace, or None."""
    return getattr(getattr(owner, NAMESPACE, None), name, None)
