"""The surface that is shown of a body: it is bound to the body's nodes, and its points are read once a frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.body.soft_body import SoftBody
from warp_corot.io.write.skins import BoundSkins, OwnSurface, has_domain, joined_surfaces
from warp_corot.mesh.surfaces.bodies import boundary_surface
from warp_corot.mesh.surfaces.bound import BoundPoints, DeviceBinding, SurfaceMesh
from warp_corot.mesh.surfaces.locating import nearest_faces

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
