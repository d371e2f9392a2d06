"""A new simulation from the present state of another, with other laws, materials, remeshing or obstacles."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.body.soft_body import SoftBody
from warp_corot.contact.grasp import Grasp
from warp_corot.contact.options import Contact
from warp_corot.contact.tool import Obstacle
from warp_corot.cutting.blade import Blade
from warp_corot.elasticity import Model
from warp_corot.errors import InputError
from warp_corot.materials.isotropic import Material
from warp_corot.remesh.remeshing import OnlineRemesh

from .simulation import Simulation


def remade(
    sim: Simulation,
    *,
    models: Sequence[Model] | None = None,
    materials: Sequence[Material] | None = None,
    remesh: Sequence[OnlineRemesh | None] | None = None,
    grasps: Sequence[Grasp] | None = None,
    obstacles: Sequence[Obstacle] | None = None,
    contact: Contact | None = None,
    cuts: Sequence[Blade] | None = None,
    gravity: npt.ArrayLike | None = None,
) -> Simulation:
    """A new simulation that continues this one: new bodies with the present meshes, states, loads, supports and
    motions, at the same time. The given simulation is not changed, and must not be stepped any further.

    The new simulation takes the tools, which go on as they were going. Grasps hold the same nodes in new ``Grasp``s.
    Hooks are not carried over, nor is the memory of contact, such as where things stick.

    Args:
        models: The model of each body; None: the present ones.
        materials: Materials of the present elements of each body; None: the present ones.
        remesh: How each body is remeshed from now on; None: not at all.
        grasps: The grasps that go on; None: all.
        obstacles: The obstacles from now on; None: the present ones, with their contact.
        contact: The options of contact with them.
        cuts: The blades from now on; None: the present ones.
        gravity: [m/s^2]; None: the present one.

    Raises:
        InputError: A body is remeshed and follows keyframes; or as ``Simulation``. The given simulation is unchanged.
    """
    bodies = [_copy_of(body, None if materials is None else materials[k]) for k, body in enumerate(sim.bodies)]
    blades = () if sim.blades is None else sim.blades.blades
    if cuts is None:
        cuts = blades
    with tools_lent(sim):
        again = Simulation(
            bodies,
            model=sim.models if models is None else models,
            integrator=sim.integrator,
            gravity=sim.gravity if gravity is None else gravity,
            deterministic=sim.deterministic,
            remesh=remesh if remesh is not None and any(remesh) else None,
            obstacles=sim.obstacles if obstacles is None else obstacles,
            contact=contact if obstacles is not None or sim.contact is None else sim.contact.options,
            cuts=cuts if cuts or sim.remeshing.are_cut else None,
        )
        if sim.blades is not None and again.blades is not None:
            again.blades.continue_from(sim.blades)
        if sim.contact is not None and again.contact is not None:
            again.contact.obstacles.continue_from(sim.contact.obstacles)
        for grasp in sim.grasps if grasps is None else grasps:
            grasp.again(again.bodies[sim.bodies.index(grasp.body)])
    again.steps_before_reset, again.time_before_reset = sim.steps_before_reset, sim.time_before_reset
    known = again.pace.known
    again.pace.put_back(replace(known, counts=(sim.steps, sim.steps), seconds=(known.seconds[0], sim.time, 0.0)))
    return again


@contextmanager
def tools_lent(sim: Simulation) -> Iterator[None]:
    """Let another simulation take the tools and blades of this one; if the block raises, they are given back."""
    lent = [] if sim.contact is None else [sim.contact.obstacles]
    lent += [] if sim.blades is None else [sim.blades]
    for each in lent:
        each.let_go()
    try:
        yield
    except BaseException:
        for each in lent:
            each.take_back()
        raise


def _copy_of(body: SoftBody, material: Material | None) -> SoftBody:
    """The same body on its present mesh, in its present state."""
    conditions, changing = body.conditions, body.changing
    if changing is not None and conditions.trajectories:
        raise InputError("a body that is remeshed follows keyframes; its law, material and remeshing stay as they are")
    copy = SoftBody(
        body.mesh,
        body.material if material is None else material,
        worlds=body.worlds,
        device=body.device,
        threads=body.threads,
    )
    if body.state.initial is not None and changing is None:
        displacements, velocities = (array.numpy()[: body.node_count, :3] for array in body.state.initial)
        copy.displacements, copy.velocities = displacements, velocities
        copy.set_initial_state()
    copy.fix(body.constrained if body.worlds == 1 else body.constrained.reshape(body.worlds, -1))
    for trajectory in conditions.trajectories:
        copy.follow(trajectory.host_numbers, *trajectory.keys())
    if conditions.has_loads:
        wp.copy(copy.loads, body.loads)
    if body.discretization.has_activation:
        wp.copy(copy.activation, body.activation)
        copy.conditions.set_activations(conditions.activations)
    wp.copy(copy.conditions.world_starts, conditions.world_starts)
    copy.displacements = np.array(body.displacements.numpy())
    copy.state.set_velocities(body.velocities.numpy())
    return copy
