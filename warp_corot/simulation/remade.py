"""A new simulation from the present state of another, with other laws, materials or remeshing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import warp as wp

from warp_corot.body.soft_body import SoftBody
from warp_corot.contact.tool import Tool
from warp_corot.elasticity import Model
from warp_corot.errors import InputError
from warp_corot.materials.isotropic import Material
from warp_corot.remesh.online import OnlineRemesh

from .simulation import Simulation


def remade(
    sim: Simulation,
    *,
    models: Sequence[Model] | None = None,
    materials: Sequence[Material] | None = None,
    remesh: Sequence[OnlineRemesh | None] | None = None,
) -> Simulation:
    """A new simulation that continues this one: new bodies with the present meshes, states, loads, supports and
    motions, at the same time. The given simulation is not changed, and must not be stepped any further.

    Hooks are not carried over, nor is the memory of contact, such as where things stick.

    Args:
        models: The model of each body; None: the present ones.
        materials: Materials of the present elements of each body; None: the present ones.
        remesh: How each body is remeshed from now on; None: not at all.

    Raises:
        InputError: There are tools, or a body is remeshed and follows keyframes; or as ``Simulation``. The given
            simulation is unchanged.
    """
    obstacles = () if sim.contact is None else sim.contact.obstacles.given
    if any(isinstance(each, Tool) for each in obstacles):
        raise InputError("a tool belongs to one simulation; laws, materials and remeshing stay as they are with tools")
    bodies = [_copy_of(body, None if materials is None else materials[k]) for k, body in enumerate(sim.bodies)]
    again = Simulation(
        bodies,
        model=sim.models if models is None else models,
        integrator=sim.integrator,
        gravity=sim.gravity,
        deterministic=sim.deterministic,
        remesh=remesh if remesh is not None and any(remesh) else None,
        obstacles=obstacles,
        contact=None if sim.contact is None else sim.contact.options,
    )
    again.steps_before_reset, again.time_before_reset = sim.steps_before_reset, sim.time_before_reset
    known = again.pace.known
    again.pace.put_back(replace(known, counts=(sim.steps, sim.steps), seconds=(known.seconds[0], sim.time, 0.0)))
    return again


def _copy_of(body: SoftBody, material: Material | None) -> SoftBody:
    """The same body on its present mesh, in its present state."""
    conditions, changing = body.conditions, body.changing
    if changing is not None and conditions.trajectories:
        raise InputError("a body that is remeshed follows keyframes; its law, material and remeshing stay as they are")
    copy = SoftBody(body.mesh, body.material if material is None else material, worlds=body.worlds, device=body.device)
    if body.state.initial is not None and changing is None:
        displacements, velocities = (array.numpy()[: body.node_count, :3] for array in body.state.initial)
        copy.displacements, copy.velocities = displacements, velocities
        copy.set_initial_state()
    copy.fix(body.constrained if body.worlds == 1 else body.constrained.reshape(body.worlds, -1))
    for trajectory in conditions.trajectories:
        copy.follow(trajectory.host_nodes, *trajectory.keys())
    if conditions.has_loads:
        wp.copy(copy.loads, body.loads)
    if body.discretization.has_activation:
        wp.copy(copy.activation, body.activation)
        copy.conditions.set_activations(conditions.activations)
    wp.copy(copy.conditions.world_starts, conditions.world_starts)
    copy.displacements = np.array(body.displacements.numpy())
    copy.state.set_velocities(body.velocities.numpy())
    return copy
