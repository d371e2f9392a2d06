"""Contact of a body at its nodes, for the host: forces and averaged pressures."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from warp_corot.mesh.surfaces.bound import SurfaceMesh

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody

    from .contacts import Contacts

Floats = npt.NDArray[np.float64]


def contact_at_nodes(
    contacts: Contacts, k: int, body: SoftBody, world: int
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Contact of a body in the last step; waits for the device. Zero if the mesh has changed since.

    Args:
        contacts: Contact of the simulation.
        k: The number of the body there.
        body: The body; on several ranks the whole one, of which ``contacts`` has this rank's part.
        world: The world.

    Returns:
        The forces on the nodes of one world [N], float32 [N, 3], and the pressure averaged at them [Pa], float32 [N].
    """
    count = body.world_node_count
    if contacts.surface.bodies[k].version != contacts.surface.parts[k].version:
        return np.zeros((count, 3), np.float32), np.zeros(count, np.float32)
    forces = body.contact_forces.numpy()[world * count : (world + 1) * count]
    pressures = body.contact_pressure.numpy().reshape(body.worlds, -1)[world]
    nodal = pressure_at_nodes(body.contact_surface, count, pressures)
    return forces.astype(np.float32), nodal.astype(np.float32)


def pressure_at_nodes(surface: SurfaceMesh, count: int, pressures: npt.NDArray[np.float32]) -> Floats:
    """Pressures of triangles [Pa], averaged at nodes by areas at rest, [N]; zero at nodes that carry no surface.

    Args:
        surface: The surface, F triangles.
        count: Number of nodes N.
        pressures: [F], or more, of which the first ones count.
    """
    triangles = surface.triangles
    a, b, c = np.moveaxis(surface.points[triangles], 1, 0)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    corners, points = triangles.ravel(), len(surface.points)
    around = np.bincount(corners, np.repeat(areas, 3), points)
    loads = np.bincount(corners, np.repeat(areas * pressures[: len(triangles)], 3), points)
    nodes, weights = surface.nodes.ravel(), np.abs(surface.weights)
    weighted = np.bincount(nodes, (weights * loads[:, None]).ravel(), count)
    return weighted / np.maximum(np.bincount(nodes, (weights * around[:, None]).ravel(), count), 1e-300)
