"""This package's meshes in Newton's scenes, and the solver's data in models and states: custom attributes in the
namespace ``warp_corot``."""

from __future__ import annotations

import math
from numbers import Real
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import warp as wp
from scipy.spatial.transform import Rotation

from warp_corot.discretization.discretization import centroids, lumped_masses
from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_indices
from warp_corot.materials.isotropic import Isotropic
from warp_corot.mesh import TetForest, TetMesh
from warp_corot.mesh.topology import boundary_faces, signed_volumes

from .library import newton

NAMESPACE = "warp_corot"

FOREST = f"{NAMESPACE}:forest"

#: Attributes of every tetrahedron in a state, with their types.
STATE = {"rotation": wp.quat, "stress": wp.mat33, "von_mises": wp.float32}


class Added(NamedTuple):
    """The result of adding a mesh: ranges of indices in the builder."""

    particles: range
    tetrahedra: range


def add_forest(
    builder: newton.ModelBuilder,
    mesh: TetForest,
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
    """Add an adaptive forest. ``SolverCorotated`` steps it by its subtrees, several times as fast as other tetrahedra.

    For any other solver it consists of ordinary tetrahedra. Tetrahedra that are partly filled have the stiffness and
    mass of that part.

    Args:
        builder: The builder; it can be added to other builders and replicated afterwards.
        mesh: The forest.
        material: Its material; Lamé's parameters become ``k_mu`` and ``k_lambda``.
        pos: Position of the mesh's origin [m].
        rot: Rotation, a unit quaternion (x, y, z, w).
        vel: Velocity of all its particles [m/s].
        k_damp: Viscosity [Pa s], a number or [T].
        fixed: Nodes without mass, which are kinematic: mask bool [N] or indices.
        particle_radius: Radius for contact [m], zero or positive; None: the builder's default.
        surface: Whether to add triangles and edges without stiffness at its boundary, for viewers and contact.

    Returns:
        The particles and tetrahedra, in the forest's order.

    Raises:
        InputError: Not a forest, an anisotropic material, an argument of the wrong type or shape or out of its range,
            or a position so far away that float32 cannot separate the corners of a tetrahedron. Then nothing was added.
    """
    if not isinstance(mesh, TetForest):
        raise InputError(f"mesh is a {type(mesh).__name__}; add_forest takes a TetForest, add_mesh any tetrahedra")
    added = _add(builder, mesh, material, pos, rot, vel, k_damp, fixed, particle_radius, surface)
    register_forests(builder)
    starts = {"forest_particle": added.particles.start, "forest_tet": added.tetrahedra.start}
    row = {"forest": ForestName.of(mesh), **starts}
    builder.add_custom_values(**{f"{NAMESPACE}:{name}": value for name, value in row.items()})
    if mesh.fill is not None:
        values = builder.custom_attributes[f"{NAMESPACE}:fill"].values
        assert isinstance(values, dict)
        cut = np.flatnonzero(mesh.fill != 1.0)
        values.update(zip((cut + added.tetrahedra.start).tolist(), mesh.fill[cut].tolist(), strict=True))
    return added


def add_mesh(
    builder: newton.ModelBuilder,
    mesh: TetMesh,
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
    """Add general tetrahedra. ``TetMesh`` has repaired wrongly wound ones, which Newton's builder leaves out.

    Arguments, result and errors are those of ``add_forest``.
    """
    if not isinstance(mesh, TetMesh):
        raise InputError(f"mesh is a {type(mesh).__name__}; add_mesh takes a TetMesh")
    return _add(builder, mesh, material, pos, rot, vel, k_damp, fixed, particle_radius, surface)


def _add(
    builder: newton.ModelBuilder,
    mesh: TetForest | TetMesh,
    material: Isotropic,
    pos: npt.ArrayLike,
    rot: npt.ArrayLike,
    vel: npt.ArrayLike,
    k_damp: npt.ArrayLike,
    fixed: npt.ArrayLike | None,
    radius: float | None,
    surface: bool,
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
    velocity = tuple(_vector(vel, 3, "vel"))
    x = mesh.points @ _rotation(rot).T + _vector(pos, 3, "pos")
    masses = lumped_masses(mesh, material).copy()
    if fixed is not None:
        masses[checked_indices(fixed, len(x), "node")] = 0.0
    radii = None if radius is None else [_radius(radius)] * len(x)
    tets = right_handed(mesh)
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
        nothing = [0.0] * len(faces)
        i, j, k = (column.tolist() for column in faces.T)
        builder.add_triangles(
            i, j, k, tri_ke=nothing, tri_ka=nothing, tri_kd=nothing, tri_drag=nothing, tri_lift=nothing
        )
        sides = _edges_of(faces)
        nothing = [0.0] * len(sides)
        builder.add_edges(*sides.T.tolist(), rest=nothing, edge_ke=nothing, edge_kd=nothing)
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


def right_handed(mesh: TetForest | TetMesh) -> npt.NDArray[np.int32]:
    """The mesh's elements with positive volume, as Newton needs them; half of a forest's are mirrored. int32 [T, 4]."""
    tets = np.array(mesh.tets)
    mirrored = signed_volumes(mesh.points, tets) < 0
    tets[mirrored] = tets[mirrored][:, [0, 1, 3, 2]]
    return tets


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
    rot = _vector(given, 4, "rot")
    norm = float(np.linalg.norm(rot))
    if abs(norm - 1.0) > 1e-3:
        raise InputError(f"rot is {given!r}, of length {norm:.4g}; it must be a unit quaternion (x, y, z, w)")
    return np.asarray(Rotation.from_quat(rot).as_matrix())


def _radius(given: float) -> float:
    if isinstance(given, bool) or not isinstance(given, Real) or not (math.isfinite(given) and given >= 0):
        raise InputError(f"particle_radius is {given!r}; it must be zero or a positive number [m], or None")
    return float(given)


def _damping(given: npt.ArrayLike, count: int) -> npt.NDArray[np.float64]:
    """k_damp [Pa s], float64 [1] or [count]."""
    values = _numbers(given)
    wanted = f"k_damp must be zero or positive [Pa s], a number or one for each of {count} tetrahedra"
    if values is None or values.size not in (1, count):
        raise InputError(f"{wanted}; it is {repr(given) if np.ndim(given) == 0 else f'of shape {np.shape(given)}'}")
    bad = np.flatnonzero(~(np.isfinite(values) & (values >= 0)))
    if len(bad):
        raise InputError(f"{wanted}; it is {values[bad[0]]:g}{f' in {bad[0]}' if values.size > 1 else ''}")
    return values


def _vector(given: npt.ArrayLike, size: int, name: str) -> npt.NDArray[np.float64]:
    values = _numbers(given)
    if values is None or values.shape != (size,) or not np.isfinite(values).all():
        raise InputError(f"{name} is {given!r}; it must be {size} finite numbers")
    return values


def _numbers(given: npt.ArrayLike) -> npt.NDArray[np.float64] | None:
    """Numbers as a flat array, float64 [n], or None if the input has no numbers."""
    try:
        return np.asarray(given, dtype=np.float64).ravel()
    except (TypeError, ValueError):
        return None


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
