"""The state of rest of bodies on obstacles, and simulations that begin there, by long steps."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from warp_corot.body.soft_body import SoftBody
from warp_corot.contact.carried import take_state
from warp_corot.contact.contacts import Contacts
from warp_corot.contact.options import Contact
from warp_corot.contact.shapes import Shape
from warp_corot.contact.tool import Tool
from warp_corot.elasticity import ForceField, Model
from warp_corot.errors import InputError, UnstableError
from warp_corot.inputs.checks import checked_things
from warp_corot.mesh.topology import linked, node_pairs
from warp_corot.solvers import BackwardEuler

from .simulation import Simulation

#: Loads on a free body balance if their sum is less than this share of the sum of their magnitudes.
LOADS_BALANCED = 1e-5
#: Held nodes are on one line if they are within this share of their distances.
ON_A_LINE = 1e-6


class LoadedBody:
    """A body that is brought to rest.

    Args:
        body: The body.
        field: Its elastic forces.
        gravity: [m/s^2].

    Attributes:
        loads: Loads and weight [N], float64 [worlds * N, 3].
    """

    def __init__(self, body: SoftBody, field: ForceField, gravity: tuple[float, float, float]):
        self.body, self.field = body, field
        self.loads = body.conditions.loads_and_weights(gravity)

    def falls(self) -> bool:
        """Whether nothing holds the body, and its loads do not balance."""
        worlds = self.body.worlds
        held = self.body.conditions.held_mask().reshape(worlds, -1).any(axis=1)
        of_worlds = self.loads.reshape(worlds, -1, 3)
        sums = np.linalg.norm(of_worlds.sum(axis=1), axis=1)
        return bool((~held & (sums > LOADS_BALANCED * np.linalg.norm(of_worlds, axis=2).sum(axis=1))).any())

    def turns(self) -> bool:
        """Whether loads at the rest shape do work in a rigid motion of a whole part of the mesh that leaves all held
        nodes where they are, because in some world they are on one line; parts that share no node move separately.
        """
        body = self.body
        part, points = _parts(body.mesh.tets, body.node_count // body.worlds), body.mesh.points
        held = body.conditions.held_mask().reshape(body.worlds, -1)
        loads = self.loads.reshape(body.worlds, -1, 3)
        for number in range(int(part.max()) + 1):
            nodes = np.flatnonzero(part == number)
            x = points[nodes] - points[nodes].mean(axis=0)
            motions = _rigid_motions(x / max(float(np.abs(x).max()), 1e-30))
            for world in range(body.worlds):
                kept = motions[held[world, nodes]].reshape(-1, 6)
                sizes, axes = np.linalg.eigh(kept.T @ kept)
                left = axes[:, sizes <= ON_A_LINE**2 * max(float(sizes[-1]), 1e-30)]
                forces = loads[world, nodes]
                work = np.linalg.norm(np.einsum("nci,nc->i", motions, forces) @ left)
                if work > LOADS_BALANCED * np.linalg.norm(forces, axis=1).sum():
                    return True
        return False

    def finish(self) -> None:
        """Let the body rest: no velocity, reactions at held nodes, positions published."""
        body, state = self.body, self.body.state
        state.velocities.zero_()
        elastic = self.field.elastic_forces(state.displacements).numpy()[: body.sizes.nodes, :3]
        held = body.conditions.held_mask()[:, None]
        reactions = np.zeros((body.sizes.nodes, 4), np.float32)
        reactions[:, :3] = np.where(held, -(elastic + self.loads), 0.0)
        state.reactions[: body.sizes.nodes].assign(reactions)
        state.publish_positions()


def _rigid_motions(x: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Three translations and three turns about the axes at points [n, 3], [n, 3, 6]."""
    found = np.zeros((len(x), 3, 6))
    for axis in range(3):
        found[:, axis, axis] = 1.0
        found[:, :, 3 + axis] = np.cross(np.eye(3)[axis], x)
    return found


