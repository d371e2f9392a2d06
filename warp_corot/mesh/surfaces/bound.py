"""Points and surfaces that follow a mesh: the element that holds each point, and the nodes to which it is bound.

A walk down the tree finds the element of a forest, a tree of bounding boxes that of other meshes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_indices, checked_numbers, checked_points
from warp_corot.kernels.meshing import embedding as kernels
from warp_corot.kernels.meshing.embedding import find_holders
from warp_corot.kernels.meshing.windings import find_nearest
from warp_corot.mesh.topology import boundary_faces, coordinates_in
from warp_corot.mesh.tree import Tree

if TYPE_CHECKING:
    from warp_corot.mesh.forest_arrays import ForestArrays

#: Points farther away than this many lengths of the mesh are moved to that distance; float32 cannot resolve more.
FARTHEST = 1.0e3


def embed_in_tets(nodes: np.ndarray, tets: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The tetrahedron that holds each point, or the one behind the nearest face, and the point's coordinates in it.

    Args:
        nodes: float64 [N, 3].
        tets: int32 [T, 4].
        points: [n, 3].

    Returns:
        Tetrahedra int32 [n], and barycentric coordinates float64 [n, 4]; some are negative for points outside.

    Raises:
        InputError: The points are not [n, 3], or not finite.
    """
    points = checked_points(points)
    device = wp.get_device("cpu")
    # Relative to the centre of the mesh, because float32 keeps few digits far from zero.
    middle = nodes[tets].reshape(-1, 3).mean(axis=0)
    placed, moved = nodes - middle, points - middle
    size = float(np.ptp(placed, axis=0).max())
    corners = placed[tets]
    low, high = corners.min(axis=1) - 1e-6 * size, corners.max(axis=1) + 1e-6 * size
    lowers, uppers = (wp.array(x.astype(np.float32), dtype=wp.vec3, device=device) for x in (low, high))
    tree = wp.Bvh(lowers, uppers)
    moved = moved * (FARTHEST * size / np.maximum(np.abs(moved).max(axis=1, keepdims=True), FARTHEST * size))
    at = wp.array(moved, dtype=wp.vec3d, device=device)
    inverse = np.linalg.inv(np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2))
    inputs = [
        tree.id,
        at,
        wp.array(corners[:, 0], dtype=wp.vec3d, device=device),
        wp.array(inverse, dtype=wp.mat33d, device=device),
    ]
    found = wp.empty(len(points), dtype=wp.int32, device=device)
    wp.launch(find_holders, len(points), inputs, [found], device=device)
    elements = found.numpy()
    outside = np.flatnonzero(elements < 0)
    if len(outside):
        elements[outside] = nearest_tets(nodes, tets, points[outside])
    later = np.einsum("nij,nj->ni", inverse[elements], points - middle - corners[elements, 0])
    return elements, np.column_stack([1.0 - later.sum(axis=1), later])


