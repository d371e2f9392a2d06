"""Whole forces, integration and whole steps, as users' simulations launch them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import paper_beam as paper
import warp as wp
import work
from measure import Case, kind
from problem import SUBTREE_LEVELS, Problem, Sample, oracle, padded, relative_error

import warp_corot as wc
from warp_corot.body.soft_body import World
from warp_corot.elasticity import ForceField, Model
from warp_corot.solvers.pace import Pace
from warp_corot.solvers.system import System

#: Steps in one sample of a whole-step row; on CUDA, as many as a call makes at an interactive rate.
STEPS = {"cuda": 512, "cpu": 64}
BEAM_STEPS = 1024
#: The given step, as a fraction of the largest stable one.
GIVEN = 0.8
#: Copies of the beam that are stepped together.
BEAM_WORLDS = {"cuda": 1024, "cpu": 16}
DAMPING = 15.0


# --- whole force ------------------------------------------------------------------------------------------------------


def force_cases(problem: Problem) -> list[Case]:
    """``Model.bind(body).add_forces(u, f)`` as a simulation launches it."""
    shape = problem.level % 3
    floor = work.CONNECTIVITY + (work.READ + work.ADD_TO) * problem.nodes_per_tet
    tested, fixed = work.rotation_flops(tested=True), work.rotation_flops(tested=False)
    shared_flops = work.model_flops("corotated", shape, tested / 8)
    shared = wc.Corotated(rotation_level=problem.level - SUBTREE_LEVELS)

    def forest(
        name: str,
        model: Model,
        of: str,
        flops: float | None,
        deterministic: bool = False,
        **options: Callable[[], np.ndarray],
    ) -> Case:
        field = model.bind(problem.body, deterministic=deterministic)
        return force_case(problem, name, problem.body, field, of, floor, flops, **options)

    springs = wc.MassSpring().bind(problem.body)
    edges_per_tet = springs.energy_count / problem.tet_count
    spring_bytes = work.EDGE * edges_per_tet + (work.READ + work.ADD_TO) * problem.nodes_per_tet
    general = problem.general_body
    general_bytes = work.GENERAL_ELEMENT + (work.READ + work.ADD_TO) * problem.nodes_per_tet
    general_flops = work.GENERAL_GRADIENT + tested + work.rotated_stress_flops() + work.GENERAL_FORCE + work.SCATTER
    model_flops = work.model_flops
    own_flops = model_flops("corotated", shape, tested)
    return [
        forest("corotated, own rotations", wc.Corotated(), "corotated", own_flops),
        forest(
            "corotated, own, 4 iterations",
            wc.Corotated(iterations=4),
            "corotated",
            model_flops("corotated", shape, fixed),
        ),
        *(
            [forest("corotated, own, deterministic", wc.Corotated(), "corotated", own_flops, True)]
            if problem.device.is_cuda
            else []
        ),
        forest("corotated, rotations 3 up", shared, "corotated", shared_flops, R=lambda: problem.shared_rotations(3)),
        force_case(
            problem,
            "corotated, general mesh",
            general,
            wc.Corotated().bind(general),
            "corotated",
            general_bytes,
            general_flops,
        ),
        forest("linear", wc.Linear(), "linear", model_flops("linear", shape)),
        forest("StVK", wc.StVenantKirchhoff(), "stvk", model_flops("stvk", shape)),
        forest("neo-Hookean", wc.NeoHookean(), "neo_hookean", model_flops("neo_hookean", shape)),
        force_case(
            problem,
            "mass-spring",
            problem.body,
            springs,
            "mass_spring",
            spring_bytes,
            work.SPRING_FLOPS * edges_per_tet,
        ),
    ]


def force_case(
    problem: Problem,
    name: str,
    body: wc.SoftBody,
    field: ForceField,
    of: str,
    floor: float | None = None,
    flops: float | None = None,
    **options: Callable[[], np.ndarray],
) -> Case:
    """The forces of one field on a body in the problem's state; ``of`` names the oracle's model."""
    u = body.state.displacements
    f = wp.zeros_like(u)

    def error() -> float:
        f.zero_()
        field.add_forces(u, f)
        given = {key: value() for key, value in options.items()}
        reference = problem.sample.forces(of, problem.x, problem.mu, problem.lam, **given)
        return relative_error(f.numpy()[problem.sample.nodes, :3], reference)

    return Case("whole force", name, lambda: field.add_forces(u, f), error, problem.tet_count, floor, flops)


# --- integration and whole steps --------------------------------------------------------------------------------------


class _NoForces(ForceField):
    """A force field without launches, to time an integrator alone."""

    def scatter_forces(self, u: wp.array, f: wp.array) -> None: ...

    def write_energies(self, u: wp.array, energies: wp.array) -> None: ...

    def write_von_mises(self, u: wp.array, stress: wp.array) -> None: ...


def integration_case(problem: Problem) -> Case:
    """Velocities, displacements and the emptied force array, on a separate body with random forces and velocities."""
    dt = 1e-4
    body = problem.new_body(problem.mesh)
    body.fix(problem.held)
    rng = np.random.default_rng(3)
    v, f = (rng.uniform(-1, 1, problem.u.shape).astype(np.float32) for _ in range(2))
    v[body.constrained] = 0
    f *= np.float32(body.masses.mean() * 10.0)
    system = System([body], [_NoForces(body)], Pace(dt, problem.device), (0.0, 0.0, 0.0))
    stepper = wc.SymplecticEuler(dt, DAMPING).bind(system)

    def error() -> float:
        body.velocities = v
        body.state.forces.assign(padded(f))
        stepper.steps(1)
        w = np.where(body.constrained, 0.0, 1.0 / body.masses)[:, None]
        reference = (v + dt * (f * w)) / (1.0 + dt * DAMPING)
        return relative_error(body.velocities.numpy(), reference)

    per_tet = problem.nodes_per_tet
    return Case(
        "integration",
        "symplectic Euler",
        lambda: stepper.steps(1),
        error,
        problem.tet_count,
        work.INTEGRATION_BYTES * per_tet,
        work.INTEGRATION_FLOPS * per_tet,
    )


def step_cases(problem: Problem) -> list[Case]:
    """``Simulation.advance_steps`` as users call it: forces, integration, fixed nodes, damping, finiteness."""
    floor = work.CONNECTIVITY + (work.READ + work.ADD_TO + work.INTEGRATION_BYTES) * problem.nodes_per_tet
    shared = wc.Corotated(rotation_level=problem.level - SUBTREE_LEVELS)
    beam = wc.TetForest.box(paper.CELLS, paper.CELL_SIZE, 6)
    return [
        step_case("corotated, own rotations", problem, wc.Corotated(), floor),
        step_case("the same, the step follows the state", problem, wc.Corotated(), floor, follows=True),
        *(
            [step_case("corotated, own, deterministic", problem, wc.Corotated(), floor, deterministic=True)]
            if problem.device.is_cuda
            else []
        ),
        step_case("corotated, rotations 3 up", problem, shared, floor, R=lambda: problem.shared_rotations(3)),
        _beam_case(beam, problem.device),
        _beam_case(beam, problem.device, BEAM_WORLDS[kind(problem.device)]),
    ]


def step_case(
    name: str,
    problem: Problem,
    model: Model,
    floor: float | None,
    follows: bool = False,
    deterministic: bool = False,
    **options: Callable[[], np.ndarray],
) -> Case:
    """Steps from the problem's state, always the same ones, of a given length or of one that follows the state.

    Nodes released at random places vibrate as fast as they can, so that a step that follows the state is checked as
    often as it ever is.
    """
    body = problem.new_body(problem.mesh)
    body.fix(problem.held)
    dt = None if follows else GIVEN * wc.Simulation(body, model=model).stable_dt
    sim = wc.Simulation(
        body,
        model=model,
        integrator=wc.SymplecticEuler(dt, DAMPING),
        gravity=(0.0, 0.0, -9.81),
        deterministic=deterministic,
    )

    def forces() -> np.ndarray:
        given = {key: value() for key, value in options.items()}
        return problem.sample.forces("corotated", problem.x, problem.mu, problem.lam, **given)

    return _stepping(name, sim, problem.u, problem.sample, forces, floor, STEPS[kind(problem.device)])


def _beam_case(beam: wc.TetForest, device: wp.Device, worlds: int = 1) -> Case:
    """The paper's beam of 1152 tetrahedra, hanging, or many of them; the middle one is checked."""
    body = wc.SoftBody(beam, wc.Isotropic(**paper.MATERIAL), worlds=worlds, device=device)
    body.fix(beam.points[:, 2] < 1e-9)
    model, euler = wc.Corotated(dilatation="element"), wc.SymplecticEuler(2e-4, DAMPING)
    sim = wc.Simulation(body, model=model, integrator=euler, gravity=paper.GRAVITY)
    rng = np.random.default_rng(4)
    u = (0.05 * paper.CELL_SIZE / 4 * rng.uniform(-1, 1, body.rest_positions.shape)).astype(np.float32)
    sample = Sample(beam.points, beam.tets)
    mu, lam = oracle.lame(paper.MATERIAL["young"], paper.MATERIAL["poisson"])
    world = body.world(worlds // 2)

    def forces() -> np.ndarray:
        return sample.forces("corotated", beam.points + u[world.nodes].astype(float), float(mu), float(lam))

    name = f"the paper's beam, {len(beam.tets)} tets" if worlds == 1 else f"{worlds} of the paper's beams"
    return _stepping(name, sim, u, sample, forces, None, BEAM_STEPS, world)


def _stepping(
    name: str,
    sim: wc.Simulation,
    u: np.ndarray,
    sample: Sample,
    forces: Callable[[], np.ndarray],
    floor: float | None,
    steps: int,
    world: World | None = None,
) -> Case:
    start = wp.array(padded(u), dtype=wp.vec4, device=sim.device)
    return Case(
        "whole step",
        name,
        lambda: sim.advance_steps(steps),
        lambda: step_error(sim, start, sample, forces(), world),
        sim.body.element_count,
        floor,
        repeats=steps,
        recorded=False,
        reset=lambda: put_back(sim.body, start),
        extra={"dt": sim.dt},
    )


def put_back(body: wc.SoftBody, start: wp.array) -> None:
    """Reset displacements vec4 [N] to ``start``, at rest."""
    wp.copy(body.state.displacements, start)
    body.state.velocities.zero_()
    body.state.forces.zero_()
    body.state.publish_positions()


def step_error(
    sim: wc.Simulation, start: wp.array, sample: Sample, forces: np.ndarray, world: World | None = None
) -> float:
    """Error of one damped step from ``start`` at rest, given nodal forces [n, 3] on the sample's nodes."""
    body = sim.body
    nodes = sample.nodes + (world.nodes.start if world else 0)
    put_back(body, start)
    before = start.numpy()[nodes, :3].astype(float)
    sim.advance_steps(1)
    moved = body.displacements.numpy()[nodes] - before
    mass = sample.masses(float(body.material.density))[:, None]
    velocity = sim.dt * (forces / mass + np.asarray(sim.gravity)) / (1.0 + sim.dt * DAMPING)
    velocity[body.constrained[nodes]] = 0.0
    return relative_error(moved, sim.dt * velocity)
