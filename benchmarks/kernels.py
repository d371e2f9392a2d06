#!/usr/bin/env python3
"""What each stage of a time step costs, and what it would have to cost at the least.

    python benchmarks/kernels.py [--device cuda:0] [--level 21] [--json FILE]

One root cube, bisected to a level, nodes jittered by 5 % of the edge length, float32. Every timed result is checked
against float64 in the same run.
"""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import stages
import warp as wp
import work
from measure import (
    WRONG,
    Case,
    Result,
    checked,
    copy_bandwidth,
    finish,
    machine,
    measure,
    number,
    parser,
    percent,
    table,
    tell,
)
from problem import GROUP_LEVELS, SUBTREE_LEVELS, Problem, Sample, relative_error
from warp_corot.kernels.corotated import extract_rotations, extract_warm_rotations
from warp_corot.kernels.elements import ForestElements
from warp_corot.kernels.rotation import byers_xu

import warp_corot as wc
from warp_corot.elasticity import ForceField, Model
from warp_corot.elements import forest_elements
from warp_corot.experiments import paper
from warp_corot.rotations import rotation_function
from warp_corot.solvers.integrator import StepContext

HEADER = ("stage", "variant", "ns/tet", "spread", "Gtet/s", "B/tet", "flop/tet", "of copy", "error")

#: Steps of one sample of a whole-step row.
STEPS = 64
BEAM_STEPS = 1024
DAMPING = 15.0

#: Warp's SVD stops early.
SVD_WRONG = 1e-2


# --- rotation ---------------------------------------------------------------------------------------------------------


def rotation_cases(problem: Problem) -> list[Case]:
    """F from the nodes' displacements, R from F, R written; R kept an element, or a unit of the tree."""
    cases = [
        _rotation_case(problem, "Byers-Xu, to tolerance", byers_xu, 0, work.rotation_flops(tested=True)),
        _rotation_case(problem, "Byers-Xu, 4 iterations", rotation_function("byers-xu", 4), 0),
        _rotation_case(problem, "SVD (McAdams et al.)", rotation_function("svd"), 0, None, SVD_WRONG),
        _warm_case(problem),
    ]
    for up in (1, 3, 6):
        if up <= problem.level:
            name = f"Byers-Xu, 4 iterations, {up} level{'s' * (up > 1)} up"
            cases.append(_rotation_case(problem, name, rotation_function("byers-xu", 4), up))
    return cases


def _rotation_case(
    problem: Problem,
    name: str,
    rotation: wp.Function,
    levels_up: int,
    flops: float | None = work.rotation_flops(tested=False),
    wrong: float = WRONG,
) -> Case:
    units, _unit = problem.units(levels_up)
    elements = forest_elements(problem.mesh, units, problem.device)
    tets = elements.nodes.numpy()
    rotations = wp.zeros(len(units), dtype=wp.mat33, device=problem.device)
    kernel = extract_rotations(ForestElements, rotation)
    u = problem.body.node_displacements

    def run() -> None:
        wp.launch(kernel, len(units), [elements, u], [rotations], device=problem.device)

    def error() -> float:
        run()
        some = _some(len(units))
        return relative_error(rotations.numpy()[some], problem.rotations_of(tets[some]))

    share = len(units) / problem.tet_count
    if flops is not None:
        flops = share * (work.gradient_flops((problem.level - levels_up) % 3) + work.FRAME_ADDED + flops)
    floor = _rotation_bytes(problem, tets)
    return Case("rotation", name, run, error, problem.tet_count, floor, flops, wrong=wrong)


def _warm_case(problem: Problem) -> Case:
    """Between two states a thousandth of an edge apart, to and fro: what a step's motion is like."""
    units, _unit = problem.units(0)
    elements = forest_elements(problem.mesh, units, problem.device)
    count = len(units)
    rotations = wp.zeros(count, dtype=wp.mat33, device=problem.device)
    quaternions = wp.array(np.tile(np.float32([0, 0, 0, 1]), (count, 1)), dtype=wp.quat, device=problem.device)
    kernel = extract_warm_rotations(ForestElements)
    rng = np.random.default_rng(2)
    moved = problem.u + (1e-3 * problem.edge * rng.uniform(-1, 1, problem.u.shape)).astype(np.float32)
    states = [_vec4(moved, problem.device), problem.body.node_displacements]

    def run() -> None:
        for u in states:
            wp.launch(kernel, count, [elements, u], [quaternions, rotations], device=problem.device)

    def error() -> float:
        run()
        some = _some(count)
        return relative_error(rotations.numpy()[some], problem.rotations_of(problem.mesh.tets[some]))

    floor = _rotation_bytes(problem, problem.mesh.tets) + 2 * work.QUATERNION
    return Case("rotation", "warm quaternion, 0.1 % of h moved", run, error, count, floor, None, repeats=2)


