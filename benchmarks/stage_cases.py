"""The stages of a force evaluation one by one: rotation, stiffness product, scatter."""

from __future__ import annotations

from typing import Any

import numpy as np
import stages
import warp as wp
import work
from measure import WRONG, Case
from problem import GROUP_LEVELS, SUBTREE_LEVELS, Problem, oracle, relative_error

from warp_corot.discretization.elements import all_frames, device_elements
from warp_corot.elasticity.polar import rotation_function
from warp_corot.kernels.corotated.corotated import extract_rotations
from warp_corot.kernels.elements.elements import ForestElements
from warp_corot.kernels.math.rotation import byers_xu
from warp_corot.mesh import TetForest

#: Warp's SVD stops early.
SVD_WRONG = 1e-2


# --- rotation ---------------------------------------------------------------------------------------------------------


def rotation_cases(problem: Problem) -> list[Case]:
    """Displacements in, R out: one rotation for each element, or for each ancestor some levels up."""
    cases = [
        _rotation_case(problem, "Byers-Xu, to tolerance", byers_xu, 0, work.rotation_flops(tested=True)),
        _rotation_case(problem, "Byers-Xu, 4 iterations", rotation_function("byers-xu", 4), 0),
        _rotation_case(problem, "SVD (McAdams et al.)", rotation_function("svd"), 0, None, SVD_WRONG),
    ]
    for up in (1, 3, 6):
        if up <= problem.level:
            name = f"Byers-Xu, 4 iterations, {up} level{'s' * (up > 1)} up"
            cases.append(_rotation_case(problem, name, rotation_function("byers-xu", 4), up))
    return cases


def forest_elements(mesh: TetForest, chosen: np.ndarray, device: wp.Device) -> ForestElements:
    """Any tetrahedra of the tree, leaves or ancestors, as forest elements."""
    tets, level = mesh.tree.rows(chosen)
    elements = device_elements(mesh, device)
    elements.nodes = elements.targets = wp.array(tets, dtype=wp.vec4i, device=device)
    elements.code = wp.array(all_frames().codes(mesh.lattice, tets, level), dtype=wp.int32, device=device)
    return elements


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
    u = problem.body.state.displacements

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


def _rotation_bytes(problem: Problem, tets: np.ndarray) -> float:
    nodes = np.zeros(problem.node_count, bool)
    nodes[tets] = True
    return (len(tets) * (work.ELEMENT + work.ROTATION) + nodes.sum() * work.READ) / problem.tet_count


# --- stiffness product ------------------------------------------------------------------------------------------------


def product_cases(problem: Problem) -> list[Case]:
    """Nodal forces of every element with rotations from three levels up, reduced to the sum of their squares."""
    device, count = problem.device, problem.tet_count
    units, unit = problem.units(SUBTREE_LEVELS)
    elements = forest_elements(problem.mesh, units, device)
    rotations = wp.zeros(len(units), dtype=wp.mat33, device=device)
    u = problem.body.state.displacements
    wp.launch(extract_rotations(ForestElements, byers_xu), len(units), [elements, u], [rotations], device=device)
    unit_of = wp.array(unit, dtype=wp.int32, device=device)
    squares = wp.zeros(count, dtype=wp.float32, device=device)
    body, shape = problem.body, problem.level % 3
    floor = work.ELEMENT + 4 + 4 + work.READ * problem.nodes_per_tet + work.ROTATION * len(units) / count
    factored = work.gradient_flops(shape) + work.rotated_stress_flops() + work.force_flops(shape)

    def case(name: str, kernel: wp.Kernel, flops: float) -> Case:
        def run() -> None:
            inputs = [
                body.discretization.elements,
                body.discretization.mu,
                body.discretization.lam,
                u,
                rotations,
                unit_of,
            ]
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


def _some(count: int) -> np.ndarray:
    return np.arange(count) if count <= 2000 else np.random.default_rng(5).integers(0, count, 2000)
