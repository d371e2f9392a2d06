"""This package's solver for Newton, and Newton's own (``newton_peer``). The import fails if Newton is not installed.

Forces include those of Newton's force kernel, damping and activation; both are zero. They use gathered positions as
in a step: padded to 16 bytes, or displacements of forests. Whole steps are complete calls of ``step``.
"""

from __future__ import annotations

import math
import sys

import newton
import newton_peer
import numpy as np
import warp as wp
from measure import Case
from newton_peer import NAME, WRONG_POSITIONS, NewtonSteps
from problem import Problem, oracle, relative_error
from stable import Steppable

import warp_corot as wc
import warp_corot.newton as wn
from warp_corot.newton.scene import ForestName

#: Newton's own solvers are left out above this size.
MOST_TETS = sys.maxsize


def force_cases(problem: Problem) -> list[Case]:
    ours = [_force_case(problem, as_forest) for as_forest in (False, True)]
    return [*ours, newton_peer.force_case(problem)]


def steps(problem: Problem) -> list[Steppable]:
    ours: list[Steppable] = [OurNewtonSteps(problem, as_forest) for as_forest in (False, True)]
    if problem.tet_count > newton_peer.MOST_TETS:
        print(f"{NAME}: steps left out above {newton_peer.MOST_TETS} tetrahedra; try a lower --step-level")
        return ours
    return ours + newton_peer.steps(problem)


def _name(as_forest: bool) -> str:
    return f"ours in Newton, {'add_forest' if as_forest else 'add_mesh'}"


def _model(problem: Problem, as_forest: bool) -> newton.Model:
    """The problem's model as ``add_forest`` or ``add_mesh`` and ``finalize`` make it.

    Builders keep Python lists, which take half an hour for 12.6 million tetrahedra, so one cube is added and the
    model's arrays are replaced.
    """
    builder = newton.ModelBuilder(up_axis=newton.Axis.Z, gravity=tuple(newton_peer.GRAVITY))
    cube = wc.TetForest.box()
    if as_forest:
        wn.add_forest(builder, cube, problem.material, surface=False)
    else:
        wn.add_mesh(builder, wc.TetMesh(cube.points, cube.tets), problem.material, surface=False)
    model = builder.finalize(device=problem.device)

    count, elements = problem.node_count, newton_peer.Elements.of(problem)
    masses = np.where(problem.held, 0.0, problem.body.masses)
    flags, radius = int(model.particle_flags.numpy()[0]), float(model.particle_radius.numpy()[0])

    def array(values: np.ndarray, dtype: type = wp.float32) -> wp.array:
        return wp.array(values, dtype=dtype, device=problem.device)

    model.particle_count, model.tet_count = count, problem.tet_count
    model.particle_q = array(problem.mesh.points, wp.vec3)
    model.particle_qd = array(np.zeros((count, 3)), wp.vec3)
    model.particle_mass = array(masses)
    model.particle_inv_mass = array(np.divide(1.0, masses, out=np.zeros(count), where=masses > 0))
    model.particle_radius = array(np.full(count, radius))
    model.particle_flags = array(np.full(count, flags), wp.int32)
    model.particle_world = array(np.full(count, -1), wp.int32)
    model.tet_indices = array(elements.tets.ravel(), wp.int32)
    model.tet_poses = array(elements.poses, wp.mat33)
    model.tet_activations = array(np.zeros(problem.tet_count))
    model.tet_materials = array(np.tile([problem.mu, problem.lam, 0.0], (problem.tet_count, 1)))
    if as_forest:
        model.warp_corot.forest[0] = ForestName.of(problem.mesh)
        model.warp_corot.fill = array(np.ones(problem.tet_count))
    return model


def _solver(model: newton.Model) -> wn.SolverCorotated:
    """A solver that takes any step, stable or not, for the search for the largest one."""
    return wn.SolverCorotated(model, stable_dt=1.0)


def _force_case(problem: Problem, as_forest: bool) -> Case:
    model = _model(problem, as_forest)
    solver, state = _solver(model), model.state()
    assert bool(solver.tetrahedra.single_count) != as_forest
    wp.copy(state.particle_q, wp.array(problem.x, dtype=wp.vec3, device=problem.device))
    solver.step(state, model.state(), None, None, 1e-9)
    f = wp.zeros(problem.node_count, dtype=wp.vec4, device=problem.device)

    def run() -> None:
        solver.tetrahedra.add_forces(state, model.tet_activations, f)

    def error() -> float:
        f.zero_()
        run()
        reference = problem.sample.forces("corotated", problem.x, problem.mu, problem.lam)
        return relative_error(f.numpy()[problem.sample.nodes, :3], reference)

    return Case("whole force", _name(as_forest), run, error, problem.tet_count, wrong=WRONG_POSITIONS)


class OurNewtonSteps(NewtonSteps):
    """Steps of ``SolverCorotated``; a state that is not finite counts as infinitely far."""

    def __init__(self, problem: Problem, as_forest: bool):
        model = _model(problem, as_forest)
        super().__init__("", problem, model, _solver(model), oracle.corotated)
        self.name = _name(as_forest)
        self.explicit, self.wrong = True, WRONG_POSITIONS
        self.broken = False

    def reset(self) -> None:
        super().reset()
        self.broken = False

    def step(self, count: int) -> None:
        try:
            super().step(count)
            if not self.problem.device.is_capturing:
                self.solver.check()
        except wc.UnstableError:
            self.broken = True

    def largest_displacement(self) -> float:
        return math.inf if self.broken else super().largest_displacement()