def _rotation_bytes(problem: Problem, tets: np.ndarray) -> float:
    nodes = np.zeros(problem.node_count, bool)
    nodes[tets] = True
    return (len(tets) * (work.ELEMENT + work.ROTATION) + nodes.sum() * work.READ) / problem.tet_count


# --- stiffness product ------------------------------------------------------------------------------------------------


def product_cases(problem: Problem) -> list[Case]:
    """Nodal forces of every element with rotations from three levels up, ended in the sum of their squares."""
    device, count = problem.device, problem.tet_count
    units, unit = problem.units(SUBTREE_LEVELS)
    elements = forest_elements(problem.mesh, units, device)
    rotations = wp.zeros(len(units), dtype=wp.mat33, device=device)
    u = problem.body.node_displacements
    wp.launch(extract_rotations(ForestElements, byers_xu), len(units), [elements, u], [rotations], device=device)
    unit_of = wp.array(unit, dtype=wp.int32, device=device)
    squares = wp.zeros(count, dtype=wp.float32, device=device)
    body, shape = problem.body, problem.level % 3
    floor = work.ELEMENT + 4 + 4 + work.READ * problem.nodes_per_tet + work.ROTATION * len(units) / count
    factored = work.gradient_flops(shape) + work.rotated_stress_flops() + work.force_flops(shape)

    def case(name: str, kernel: wp.Kernel, flops: float) -> Case:
        def run() -> None:
            inputs = [body.elements, body.mu, body.lam, u, rotations, unit_of]
            wp.launch(kernel, count, inputs, [squares], device=device)

        def error() -> float:
            squares.zero_()
            run()
            return relative_error(squares.numpy()[problem.sample.elements], _reference_squares(problem))

        return Case("stiffness product", name, run, error, count, floor, flops)

    return [
        case("dense 12x12", stages.square_product_forces(False), work.matrix_flops(shape, skip_zeros=False)),
        case("sparse K_T by type", stages.square_product_forces(True), work.matrix_flops(shape, skip_zeros=True)),
        case("factored", stages.square_factored_forces, factored),
    ]


def _reference_squares(problem: Problem) -> np.ndarray:
    import oracle

    mesh = problem.sample.mesh
    F = mesh.deformation_gradients(problem.x[problem.sample.used])
    _psi, P = oracle.corotated(F, problem.mu, problem.lam, R=problem.shared_rotations(SUBTREE_LEVELS))
    forces = np.einsum("t,tiJ,taJ->tai", mesh.volumes, P, mesh.gradients)
    return np.sum(forces**2, axis=(1, 2))


# --- scatter ----------------------------------------------------------------------------------------------------------


def scatter_cases(problem: Problem) -> list[Case]:
    """A constant added at every node of every element, or of every subtree; the exact sums are counts."""
    device, count = problem.device, problem.tet_count
    scattered = work.ADD_TO * problem.nodes_per_tet

    def case(name: str, kernel: wp.Kernel, lists: np.ndarray, index_type: Any, value_type: Any, floor: float) -> Case:
        nodes = wp.array(lists, dtype=index_type, device=device)
        f = wp.zeros(problem.node_count, dtype=value_type, device=device)

        def run() -> None:
            wp.launch(kernel, len(lists), [nodes], [f], device=device)

        def error() -> float:
            f.zero_()
            run()
            times = np.bincount(lists.ravel(), minlength=problem.node_count)
            return relative_error(f.numpy()[:, :3], times[:, None] * np.array([1.0, 2.0, 3.0]))

        return Case("scatter", name, run, error, count, floor, 3 * lists.size / count)

    tets = problem.mesh.tets
    packed = 24.0 * problem.nodes_per_tet
    cases = [
        case("flat, vec3 atomics", stages.scatter_vec3, tets, wp.vec4i, wp.vec3, work.INDICES + packed),
        case("flat, add_force", stages.scatter_flat, tets, wp.vec4i, wp.vec4, work.INDICES + scattered),
    ]
    for name, levels in (("subtrees of 8", SUBTREE_LEVELS), ("subtrees of 64", GROUP_LEVELS)):
        if levels <= problem.level:
            lists = problem.subtree_nodes(levels)
            floor = 4.0 * lists.size / count + scattered
            cases.append(case(f"{name}, add_force", stages.scatter_lists, lists, wp.int32, wp.vec4, floor))
    return cases


