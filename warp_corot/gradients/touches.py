"""Where obstacles and its own surface push a body, and whether friction holds it there."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.contact.contacts import Contacts
from warp_corot.contact.reading import Touch
from warp_corot.errors import InputError
from warp_corot.kernels.gradients import contact as kernels

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

#: The share of Coulomb's bound from which on a contact slips.
SLIPS = 0.999
#: Shares of corners below this are zero: the contact is on an edge or a corner.
LEAST_SHARE = 1e-5


class Pair(NamedTuple):
    """A node at a triangle of the same body, or an edge at another one, that pushed in the last step.

    Attributes:
        is_edge: Whether it is two edges, places 0, 1 and 2, 3; else a node and the corners of a triangle.
        obstacle: -1.
        places, normal, force: As of a ``Touch``; the normal and the force are those of the first side.
        shares: The weights of places in the gap, negative on the other side.
    """

    is_edge: bool
    obstacle: int
    places: npt.NDArray[np.integer]
    shares: Array
    normal: Array
    force: Array


def pairs_of(contacts: Contacts) -> list[Pair]:
    """The pairs of soft surfaces that pushed in the last step.

    Raises:
        InputError: Some push at the border of a triangle or at the end of an edge.
    """
    if contacts.pairs is None:
        return []
    rows = contacts.pairs.rows
    count = min(int(rows.total.numpy()[0]), len(rows.owner))
    acts, owner = rows.acts.numpy()[:count], rows.owner.numpy()[:count]
    force, normal, shares = (each.numpy()[:count].astype(float) for each in (rows.force, rows.normal, rows.shares))
    places, nodes = rows.places.numpy(), contacts.surface.count
    acting = np.flatnonzero((acts != 0) & force.any(axis=1))
    borders = int((np.abs(shares[acting]).min(axis=1, initial=1.0) < LEAST_SHARE).sum())
    if borders:
        raise InputError(
            f"{borders} of {len(acting)} contacts of the body with itself are at borders of triangles, where gradients "
            "jump"
        )
    return [Pair(bool(owner[k] >= nodes), -1, places[k], shares[k], normal[k], force[k]) for k in acting]


def pair_hessian(pair: Pair, x: Array) -> Array:
    """The second derivative of a pair's gap with respect to its four places x [1/m], [12, 12], by central differences
    of the first."""
    step = 1e-5 * float(np.abs(x - x[0]).max())
    slopes = np.zeros((12, 12))
    for k in range(12):
        by = np.zeros(12)
        by[k] = step
        ahead, behind = (_pair_slope(pair, x + sign * by.reshape(4, 3)) for sign in (1.0, -1.0))
        slopes[k] = (ahead - behind) / (2.0 * step)
    return np.asarray(0.5 * (slopes + slopes.T))


def _pair_slope(pair: Pair, x: Array) -> Array:
    """The derivative of a pair's gap with respect to its four places, [12]."""
    if pair.is_edge:
        along, across = x[1] - x[0], x[3] - x[2]
        normal = np.cross(along, across)
        s, t, _ = np.linalg.solve(np.stack([along, -across, normal], axis=1), x[2] - x[0])
        shares = np.array([1.0 - s, s, t - 1.0, -t])
    else:
        first, second = x[2] - x[1], x[3] - x[1]
        normal = np.cross(first, second)
        s, t, _ = np.linalg.solve(np.stack([first, second, normal], axis=1), x[0] - x[1])
        shares = np.array([1.0, s + t - 1.0, -s, -t])
    normal = normal * np.sign(normal @ pair.normal) / np.linalg.norm(normal)
    return np.asarray((shares[:, None] * normal).ravel())


def unit_normal(touch: Touch | Pair) -> Array:
    """A contact's normal, [3]."""
    return np.asarray(touch.normal / np.linalg.norm(touch.normal))


def sticking(touches: Sequence[Touch | Pair], friction: Sequence[float]) -> list[bool]:
    """Whether friction holds each contact.

    Args:
        touches: The contacts.
        friction: The coefficient of each obstacle.

    Raises:
        InputError: It does not hold a contact that has friction.
    """
    sticks, slipping = [], 0
    for touch in touches:
        normal, bound = unit_normal(touch), 0.0 if isinstance(touch, Pair) else friction[touch.obstacle]
        push = float(touch.force @ normal)
        across = float(np.linalg.norm(touch.force - push * normal))
        sticks.append(bound > 0.0)
        slipping += bound > 0.0 and across > SLIPS * bound * push
    if slipping:
        raise InputError(
            f"{slipping} of {len(touches)} contacts slip; gradients need friction that sticks, or friction=0.0"
        )
    return sticks


def touches_after(body: SoftBody, contacts: Contacts) -> list[Touch]:
    """The nodes that obstacles have pushed in the last step, where they are at its end.

    Raises:
        InputError: Obstacles push something else: triangles, or places of the body's own surface.
    """
    rigid, surface, device = contacts.rigid, contacts.surface, body.device
    if rigid is None:
        return []
    if surface.parts[0].skin.own is not None:
        raise InputError("obstacles touch the body's own surface; runs need contact at nodes: Contact(on='tetrahedra')")
    if rigid.have_edges and rigid.touches.acts.numpy().any():
        raise InputError("an obstacle touches triangles between the nodes; runs with gradients need contact at nodes")
    forces = rigid.forces.numpy().astype(float)
    obstacles, places = np.nonzero(forces.any(axis=2))
    if not len(places):
        return []
    part = surface.parts[0]
    world, at = np.divmod(places - part.start, part.nodes)
    nodes = part.skin.nodes[at] + world * body.world_node_count
    x = (body.rest_positions + body.state.displacements.numpy()[: body.sizes.nodes, :3])[nodes]
    inputs = [contacts.obstacles.shapes, contacts.obstacles.motions]
    inputs += [wp.array(each, dtype=wp.int32, device=device) for each in (obstacles, world)]
    inputs.append(wp.array(x[:, None], dtype=wp.vec3, device=device))
    found = wp.zeros((len(places), 1), dtype=wp.vec3, device=device)
    wp.launch(kernels.find_normals, found.shape, inputs, [found], device=device)
    normals = found.numpy()[:, 0].astype(float)
    one = np.ones(1)
    return [
        Touch(int(o), np.array([s]), one, x[k], normals[k], 0.0, forces[o, s])
        for k, (o, s) in enumerate(zip(obstacles, places, strict=True))
    ]