def _parts(tets: npt.NDArray[np.integer], count: int) -> npt.NDArray[np.int32]:
    """The part of each node, -1 if it is in no element: elements that share a node belong to one part."""
    label = linked(node_pairs(tets), count)
    used = np.zeros(count, bool)
    used[tets.ravel()] = True
    part = np.full(count, -1, np.int32)
    part[used] = np.unique(label[used], return_inverse=True)[1]
    return part


#: Lengths of steps that are tried, over the time of a wave through the body, and the share of an overlap by which
#: surfaces are pushed apart in one of them.
LENGTHS = ((1e3, 0.5), (1e1, 0.5), (1.0, 0.1))
#: Motion that rounding may cause, over the largest coordinate.
ROUNDING = 8.0 * 2.0**-24
#: Residual of each linear solve, and of forces that are in balance.
LINEAR, BALANCED = 1e-5, 1e-3
#: What ends a search whose last step did not find out what touches.
UNFINISHED = "what touches kept changing in the linear solves of the last step"


class Rest(NamedTuple):
    """The result of a search.

    Attributes:
        converged: Whether forces are in balance, and the last step moved no node by more than the tolerance, bool
            [worlds].
        iterations, linear_iterations: Steps, and iterations of conjugate gradients.
        correction: The largest motion of the last step over the largest displacement.
        residual: The norm of forces that are out of balance, contact included, over that of the loads or of
            contact, of the world where it is largest.
        contact: The contact of the last step; None if the search did not end.
        rolls: Whether the last step was mostly a motion without deformation, of some body that nothing holds.
        fault: What ended the last search, in some words; empty: its steps.
    """

    converged: npt.NDArray[np.bool_]
    iterations: int
    linear_iterations: int
    correction: float
    residual: float
    contact: Contacts | None
    rolls: bool
    fault: str = ""

    @property
    def message(self) -> str:
        """What happened, in one line."""
        if self.converged.all():
            return "the body is at rest"
        if self.rolls:
            return "not converged: the body still rolls, slides or falls as a whole; fix some nodes, or add friction"
        return f"not converged: {self.fault or 'the steps were not enough'}"


def checked_obstacles(given: Shape | Sequence[Shape]) -> tuple[Shape, ...]:
    """Shapes at rest.

    Raises:
        InputError: There is something else.
    """
    return checked_things(
        given, Shape, "an obstacle", "a shape at rest such as Ground(); in static answers tools are not"
    )


def rest_on(
    loaded: Sequence[LoadedBody],
    laws: Sequence[Model],
    gravity: tuple[float, float, float],
    obstacles: Sequence[Shape],
    contact: Contact | None,
    *,
    tolerance: float,
    most: int,
    preconditioner: str | None,
) -> Rest:
    """Move bodies to where they rest on obstacles and on one another, from their present displacements.

    If the steps do not come to rest, shorter ones are tried from the beginning, which search more carefully. If these
    fail too, the bodies return to their first state.

    Args:
        loaded: The bodies.
        laws: Their models.
        gravity: [m/s^2].
        obstacles: The obstacles on which they rest.
        contact: The options of contact.
        tolerance: For the last step: the largest motion over the largest displacement.
        most: The maximum number of steps.
        preconditioner: The preconditioner of the linear solves.
    """
    bodies = [each.body for each in loaded]
    starts = [body.displacements.numpy().copy() for body in bodies]
    steps, linear, worlds, rolls, fault = 0, 0, bodies[0].worlds, False, ""
    correction, converged = np.full(worlds, np.inf), np.zeros(worlds, bool)
    for number, (length, settling) in enumerate(LENGTHS):
        dt = length * max(_wave_time(body) for body in bodies)
        euler = BackwardEuler(dt=dt, linear_tolerance=LINEAR, preconditioner=preconditioner)
        sim = Simulation(bodies, model=laws, integrator=euler, gravity=gravity, obstacles=obstacles, contact=contact)
        if sim.contact is not None:
            sim.contact.settle(settling, exactly=number == 0)
        try:
            for _ in range(most):
                unfinished = _unfinished(sim)
                for body, start in zip(bodies, starts, strict=True):
                    body.state.set_velocities(np.zeros_like(start))
                sim.advance_steps(1)
                corrections = [_correction(body, dt) for body in bodies]
                correction = np.max([each for each, _least in corrections], axis=0)
                steps += 1
                at_rest = all((each <= np.maximum(tolerance, least)).all() for each, least in corrections)
                if at_rest and _unfinished(sim) == unfinished:
                    converged = _residuals(loaded) <= BALANCED
                    if converged.all():
                        break
            fault = UNFINISHED if _unfinished(sim) > unfinished else ""
        except UnstableError as error:
            converged, fault = np.zeros(worlds, bool), str(error).split(" at step ")[0]
        linear += sim.solves.linear_iterations if sim.solves is not None else 0
        if converged.all():
            break
        rolls = any(_rolls(body) for body in bodies)
        for body, start in zip(bodies, starts, strict=True):
            body.displacements = start
    contact_then = sim.contact if converged.all() else None
    residual = float(_residuals(loaded).max())
    return Rest(converged, steps, linear, float(correction.max()), residual, contact_then, rolls, fault)