# --- whole force ------------------------------------------------------------------------------------------------------


def force_cases(problem: Problem) -> list[Case]:
    """``Model.bind(body).add_forces(u, f)`` as a simulation launches it."""
    shape = problem.level % 3
    floor = work.CONNECTIVITY + (work.READ + work.ADD_TO) * problem.nodes_per_tet
    tested, fixed = work.rotation_flops(tested=True), work.rotation_flops(tested=False)
    shared_flops = work.model_flops("corotated", shape, tested / 8)
    shared = wc.Corotated(rotation_level=problem.level - SUBTREE_LEVELS)

    def forest(name: str, model: Model, of: str, flops: float | None, **options: Callable[[], np.ndarray]) -> Case:
        return force_case(problem, name, problem.body, model.bind(problem.body), of, floor, flops, **options)

    springs = wc.MassSpring().bind(problem.body)
    edges_per_tet = springs.energy_count / problem.tet_count
    spring_bytes = work.EDGE * edges_per_tet + (work.READ + work.ADD_TO) * problem.nodes_per_tet
    general = problem.general_body
    general_bytes = work.GENERAL_ELEMENT + (work.READ + work.ADD_TO) * problem.nodes_per_tet
    general_flops = work.GENERAL_GRADIENT + tested + work.rotated_stress_flops() + work.GENERAL_FORCE + work.SCATTER
    model_flops = work.model_flops
    return [
        forest("corotated, own rotations", wc.Corotated(), "corotated", model_flops("corotated", shape, tested)),
        forest(
            "corotated, own, 4 iterations",
            wc.Corotated(iterations=4),
            "corotated",
            model_flops("corotated", shape, fixed),
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
        forest("StVK on edges", wc.EdgeStVK(), "edge_stvk", model_flops("edge_stvk", shape)),
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
    u = body.node_displacements
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
    """Leaves an integrator's launches alone."""

    def add_forces(self, u: wp.array, f: wp.array) -> None: ...

    def write_energies(self, u: wp.array, energies: wp.array) -> None: ...

    def write_von_mises(self, u: wp.array, stress: wp.array) -> None: ...


def integration_case(problem: Problem) -> Case:
    """Velocities, displacements and the emptied force array, on a body of its own with random forces and velocities."""
    dt = 1e-4
    body = problem.new_body(problem.mesh)
    body.fix(problem.held)
    rng = np.random.default_rng(3)
    v, f = (rng.uniform(-1, 1, problem.u.shape).astype(np.float32) for _ in range(2))
    v[body.constrained] = 0
    f *= np.float32(body.masses.mean() * 10.0)
    clock = wp.zeros(1, dtype=wp.int64, device=problem.device)
    bad_step = wp.array([np.iinfo(np.int64).max], dtype=wp.int64, device=problem.device)
    context = StepContext(dt, wp.vec3(0.0, 0.0, 0.0), clock, bad_step)
    stepper = wc.SymplecticEuler(dt, DAMPING).bind(body, _NoForces(body), context)

    def error() -> float:
        body.velocities = v
        body.node_forces.assign(_padded(f))
        stepper.step(0)
        w = np.where(body.constrained, 0.0, 1.0 / body.masses)[:, None]
        reference = (v + dt * (f * w)) / (1.0 + dt * DAMPING)
        return relative_error(body.velocities.numpy(), reference)

    per_tet = problem.nodes_per_tet
    return Case(
        "integration",
        "symplectic Euler",
        lambda: stepper.step(0),
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
        step_case("corotated, rotations 3 up", problem, shared, floor, R=lambda: problem.shared_rotations(3)),
        _beam_case(beam, problem.device),
    ]


def step_case(
    name: str,
    problem: Problem,
    model: Model,
    floor: float | None,
    steps: int = STEPS,
    **options: Callable[[], np.ndarray],
) -> Case:
    """Steps from the problem's state, always the same ones."""
    body = problem.new_body(problem.mesh)
    body.fix(problem.held)
    sim = wc.Simulation(body, model=model, integrator=wc.SymplecticEuler(None, DAMPING), gravity=(0.0, 0.0, -9.81))

    def forces() -> np.ndarray:
        given = {key: value() for key, value in options.items()}
        return problem.sample.forces("corotated", problem.x, problem.mu, problem.lam, **given)

    return _stepping("whole step", name, sim, problem.u, problem.sample, forces, floor, steps)


def _beam_case(beam: wc.TetForest, device: wp.Device) -> Case:
    """The paper's beam of 1152 tetrahedra, hanging."""
    import oracle

    body = wc.SoftBody(beam, wc.Isotropic(**paper.MATERIAL), device=device)
    body.fix(beam.points[:, 2] < 1e-9)
    sim = wc.Simulation(body, integrator=wc.SymplecticEuler(2e-4, DAMPING), gravity=paper.GRAVITY)
    rng = np.random.default_rng(4)
    u = (0.05 * paper.CELL_SIZE / 4 * rng.uniform(-1, 1, beam.points.shape)).astype(np.float32)
    sample = Sample(beam.points, beam.tets)
    mu, lam = oracle.lame(paper.MATERIAL["young"], paper.MATERIAL["poisson"])

    def forces() -> np.ndarray:
        return sample.forces("corotated", beam.points + u.astype(float), float(mu), float(lam))

    return _stepping("whole step", f"the paper's beam, {len(beam.tets)} tets", sim, u, sample, forces, None, BEAM_STEPS)


def _stepping(
    stage: str,
    name: str,
    sim: wc.Simulation,
    u: np.ndarray,
    sample: Sample,
    forces: Callable[[], np.ndarray],
    floor: float | None,
    steps: int,
) -> Case:
    body = sim.body
    start = _vec4(u, sim.device)

    def reset() -> None:
        wp.copy(body.node_displacements, start)
        body.node_velocities.zero_()
        body.node_forces.zero_()
        body.publish_positions()

    def error() -> float:
        reset()
        sim.advance_steps(1)
        moved = body.displacements.numpy()[sample.nodes].astype(float) - u[sample.nodes]
        mass = sample.masses(float(body.material.density))[:, None]
        velocity = sim.dt * (forces() / mass + np.asarray(sim.gravity)) / (1.0 + sim.dt * DAMPING)
        velocity[body.constrained[sample.nodes]] = 0.0
        return relative_error(moved, sim.dt * velocity)

    tets = len(body.mesh.tets)
    case = Case(stage, name, lambda: sim.advance_steps(steps), error, tets, floor, None, steps, False, reset)
    case.extra["dt"] = sim.dt
    return case


# --- pieces -----------------------------------------------------------------------------------------------------------


def _padded(vectors: np.ndarray) -> np.ndarray:
    return np.concatenate([vectors, np.zeros((len(vectors), 1), np.float32)], axis=1)


def _vec4(vectors: np.ndarray, device: wp.Device) -> wp.array:
    return wp.array(_padded(vectors), dtype=wp.vec4, device=device)


def _some(count: int) -> np.ndarray:
    return np.arange(count) if count <= 2000 else np.random.default_rng(5).integers(0, count, 2000)


def rows(results: Sequence[Result], copy_gb_s: float) -> list[list[str]]:
    lines = []
    for r in results:
        d = r.as_dict(copy_gb_s)
        lines.append(
            [
                d["stage"],
                d["variant"],
                number(d["ns_per_tet"]),
                percent(d["spread"]),
                number(d["gtet_per_s"]),
                number(d["bytes_per_tet"]),
                number(d["flops_per_tet"]),
                percent(d["copy_fraction"]),
                f"{d['error']:.1e}",
            ]
        )
    return lines


def main() -> int:
    of = parser(__doc__.split("\n\n")[0], "kernels.py")
    options = of.parse_args()
    device = checked(options, of, range(SUBTREE_LEVELS, 25))
    warnings.simplefilter("ignore", wc.StabilityWarning)
    start = time.perf_counter()
    about = machine(device)
    tell(f"building level {options.level}")
    problem = Problem(options.level, device)
    about |= {"level": options.level, "tets": problem.tet_count, "nodes": problem.node_count, "rounds": options.rounds}
    about["copy_gb_per_s"] = copy_bandwidth(device)
    print(
        f"{about['name']} ({device}), Warp {about['warp']}: level {options.level}, {problem.tet_count} tetrahedra, ",
        end="",
    )
    print(f"{problem.node_count} nodes, copy {about['copy_gb_per_s']:.0f} GB/s", flush=True)
    cases = [
        *rotation_cases(problem),
        *product_cases(problem),
        *scatter_cases(problem),
        *force_cases(problem),
        integration_case(problem),
        *step_cases(problem),
    ]
    results = measure(cases, device, options.rounds, tell)
    copy = about["copy_gb_per_s"]
    about["seconds"] = time.perf_counter() - start
    tell("")
    print(table(HEADER, rows(results, copy), 2))
    report = {"benchmark": "kernels", **about, "rows": [r.as_dict(copy) for r in results]}
    return finish(options, report, results)


if __name__ == "__main__":
    sys.exit(main())
