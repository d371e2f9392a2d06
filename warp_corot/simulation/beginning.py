"""Simulations that begin at rest in contact."""

from __future__ import annotations

from copy import copy

from warp_corot.contact.carried import take_state
from warp_corot.contact.shapes import Shape
from warp_corot.contact.tool import Tool
from warp_corot.errors import InputError

from .loaded import LoadedBody
from .resting import Rest, rest_on
from .simulation import Simulation

#: The largest motion of the last step over the largest displacement, and the most steps of each search.
TOLERANCE, STEPS = 1e-6, 100


def bring_to_rest(sim: Simulation) -> Rest:
    """Move all bodies to where they rest together on the obstacles and on one another, before the first step.

    Obstacles and tools stay where they begin. The simulation goes on from the contact of this state: forces, wrenches
    and pressures are those at rest. If the search fails, the bodies stay where they were.

    Args:
        sim: The simulation, with contact.

    Raises:
        InputError: Meshes change, or several ranks have parts of the bodies.
    """
    if not sim.ranks.is_alone:
        raise InputError("several ranks cannot bring bodies to rest in contact; one process can")
    if sim.remeshing.every:
        raise InputError("a body is remeshed; to begin at rest, all meshes must stay as they are")
    assert sim.contact is not None
    loaded = [LoadedBody(body, field, sim.gravity) for body, field in zip(sim.bodies, sim.fields, strict=True)]
    for each in loaded:
        each.body.state.adopt_positions()
        each.field.relax_fully()
    found = rest_on(
        sim.bodies,
        sim.models,
        sim.fields,
        [each.loads for each in loaded],
        sim.gravity,
        _standing(sim),
        sim.contact.options,
        tolerance=TOLERANCE,
        most=STEPS,
        preconditioner=None,
    )
    for each in loaded:
        each.finish()
    if found.contact is not None:
        take_state(sim.contact, found.contact)
    return found


def _standing(sim: Simulation) -> list[Shape]:
    """Copies of all obstacles, at rest where they are."""
    assert sim.contact is not None
    found = []
    for obstacle, pose in zip(sim.obstacles, sim.contact.obstacles.poses()[0], strict=True):
        shape = copy(obstacle.shape if isinstance(obstacle, Tool) else obstacle)
        shape.position, shape.quaternion, shape.felt = pose[:3].astype(float), pose[3:].astype(float), None
        found.append(shape)
    return found
