"""The contacts of the last step for the host: one by one, and at nodes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from warp_corot.mesh.surfaces.bound import SurfaceMesh

from .obstacles import RigidForces, measured_gaps

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody

    from .contacts import Contacts
    from .pairs import Pairs
    from .tool import Obstacle

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class ContactPoint:
    """A place at which a body was touched in the last step.

    Attributes:
        body: The soft body.
        other: The other side: an obstacle as it was given, or a soft body, which may be the same.
        world: The world.
        nodes: The body's nodes at that place, numbered within the world: one, the ends of an edge, or the corners of a
            triangle; on a body's own surface those of the tetrahedra that carry the place.
        shares: The weight of each of them in the point.
        point: The place [m], [3].
        normal: From the other to the body, [3].
        gap: The gap at the beginning of the step, negative for an overlap [m].
        normal_force: The force on the body along the normal [N], never negative.
        friction_force: The force on the body across the normal [N], [3].
        other_nodes: The nodes of the other, if that is a soft body.
    """

    body: SoftBody
    other: Obstacle | SoftBody
    world: int
    nodes: tuple[int, ...]
    shares: Floats
    point: Floats
    normal: Floats
    gap: float
    normal_force: float
    friction_force: Floats
    other_nodes: tuple[int, ...] = ()

    @property
    def force(self) -> Floats:
        """The whole force on the body [N], [3]."""
        return self.normal_force * self.normal + self.friction_force


class ActingRow(NamedTuple):
    """A contact that pushed in the last step.

    Attributes:
        obstacle: The number of the obstacle; -1 for a pair of soft surfaces.
        first: Number of places on the first side, which has the normal: all of them at an obstacle.
        places: Numbers of places of the contact surface: one, a triangle's three, or a pair's four.
        weights: The weight of each in the gap, negative on the second side.
        point: The place on the first side [m], [3].
        normal, gap: As of a ``ContactPoint``.
        force: The force on the first side [N], [3].
    """

    obstacle: int
    first: int
    places: npt.NDArray[np.integer]
    weights: Floats
    point: Floats
    normal: Floats
    gap: float
    force: Floats


def contact_points(contacts: Contacts) -> list[ContactPoint]:
    """All contacts of the last step, pairs of soft surfaces once; waits for the device."""
    return [_point(contacts, row) for row in acting_rows(contacts)]


def acting_rows(contacts: Contacts) -> Iterator[ActingRow]:
    """All contacts of the last step; waits for the device."""
    x = contacts.surface.arrays.x.numpy().astype(float)
    if contacts.pairs is not None:
        yield from _of_pairs(contacts.pairs, x, contacts.surface.count)
    if contacts.rigid is not None:
        yield from _at_places(contacts, contacts.rigid, x)
        if contacts.rigid.have_edges:
            yield from _at_triangles(contacts.rigid, contacts.surface.triangles.numpy(), x)


def _of_pairs(pairs: Pairs, x: Floats, nodes: int) -> Iterator[ActingRow]:
    rows = pairs.rows
    count = min(int(rows.total.numpy()[0]), len(rows.owner))
    acts, owner, gap = (each.numpy()[:count] for each in (rows.acts, rows.owner, rows.gap))
    force, normal, weights = (each.numpy()[:count].astype(float) for each in (rows.force, rows.normal, rows.weights))
    places = rows.places.numpy()
    for k in np.flatnonzero((acts != 0) & force.any(axis=1)):
        first = 1 if owner[k] < nodes else 2
        point = weights[k, :first] @ x[places[k, :first]]
        yield ActingRow(-1, first, places[k], weights[k], point, normal[k], float(gap[k]), force[k])


def _at_places(contacts: Contacts, rigid: RigidForces, x: Floats) -> Iterator[ActingRow]:
    forces, obstacles = rigid.forces.numpy().astype(float), contacts.obstacles
    those, places = np.nonzero(forces.any(axis=2))
    given = those, contacts.surface.arrays.world.numpy()[places], x[places, None]
    gap, normal = (each[:, 0].astype(float) for each in measured_gaps(obstacles.shapes, obstacles.motions.now, *given))
    for k, (o, s) in enumerate(zip(those, places, strict=True)):
        yield ActingRow(int(o), 1, np.array([s]), np.ones(1), x[s], normal[k], float(gap[k]), forces[o, s])


def _at_triangles(rigid: RigidForces, corners: npt.NDArray[np.integer], x: Floats) -> Iterator[ActingRow]:
    rows, first = rigid.rows, rigid.totals.size
    acts, gap = rows.acts.numpy(), rows.gap.numpy()
    force, weights, normal = (each.numpy().astype(float) for each in (rows.force, rows.weights, rows.normal))
    for r in first + np.flatnonzero((acts != 0)[first:] & force[first:].any(axis=1)):
        o, t = divmod(int(r) - first, len(corners))
        w, places = weights[r, :3], corners[t]
        yield ActingRow(o, 3, places, w, w @ x[places], normal[r], float(gap[r]), force[r])


def _point(contacts: Contacts, row: ActingRow) -> ContactPoint:
    surface, bodies = contacts.surface, contacts.system.bodies
    k, world, nodes, shares = surface.nodes_at(row.places[: row.first], row.weights[: row.first])
    other: Obstacle | SoftBody
    others: tuple[int, ...] = ()
    if row.obstacle >= 0:
        other = contacts.obstacles.given[row.obstacle]
    else:
        m, _, others, _ = surface.nodes_at(row.places[row.first :], row.weights[row.first :])
        other = bodies[m]
    push = float(row.force @ row.normal)
    across = row.force - push * row.normal
    return ContactPoint(bodies[k], other, world, nodes, shares, row.point, row.normal, row.gap, push, across, others)


# --- at nodes ---------------------------------------------------------------------------------------------------------


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
