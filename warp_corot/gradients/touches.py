"""Where obstacles push a body, and whether friction holds it there."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

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


def unit_normal(touch: Touch) -> Array:
    """A contact's normal, [3]."""
    return np.asarray(touch.normal / np.linalg.norm(touch.normal))


def sticking(touches: Sequence[Touch], friction: Sequence[float]) -> list[bool]:
    """Whether friction holds each contact.

    Args:
        touches: The contacts.
        friction: The coefficient of each obstacle.

    Raises:
        InputError: It does not hold a contact that has friction.
    """
    sticks, slipping = [], 0
    for touch in touches:
        normal, bound = unit_normal(touch), friction[touch.obstacle]
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
