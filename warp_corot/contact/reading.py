"""The contacts of the last step, one by one, for the host."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.kernels.contact import sums

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody

    from .contacts import Contacts
    from .pairs import Pairs
    from .rigid_forces import RigidForces
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


class Touch(NamedTuple):
    """A place at which an obstacle pushed in the last step.

    Attributes:
        obstacle: Its number.
        places: Numbers of places of the contact surface: one, or a triangle's three.
        shares: The weight of each in the point.
        point, normal, gap: As of a ``ContactPoint``.
        force: The force on the body [N], [3].
    """

    obstacle: int
    places: npt.NDArray[np.integer]
    shares: Floats
    point: Floats
    normal: Floats
    gap: float
    force: Floats


def contact_points(contacts: Contacts) -> list[ContactPoint]:
    """All contacts of the last step; waits for the device."""
    found = [] if contacts.pairs is None else _of_pairs(contacts, contacts.pairs)
    return found + [_point(contacts, touch) for touch in obstacle_touches(contacts)]


def obstacle_touches(contacts: Contacts) -> Iterator[Touch]:
    """All contacts of the last step with obstacles; waits for the device."""
    if contacts.rigid is not None:
        yield from _at_nodes(contacts, contacts.rigid)
        if contacts.rigid.have_edges:
            yield from _at_triangles(contacts, contacts.rigid)


def _of_pairs(contacts: Contacts, pairs: Pairs) -> list[ContactPoint]:
    """Each pair once: the force on the node, or on the first edge."""
    rows, x = pairs.rows, contacts.surface.arrays.x.numpy().astype(float)
    nodes, bodies = contacts.surface.count, contacts.system.bodies
    count = min(int(rows.total.numpy()[0]), len(rows.owner))
    acts, owner = rows.acts.numpy()[:count], rows.owner.numpy()[:count]
    force, normal = (array.numpy()[:count].astype(float) for array in (rows.force, rows.normal))
    places, shares, gap = rows.places.numpy(), rows.shares.numpy().astype(float), rows.gap.numpy()
    found = []
    for row in np.flatnonzero((acts != 0) & force.any(axis=1)):
        size = 1 if owner[row] < nodes else 2
        w = shares[row, :size]
        k, world, own, own_shares = contacts.surface.nodes_at(places[row, :size], w)
        m, _, others, _ = contacts.surface.nodes_at(places[row, size:], shares[row, size:])
        along = float(force[row] @ normal[row])
        found.append(
            ContactPoint(
                bodies[k],
                bodies[m],
                world,
                own,
                own_shares,
                w @ x[places[row, :size]],
                normal[row],
                float(gap[row]),
                along,
                force[row] - along * normal[row],
                others,
            )
        )
    return found


def _at_nodes(contacts: Contacts, rigid: RigidForces) -> Iterator[Touch]:
    surface, obstacles = contacts.surface, contacts.obstacles
    gaps = wp.zeros(rigid.forces.shape, dtype=wp.float32, device=contacts.device)
    normals = wp.zeros(rigid.forces.shape, dtype=wp.vec3, device=contacts.device)
    inputs = [obstacles.shapes, obstacles.motions, surface.arrays, rigid.forces]
    wp.launch(sums.describe_touches, rigid.forces.shape, inputs, [gaps, normals], device=contacts.device)
    forces = rigid.forces.numpy().astype(float)
    gap, normal, x = gaps.numpy(), normals.numpy().astype(float), surface.arrays.x.numpy().astype(float)
    for o, s in np.argwhere(forces.any(axis=2)):
        yield Touch(int(o), np.array([s]), np.ones(1), x[s], normal[o, s], float(gap[o, s]), forces[o, s])


def _at_triangles(contacts: Contacts, rigid: RigidForces) -> Iterator[Touch]:
    touches, surface = rigid.touches, contacts.surface
    acts, force = touches.acts.numpy(), touches.force.numpy().astype(float)
    shares, normal, gap = (
        touches.shares.numpy().astype(float),
        touches.normal.numpy().astype(float),
        touches.gap.numpy(),
    )
    corners, x = surface.triangles.numpy(), surface.arrays.x.numpy().astype(float)
    for o, t in np.argwhere((acts != 0) & force.any(axis=2)):
        w, places = shares[o, t], corners[t]
        yield Touch(int(o), places, w, w @ x[places], normal[o, t], float(gap[o, t]), force[o, t])


def _point(contacts: Contacts, touch: Touch) -> ContactPoint:
    k, world, nodes, shares = contacts.surface.nodes_at(touch.places, touch.shares)
    along = float(touch.force @ touch.normal)
    return ContactPoint(
        contacts.system.bodies[k],
        contacts.obstacles.given[touch.obstacle],
        world,
        nodes,
        shares,
        touch.point,
        touch.normal,
        touch.gap,
        along,
        touch.force - along * touch.normal,
    )