def _unfinished(sim: Simulation) -> int:
    """The number of steps whose solves of contact ran out."""
    return 0 if sim.solves is None else sim.solves.unfinished


def _wave_time(body: SoftBody) -> float:
    """The time of a wave through the softest part of the body [s]."""
    size = float(np.ptp(body.mesh.points, axis=0).max())
    stiffness = float(body.discretization.mu.numpy().min())
    density = float(body.masses.sum()) / (body.worlds * float(np.sum(body.mesh.volumes)))
    return size * float(np.sqrt(density / stiffness))


def _correction(body: SoftBody, dt: float) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """The largest motion of the last step over the largest displacement, of each world, and as much as rounding of gaps
    makes of it: a body that hardly moves is at rest before it is still to the last digit."""
    worlds = body.worlds
    moved = dt * np.linalg.norm(body.velocities.numpy().reshape(worlds, -1, 3).astype(np.float64), axis=2).max(axis=1)
    reach = np.linalg.norm(body.displacements.numpy().reshape(worlds, -1, 3).astype(np.float64), axis=2).max(axis=1)
    reach = np.where(reach > 0.0, reach, 1.0)
    return moved / reach, ROUNDING * float(np.abs(body.mesh.points).max()) / reach


def _residuals(loaded: Sequence[LoadedBody]) -> npt.NDArray[np.float64]:
    """The norm of forces that are out of balance over that of the loads or of contact, whichever is larger, of each
    world and the body where it is largest."""
    return np.max([_residual(each.body, each.field, each.loads) for each in loaded], axis=0)


def _residual(body: SoftBody, field: ForceField, loads: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    state, count, worlds = body.state, body.sizes.nodes, body.worlds
    pushes = state.contact_forces.numpy()[:count, :3]
    forces = field.elastic_forces(state.displacements).numpy()[:count, :3] + loads + pushes
    forces[body.conditions.held_mask()] = 0.0
    rest, load, push = (np.linalg.norm(each.reshape(worlds, -1), axis=1) for each in (forces, loads, pushes))
    scale = np.maximum(load, push)
    return np.asarray(rest / np.where(scale > 0.0, scale, 1.0))


def _rolls(body: SoftBody) -> bool:
    """Whether nothing holds the body in a world, and its last motion there was mostly that of a rigid body."""
    held = body.conditions.held_mask().reshape(body.worlds, -1).any(axis=1)
    x, v = (array.numpy().reshape(body.worlds, -1, 3).astype(np.float64) for array in (body.positions, body.velocities))
    for world in np.flatnonzero(~held):
        modes = _rigid_motions(x[world] - x[world].mean(axis=0)).reshape(-1, 6)
        rest = v[world].ravel() - modes @ np.linalg.lstsq(modes, v[world].ravel(), rcond=None)[0]
        if np.linalg.norm(rest) < 0.5 * np.linalg.norm(v[world]):
            return True
    return False


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
    options: dict[str, Any] = {"tolerance": TOLERANCE, "most": STEPS, "preconditioner": None}
    found = rest_on(loaded, sim.models, sim.gravity, _standing(sim), sim.contact.options, **options)
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
