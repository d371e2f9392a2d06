"""The surface that is shown of a body, bound to its nodes and read once a frame, and its colours."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.body.soft_body import SoftBody
from warp_corot.contact.reading import pressure_at_nodes
from warp_corot.io.pictures.colors import VertexAverage
from warp_corot.io.write.skins import BoundSkins, OwnSurface, has_domain, joined_surfaces
from warp_corot.mesh import TetForest
from warp_corot.mesh.surfaces.bodies import boundary_surface
from warp_corot.mesh.surfaces.bound import BoundPoints, DeviceBinding, SurfaceMesh, nearest_faces
from warp_corot.mesh.surfaces.marching import marched
from warp_corot.simulation.simulation import Simulation

#: The names of surfaces that a body may have. At first the page shows the first of them that the body has.
INPUT, MARCHED, ELEMENTS = "input's own", "marched", "tetrahedra"


def surfaces_of(mesh: Any, own: SurfaceMesh | OwnSurface | None = None) -> dict[str, SurfaceMesh]:
    """The surfaces that can be shown of a mesh, by name, each bound to its nodes.

    Args:
        mesh: A forest or a general mesh.
        own: The user's own surface, if there is one.
    """
    found = {}
    if own is not None:
        found[INPUT] = joined_surfaces([skin.surface for skin in BoundSkins([mesh], own, changing=[True]).on([mesh])])
    if has_domain(mesh):
        found[MARCHED] = mesh.surface()
    found[ELEMENTS] = boundary_surface(mesh)
    return found


@dataclass(frozen=True, eq=False)
class Pick:
    """A place on a shown surface.

    Attributes:
        body: The number of the body in the simulation.
        triangle: The number of the triangle of the shown surface.
        place: Barycentric coordinates in it, float64 [3].
    """

    body: int
    triangle: int
    place: npt.NDArray[np.float64]


class Shown:
    """The shown surface of a body in one world.

    Args:
        body: The body.
        surface: Bound to the nodes of its present mesh. Its topology stays; if the body is remeshed, its points are
            bound again to the elements that contain them.
        world: The number of the world.

    Attributes:
        rest: Points at rest [m], float64 [V, 3].
        triangles: int32 [F, 3].
        binding: The points on the device, bound to the nodes of one world.
        positions: The points at the last reading [m], float32 [V, 3].
    """

    def __init__(self, body: SoftBody, surface: SurfaceMesh, world: int = 0):
        self.body, self.world, self.rest, self.triangles = body, body.world(world), surface.points, surface.triangles
        self.binding: DeviceBinding
        if body.changing is not None:
            self.binding = body.bind(surface.points)
        else:
            # Triangles are not needed here, because browsers compute normals themselves.
            self.binding = BoundPoints(surface.points, surface.nodes, surface.weights).on_device(body.device)
        self.positions = surface.points.astype(np.float32)
        self._nodes: wp.array | None = None
        if world:
            nodes = surface.nodes + self.world.nodes.start
            self._nodes = wp.array(nodes, dtype=wp.vec4i, device=body.device)

    @property
    def nodes(self) -> wp.array:
        """The nodes to which each point is bound, among those of all worlds of the body, vec4i [V]."""
        return self.binding.nodes if self._nodes is None else self._nodes

    def close(self) -> None:
        """Release the points: the body no longer keeps them bound."""
        if self.binding in self.body.bindings:
            self.body.bindings.remove(self.binding)

    def read(self) -> npt.NDArray[np.float32]:
        """Bring ``positions`` up to date and return them."""
        self.binding.update(self.world.displacements)
        self.positions = self.binding.positions.numpy().copy()
        return self.positions

    def pick(self, body: int, position: npt.ArrayLike) -> Pick:
        """The place nearest to a position [m], [3], on the surface of the last reading.

        Args:
            body: The number of this surface's body.
        """
        x = np.asarray(position, dtype=np.float64)
        middle, size = self.positions.mean(axis=0), float(np.ptp(self.positions, axis=0).max())
        with wp.ScopedDevice("cpu"):
            faces = nearest_faces(self.positions - middle, self.triangles, (x - middle)[None], 1e3 * size)
        triangle = int(faces[0])
        return Pick(body, triangle, barycentric(self.positions[self.triangles[triangle]].astype(np.float64), x))

    def carried(self, nodal: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
        """Values at the nodes of the shown world, [N], at the points, [V]."""
        return np.einsum("vn,vn->v", self.binding.weights.numpy(), nodal[self.binding.nodes.numpy()])

    def at(self, pick: Pick, values: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
        """Values at the points, [V, 3], at a place, float64 [3]."""
        return pick.place @ values[self.triangles[pick.triangle]].astype(np.float64)

    def normal(self, pick: Pick) -> npt.NDArray[np.float64]:
        """The outward unit normal at a place on the surface of the last reading, float64 [3]."""
        a, b, c = self.positions[self.triangles[pick.triangle]].astype(np.float64)
        normal = np.cross(b - a, c - a)
        return normal / max(float(np.linalg.norm(normal)), 1e-300)


def barycentric(corners: npt.NDArray[np.float64], x: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Barycentric coordinates, float64 [3], of the place of a triangle [3, 3] that is near x [3]: its projection, moved
    into the triangle if that lies outside.
    """
    edges = np.stack([corners[1] - corners[0], corners[2] - corners[0]], axis=1)
    later = np.linalg.lstsq(edges, x - corners[0], rcond=None)[0]
    place = np.clip([1.0 - later.sum(), *later], 0.0, None)
    return place / place.sum()