def nearest_tets(nodes: np.ndarray, tets: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The tetrahedron behind the boundary face that is closest to each point, int32 [n]."""
    faces, parents = boundary_faces(tets, nodes)
    # Relative to the centre of the mesh, because float32 keeps few digits far from zero.
    middle, limit = nodes[faces].reshape(-1, 3).mean(axis=0), FARTHEST * float(np.ptp(nodes[faces], axis=(0, 1)).max())
    moved = points - middle
    moved *= limit / np.maximum(np.abs(moved).max(axis=1, keepdims=True), limit)
    return parents[nearest_faces(nodes - middle, faces, moved, 10.0 * limit)]


def nearest_faces(nodes: np.ndarray, faces: np.ndarray, points: np.ndarray, far: float) -> np.ndarray:
    """The triangle closest to each point, int32 [n]; -1 if none is closer than ``far`` [m]."""
    return _nearest(nodes, faces, points, far, "cpu")[0]


def distances_from(
    nodes: np.ndarray, faces: np.ndarray, points: np.ndarray, far: float, device: wp.Device | str = "cpu"
) -> np.ndarray:
    """The distance of each point from a surface, at most ``far`` [m], float32 [n]."""
    middle = nodes.mean(axis=0)  # float32 keeps few digits far from zero
    return _nearest(nodes - middle, faces, points - middle, far, device)[1]


def _nearest(
    nodes: np.ndarray, faces: np.ndarray, points: np.ndarray, far: float, device: wp.Device | str
) -> tuple[np.ndarray, np.ndarray]:
    mesh = wp.Mesh(
        wp.array(nodes, dtype=wp.vec3, device=device),
        wp.array(np.ascontiguousarray(faces, dtype=np.int32).ravel(), dtype=wp.int32, device=device),
    )
    given = wp.array(points, dtype=wp.vec3, device=device)
    found = [wp.empty(len(points), dtype=dtype, device=device) for dtype in (wp.int32, wp.float32)]
    wp.launch(find_nearest, len(points), [given, mesh.id, far], found, device=device)
    return found[0].numpy(), found[1].numpy()


#: The path from one corner of a cube to the opposite one, by the axes in descending order of a point's coordinates.
_WALKS = np.array([[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]])


def embed(forest: ForestArrays, points: npt.ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """See `TetForest.embed`."""
    points = checked_points(points)
    found = leaves_at(forest.tree, forest.cells, forest.origin, forest.cell_size, points)
    number = np.full(len(forest.tree.level) + 1, -1, np.int32)
    number[forest.tree.leaves] = np.arange(len(forest.tree.leaves), dtype=np.int32)
    elements = number[found]
    outside = np.flatnonzero(elements < 0)
    if len(outside):
        elements[outside] = nearest_tets(forest.points, forest.tets, points[outside])
    return elements, barycentric(forest, elements, points)


def barycentric(forest: ForestArrays, elements: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Barycentric coordinates of points in leaves, float64 [n, 4]; some are negative for points outside."""
    return coordinates_in(forest.points[forest.tets[elements]], points)


def leaves_at(
    tree: Tree, grid: tuple[int, int, int], origin: npt.ArrayLike, cell_size: float, points: np.ndarray
) -> np.ndarray:
    """The live leaf of a tree, by its number there, that contains each point, int32 [n], -1 if there is none."""
    cells = np.array(grid)
    scaled = (points - np.asarray(origin)) / cell_size
    within = np.flatnonzero(((scaled >= 0) & (scaled <= cells)).all(axis=1))
    found = np.full(len(points), -1, np.int32)
    if not len(within):
        return found
    scaled = scaled[within]
    cube = np.minimum(scaled.astype(np.int64), cells - 1)
    rest = scaled - cube
    order = np.argsort(-rest, axis=1, kind="stable")
    walk = np.argmax((order[:, None] == _WALKS).all(axis=2), axis=1)
    down = np.take_along_axis(rest, order, axis=1)
    weights = np.column_stack([1 - down[:, 0], down[:, 0] - down[:, 1], down[:, 1] - down[:, 2], down[:, 2]])
    roots = 6 * np.ravel_multi_index(tuple(cube.T), grid) + walk
    device = wp.get_device("cpu")
    inputs = [
        wp.array(roots, dtype=wp.int32, device=device),
        wp.array(weights, dtype=wp.vec4d, device=device),
        wp.array(tree.level, dtype=wp.int32, device=device),
        wp.array(tree.first_child, dtype=wp.int32, device=device),
    ]
    leaves = wp.empty(len(within), dtype=wp.int32, device=device)
    wp.launch(kernels.descend, len(within), inputs, [leaves], device=device)
    found[within] = leaves.numpy()
    return found


#: The length of the mean of the normals at the points that a node bears, below which they lie on opposite sides; at a
#: corner of a cube it is 0.58.
SIDED = 0.4

#: Why bodies that can be cut have no bound surfaces.
NOT_OPENED = (
    "a surface that is bound to a body does not come apart where it is cut; body.mesh.surface() is the present one"
)


@dataclass(frozen=True, eq=False, repr=False)
class BoundPoints:
    """Points that follow the deformation of a mesh.

    Attributes:
        points: Rest positions [m], float64 [V, 3].
        nodes: The nodes to which each point is bound, int32 [V, 4].
        weights: Weights of these nodes, float64 [V, 4]; they sum to one.
    """

    points: np.ndarray
    nodes: np.ndarray
    weights: np.ndarray

    def __repr__(self) -> str:
        return f"<{type(self).__name__} of {len(self.points)} points>"

    def moved(self, displacements: npt.ArrayLike) -> np.ndarray:
        """Positions [m], float64 [V, 3], after displacements [N, 3] of the mesh's nodes [m]."""
        u = checked_numbers(displacements, "displacements", "[N, 3]")
        least = int(self.nodes.max(initial=-1)) + 1
        if u.ndim != 2 or u.shape[1] != 3 or len(u) < least:
            raise InputError(f"displacements has shape {u.shape}; it must be [N, 3] for the mesh's N nodes")
        return self.points + np.einsum("vn,vnc->vc", self.weights, u[self.nodes])

    def on_device(self, device: str | wp.Device | None = None) -> DeviceBinding:
        """The binding that moves the points on a device."""
        return DeviceBinding(self, wp.get_device(device))


@dataclass(frozen=True, eq=False, repr=False)
class SurfaceMesh(BoundPoints):
    """A triangle surface that follows the deformation of a mesh.

    Attributes:
        triangles: int32 [F, 3], wound counter-clockwise seen from outside.
        sides: Labels behind and in front of each triangle, int32 [F, 2], 0 outside; None for a single body.
        is_cut: Which triangles are faces of cuts, bool [F]; None: the body is not cut.
    """

    triangles: np.ndarray
    sides: np.ndarray | None = None
    is_cut: np.ndarray | None = None

    @property
    def ends(self) -> np.ndarray:
        """The ends of the edge on which each point of a marched surface lies, int32 [V, 2].

        A point at a node has this node twice. ``weights[:, 1]`` says how far along the edge the point is, 0 to 1.
        Points on edges of elements that were left out are bound to four nodes of the nearest element instead.
        """
        return self.nodes[:, :2]

    @property
    def of_cut(self) -> npt.NDArray[np.bool_]:
        """Which triangles are faces of cuts, bool [F]."""
        return np.zeros(len(self.triangles), bool) if self.is_cut is None else self.is_cut

    @cached_property
    def normals(self) -> np.ndarray:
        """Outward unit normals of the points at rest, weighted by the triangles' areas, float64 [V, 3]."""
        return vertex_normals(self.points, self.triangles)

    @cached_property
    def is_thin(self) -> npt.NDArray[np.bool_]:
        """Whether a node of each point bears points of opposite sides of the body, too, bool [V]."""
        nodes, weights = self.nodes.ravel(), np.abs(self.weights).ravel()
        ways = np.repeat(self.normals, self.nodes.shape[1], axis=0) * weights[:, None]
        sums = np.column_stack([np.bincount(nodes, each) for each in ways.T])
        one_sided = np.linalg.norm(sums, axis=1) >= SIDED * np.bincount(nodes, weights)
        return ~(one_sided[self.nodes] | (self.weights == 0.0)).all(axis=1)

    @property
    def area(self) -> float:
        """[m^2]."""
        return float(0.5 * np.linalg.norm(self._doubled_areas, axis=1).sum())

    @property
    def volume(self) -> float:
        """The enclosed volume [m^3]."""
        # Relative to its centre, so that a body far from the origin loses no digits.
        x = self.points - self.points.mean(axis=0)
        return float(np.einsum("fc,fc->", x[self.triangles[:, 0]], self._doubled_areas) / 6.0)

    @property
    def euler_characteristic(self) -> int:
        """Vertices minus edges plus triangles: 2 for a ball, 0 for a torus."""
        edges = np.sort(np.concatenate([self.triangles[:, [i, j]] for i, j in ((0, 1), (1, 2), (2, 0))]), axis=1)
        used = len(np.unique(self.triangles))
        return used - len(np.unique(edges, axis=0)) + len(self.triangles)

    def of_label(self, label: int) -> SurfaceMesh:
        """The closed surface around one label, from a surface with ``sides``.

        Args:
            label: Its number, its place in ``label_names`` plus one.

        Raises:
            InputError: The surface has no sides, or none with that label.
        """
        if self.sides is None:
            raise InputError("this surface is around one body; surfaces between labels come from separating_surface()")
        behind, front = (self.sides == label).T
        if not (behind | front).any():
            raise InputError(f"label {label} has no surface; there are {np.unique(self.sides).tolist()}")
        triangles = np.concatenate([self.triangles[behind], self.triangles[front][:, ::-1]])
        used, triangles = np.unique(triangles, return_inverse=True)
        return SurfaceMesh(
            self.points[used], self.nodes[used], self.weights[used], triangles.reshape(-1, 3).astype(np.int32)
        )

    @property
    def _doubled_areas(self) -> np.ndarray:
        a, b, c = np.moveaxis(self.points[self.triangles], 1, 0)
        return np.cross(b - a, c - a)


class DeviceBinding:
    """Bound points on a device: kernels update their positions and, for a surface, their normals.

    Attributes:
        positions: [m], vec3 [V].
        normals: Unit vectors, vec3 [V]; None for points without triangles.
    """

    def __init__(self, bound: BoundPoints, device: wp.Device):
        self.device = device
        self.rest = wp.array(bound.points, dtype=wp.vec3, device=device)
        self.nodes = wp.array(bound.nodes, dtype=wp.vec4i, device=device)
        self.weights = wp.array(bound.weights, dtype=wp.vec4, device=device)
        self.positions = wp.clone(self.rest)
        self.triangles: Any = None
        self.normals: Any = None
        if isinstance(bound, SurfaceMesh):
            self.triangles = wp.array(bound.triangles, dtype=wp.vec3i, device=device)
            self.normals = wp.array(bound.normals, dtype=wp.vec3, device=device)

    def update(self, displacements: wp.array) -> None:
        """Move the points and normals with displacements of the nodes [m], vec3 [N] on the same device."""
        inputs = [self.rest, self.nodes, self.weights, displacements]
        wp.launch(kernels.move_points, len(self.rest), inputs, [self.positions], device=self.device)
        if self.triangles is not None:
            self.normals.zero_()
            inputs = [self.positions, self.triangles]
            wp.launch(kernels.add_triangle_normals, len(self.triangles), inputs, [self.normals], device=self.device)
            wp.launch(kernels.normalize_all, len(self.normals), [], [self.normals], device=self.device)


def vertex_normals(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Unit normals of vertices, weighted by the areas of their triangles, [V, 3]."""
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    face = np.cross(b - a, c - a)
    normals = np.column_stack(
        [np.bincount(triangles.ravel(), np.repeat(face[:, axis], 3), len(points)) for axis in range(3)]
    )
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.divide(normals, length, out=np.zeros(normals.shape), where=length > 0)


def bound(points: np.ndarray, nodes: np.ndarray, weights: np.ndarray, triangles: npt.ArrayLike | None) -> BoundPoints:
    """A user's points bound to nodes; with triangles [F, 3], a surface, wound outwards if it is closed.

    Args:
        points: Rest positions [m], [V, 3].
        nodes, weights: See ``BoundPoints``.

    Raises:
        InputError: The triangles have another shape, or name points that do not exist.
    """
    rest = checked_points(points).copy()
    if triangles is None:
        return BoundPoints(rest, nodes, weights)
    try:
        faces = np.asarray(triangles)
    except ValueError:
        raise InputError("triangles has rows of different lengths; it must be [F, 3]") from None
    if faces.ndim != 2 or faces.shape[1] != 3:
        raise InputError(f"triangles has shape {faces.shape}; it must be [F, 3]")
    checked_indices(faces.ravel(), len(rest), "point")
    from warp_corot.domain.closing import turned_inwards  # whose package imports meshes

    turned, _ = turned_inwards(rest, faces)
    faces = np.where(turned[:, None], faces[:, ::-1], faces)
    return SurfaceMesh(rest, nodes, weights, faces.astype(np.int32))
