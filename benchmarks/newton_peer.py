"""Newton on the problem's mesh: its force kernel, and its solvers' steps. The import fails if Newton is not installed.

Particle contacts and triangles are off, so that only elasticity and integration are left. Newton stores positions,
not displacements, and a rest matrix, activation and three material parameters for each tetrahedron.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from dataclasses import dataclass

import newton
import numpy as np
import warp as wp
from measure import Case
from newton._src.solvers.semi_implicit.kernels_particle import eval_tetrahedra
from problem import Problem, oracle, relative_error
from stable import Steppable

import warp_corot as wc

NAME = f"Newton {newton.__version__}"

#: Largest number of tetrahedra, because Newton's builder keeps Python lists.
MOST_TETS = 4_000_000

GRAVITY = np.array([0.0, 0.0, -9.81])

#: float32 positions lose digits of small strains on fine meshes.
WRONG_POSITIONS = 1e-2


# --- Newton's laws in float64 -----------------------------------------------------------------------------------------


def semi_implicit_density(F: np.ndarray, mu: float, lam: float) -> tuple[np.ndarray, np.ndarray]:
    """Stable neo-Hookean of Smith et al. (2018) as in ``eval_tetrahedra``; without energies."""
    alpha = 1.0 + mu / lam - mu / (4.0 * lam)
    squares = np.sum(F**2, axis=(1, 2))
    P = (mu * (1.0 - 1.0 / (squares + 1.0)))[:, None, None] * F
    return np.zeros(len(F)), P + (lam * (np.linalg.det(F) - alpha))[:, None, None] * oracle.cofactor(F)


def vbd_density(F: np.ndarray, mu: float, lam: float) -> tuple[np.ndarray, np.ndarray]:
    """The same without the logarithm, Lamé's parameters converted."""
    alpha = 1.0 + mu / (lam + mu)
    return np.zeros(len(F)), mu * F + ((lam + mu) * (np.linalg.det(F) - alpha))[:, None, None] * oracle.cofactor(F)


def xpbd_density(F: np.ndarray, mu: float, lam: float) -> tuple[np.ndarray, np.ndarray]:
    """Two constraints, tr F^T F - 3 and det F - 1, with compliances 1/mu and 1/lambda."""
    stretch = np.sum(F**2, axis=(1, 2)) - 3.0
    P = (2.0 * mu * stretch)[:, None, None] * F
    return np.zeros(len(F)), P + (lam * (np.linalg.det(F) - 1.0))[:, None, None] * oracle.cofactor(F)


def _forces(problem: Problem, density: Callable, x: np.ndarray) -> np.ndarray:
    sample = problem.sample
    return oracle.continuum(density, sample.mesh, x[sample.used], problem.mu, problem.lam)[1][sample.rows]


# --- the force kernel -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Elements:
    tets: np.ndarray
    poses: np.ndarray

    @classmethod
    @functools.lru_cache(maxsize=1)
    def of(cls, problem: Problem) -> Elements:
        tets = wc.TetMesh(problem.mesh.points, problem.mesh.tets).tets
        x = problem.mesh.points[tets]
        return cls(tets, np.linalg.inv(np.swapaxes(x[:, 1:] - x[:, :1], 1, 2)).astype(np.float32))


def force_case(problem: Problem) -> Case:
    """``eval_tetrahedra`` with no damping."""
    device, count = problem.device, problem.tet_count
    elements = Elements.of(problem)
    x = wp.array(problem.x.astype(np.float32), dtype=wp.vec3, device=device)
    f = wp.zeros_like(x)
    inputs = [
        x,
        wp.zeros_like(x),
        wp.array(elements.tets, dtype=wp.int32, device=device),
        wp.array(elements.poses, dtype=wp.mat33, device=device),
        wp.zeros(count, dtype=wp.float32, device=device),
        wp.array(np.tile([problem.mu, problem.lam, 0.0], (count, 1)), dtype=wp.float32, device=device),
    ]

    def run() -> None:
        wp.launch(eval_tetrahedra, count, inputs, [f], device=device)

    def error() -> float:
        f.zero_()
        run()
        reference = _forces(problem, semi_implicit_density, problem.x)
        return relative_error(f.numpy()[problem.sample.nodes], reference)

    name = f"{NAME}, eval_tetrahedra (neo-Hookean)"
    return Case("whole force", name, run, error, count, wrong=WRONG_POSITIONS)