# --- cuts along a plane of the rest shape: the rest of a surface, and the section ------------------------------------


@dataclass(frozen=True)
class Plane:
    """A plane of the rest shape; the part beyond it is removed.

    Attributes:
        axis: 0, 1 or 2: the axis at right angles to the plane.
        share: Its position, as a share of the body's extent along the axis.
        flipped: Whether the other side is removed.
    """

    axis: int
    share: float
    flipped: bool = False

    def distances(self, points: npt.NDArray[np.float64], bounds: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """How far points [n, 3] are beyond the plane [m], float64 [n].

        Args:
            bounds: Lowest and highest coordinates of the body [m], [2, 3].
        """
        low, high = bounds[:, self.axis]
        distances = points[:, self.axis] - (low + self.share * (high - low))
        return -distances if self.flipped else distances


def cut(surface: SurfaceMesh, mesh: Any, plane: Plane) -> SurfaceMesh:
    """The surface without what is beyond a plane, closed by the section through the tetrahedra.

    The section of a body made from a domain ends at its marched surface, any other where the elements end.

    Args:
        surface: Bound to the nodes of ``mesh``.
        mesh: A forest or a general mesh.
    """
    bounds = np.stack([surface.points.min(axis=0), surface.points.max(axis=0)])
    kept = _kept(surface, plane.distances(surface.points, bounds))
    section = marched(mesh.points, mesh.tets, plane.distances(mesh.points, bounds))
    phi = getattr(mesh, "phi", None)
    if phi is not None:
        section = _kept(section, np.einsum("vn,vn->v", section.weights, phi[section.nodes]))
    return joined_surfaces([kept, section])


def _kept(surface: SurfaceMesh, beyond: npt.NDArray[np.float64]) -> SurfaceMesh:
    """The triangles on the near side. The far corners of those that the plane crosses move along edges to the plane."""
    outside = beyond > 0.0
    corners = surface.triangles
    count = outside[corners].sum(axis=1)
    whole = corners[count == 0]
    crossed = corners[(count == 1) | (count == 2)]
    single = np.where(outside[crossed].sum(axis=1) == 1, outside[crossed].T, ~outside[crossed].T).T
    turn = np.argmax(single, axis=1)
    a, b, c = (crossed[np.arange(len(crossed)), (turn + k) % 3] for k in range(3))
    ab, ac = _between(surface, beyond, a, b), _between(surface, beyond, a, c)
    n, m = len(surface.points), len(crossed)
    p, q = n + np.arange(m), n + m + np.arange(m)
    alone_outside = outside[a]
    quads = np.concatenate([np.stack([p, b, c], axis=1)[alone_outside], np.stack([p, c, q], axis=1)[alone_outside]])
    triangles = np.concatenate([whole, quads, np.stack([a, p, q], axis=1)[~alone_outside]])
    points, nodes, weights = (
        np.concatenate([getattr(part, name) for part in (surface, ab, ac)]) for name in ("points", "nodes", "weights")
    )
    used, numbered = np.unique(triangles, return_inverse=True)
    return SurfaceMesh(points[used], nodes[used], weights[used], numbered.reshape(-1, 3))


def _between(
    surface: SurfaceMesh, beyond: npt.NDArray[np.float64], a: npt.NDArray[np.integer], b: npt.NDArray[np.integer]
) -> BoundPoints:
    """Where the plane crosses edges from a to b, int [n], bound to the nodes of both ends."""
    t = (beyond[a] / (beyond[a] - beyond[b]))[:, None]
    nodes = np.concatenate([surface.nodes[a], surface.nodes[b]], axis=1)
    weights = np.concatenate([(1.0 - t) * surface.weights[a], t * surface.weights[b]], axis=1)
    # The four nodes with the largest weights; marched surfaces and boundaries have no more.
    most = np.argsort(-np.abs(weights), axis=1, kind="stable")[:, :4]
    nodes, weights = (np.take_along_axis(each, most, axis=1) for each in (nodes, weights))
    weights /= weights.sum(axis=1, keepdims=True)
    return BoundPoints(surface.points[a] + t * (surface.points[b] - surface.points[a]), nodes, weights)


# --- colours: sources of values by name, and the range ---------------------------------------------------------------

Values: TypeAlias = npt.NDArray[np.floating]

#: A range of colours that is more than this many times too wide becomes narrower.
TOO_WIDE = 3.0
#: Colours end at this displacement over the body's size and this stress over Young's modulus at least: smaller ones are
#: no news, and after a reset there is only rounding.
LEAST_MOTION, LEAST_STRESS = 1e-3, 1e-2


@dataclass(frozen=True)
class Source:
    """Values that colours can show.

    Attributes:
        label: What the values are, for people.
        unit: The unit of the values.
        values: The values at the points of a shown surface, [V], for a simulation and one of its bodies.
        least: The least end of the colours for a shown surface.
        applies: Whether a body has such values.
    """

    label: str
    unit: str
    values: Callable[[Simulation, Shown], Values]
    least: Callable[[Shown], float] = lambda _: 0.0
    applies: Callable[[SoftBody], bool] = lambda _: True


def sources() -> dict[str, Source]:
    """The sources by name. Sources that keep data of a body belong to one session."""
    known: dict[SoftBody, tuple[int, VertexAverage]] = {}

    def averages(values: Values, shown: Shown) -> Values:
        """Values of elements [T], averaged to the nodes around them by volume, at the points of a surface [V]."""
        body = shown.body
        if body not in known or known[body][0] != body.version:
            known[body] = body.version, VertexAverage.of(body.mesh)
        return shown.carried(known[body][1](values))

    def least_motion(shown: Shown) -> float:
        return LEAST_MOTION * float(np.ptp(shown.rest, axis=0).max(initial=0.0))

    def least_stress(shown: Shown) -> float:
        return LEAST_STRESS * float(np.mean(shown.body.material.isotropic.young))

    def contact_pressure(_: Simulation, shown: Shown) -> Values:
        """Contact pressure in the last step [Pa]: triangles' values, averaged to nodes by area."""
        body = shown.body
        pressure = body.contact_pressure.numpy().reshape(body.worlds, -1)[shown.world.index]
        return shown.carried(pressure_at_nodes(body.contact_surface, body.world_node_count, pressure))

    def moved(_: Simulation, shown: Shown) -> Values:
        return np.linalg.norm(shown.positions - shown.rest, axis=1)

    def stress(sim: Simulation, shown: Shown) -> Values:
        return averages(sim.von_mises(shown.body)[shown.world.elements], shown)

    return {
        "stress": Source("von Mises stress", "Pa", stress, least_stress),
        "displacement": Source("displacement", "m", moved, least_motion),
        "contact pressure": Source(
            "contact pressure", "Pa", contact_pressure, least_stress, lambda body: body.state.is_touched
        ),
        "level": Source(
            "level of the mesh",
            "",
            lambda _, shown: averages(shown.body.mesh.levels, shown),  # type: ignore[union-attr]
            applies=lambda body: isinstance(body.mesh, TetForest),
        ),
    }