# --- steps ------------------------------------------------------------------------------------------------------------


def _model(problem: Problem) -> newton.Model:
    builder = newton.ModelBuilder(up_axis=newton.Axis.Z, gravity=tuple(GRAVITY))
    elements = Elements.of(problem)
    masses = problem.body.masses.copy()
    masses[problem.held] = 0.0
    n, count = problem.node_count, problem.tet_count
    builder.add_particles(problem.mesh.points.tolist(), [(0.0, 0.0, 0.0)] * n, masses.tolist(), [0.0] * n)
    # The same as ``add_tetrahedron`` does one by one.
    builder.tet_indices.extend(map(tuple, elements.tets.tolist()))
    builder.tet_poses.extend(elements.poses.tolist())
    builder.tet_activations.extend([0.0] * count)
    builder.tet_materials.extend([(problem.mu, problem.lam, 0.0)] * count)
    builder.color()
    model = builder.finalize(device=problem.device)
    model.particle_grid = None
    return model


class NewtonSteps(Steppable):
    """Steps of one of Newton's solvers from the problem's state."""

    recordable = True

    def __init__(self, name: str, problem: Problem, model: newton.Model, solver: object, density: Callable):
        self.name = f"{NAME}, {name}"
        self.problem = problem
        self.solver = solver
        self.density = density
        self.explicit = density is semi_implicit_density
        self.wrong = WRONG_POSITIONS if self.explicit else None
        self.states = [model.state(), model.state()]
        self.control = model.control()
        self.start = wp.array(problem.x.astype(np.float32), dtype=wp.vec3, device=problem.device)
        self.dt = 0.0

    def reset(self) -> None:
        for state in self.states:
            wp.copy(state.particle_q, self.start)
            state.particle_qd.zero_()

    def step(self, count: int) -> None:
        for _ in range(count):
            before, after = self.states
            before.clear_forces()
            self.solver.step(before, after, self.control, None, self.dt)
            self.states.reverse()

    def largest_displacement(self) -> float:
        moved = self.states[0].particle_q.numpy() - self.problem.mesh.points
        return float(np.abs(moved).max()) if np.isfinite(moved).all() else float("inf")

    def error(self) -> float:
        """The error of one step for an explicit solver; for the others, the remaining residual of the implicit step."""
        problem, dt = self.problem, self.dt
        nodes = problem.sample.nodes[~problem.held[problem.sample.nodes]]
        free = ~problem.held[problem.sample.nodes]
        self.reset()
        x0 = self.start.numpy().astype(float)
        self.step(1)
        x1 = self.states[0].particle_q.numpy().astype(float)
        inertia = problem.body.masses[nodes, None] / dt**2
        if self.explicit:
            moved = dt**2 * (_forces(problem, self.density, x0)[free] / problem.body.masses[nodes, None] + GRAVITY)
            return relative_error((x1 - x0)[nodes], moved)
        predicted = np.where(problem.held[:, None], x0, x0 + dt**2 * GRAVITY)
        at_first = _forces(problem, self.density, predicted)[free]
        left = inertia * (x1 - predicted)[nodes] - _forces(problem, self.density, x1)[free]
        return float(np.linalg.norm(left) / np.linalg.norm(at_first))


def steps(problem: Problem) -> list[Steppable]:
    try:
        model = _model(problem)
    except AttributeError as error:
        # Newton prepares a model with kernels on the CPU, for which some builds of Warp have no compiler.
        print(f"Newton's solvers: left out ({type(error).__name__}: {error})", file=sys.stderr)
        return []
    solvers = newton.solvers
    semi_implicit = solvers.SolverSemiImplicit(model, enable_tri_contact=False)
    return [
        NewtonSteps("SemiImplicit", problem, model, semi_implicit, semi_implicit_density),
        NewtonSteps("VBD, 10 iterations", problem, model, solvers.SolverVBD(model, iterations=10), vbd_density),
        NewtonSteps("XPBD, 2 iterations", problem, model, solvers.SolverXPBD(model, iterations=2), xpbd_density),
    ]
