#!/usr/bin/env python3
"""This package's solver for Newton next to Newton's own: forces, and whole steps with the largest step that stands.

    python benchmarks/newton_steps.py [--device cuda:0] [--level 18] [--json FILE]

The same scene for all: tetrahedra under gravity, held at the floor. Forces include what Newton's force kernel has in
it, damping and activation; both are zero. Newton must be installed.
"""

from __future__ import annotations

import math
import sys
import time
import warnings

import newton
import newton_peer
import numpy as np
import warp as wp
from measure import Case, checked, copy_bandwidth, finish, machine, measure, parser, tell
from newton_peer import MOST_TETS, NAME, WRONG_POSITIONS, NewtonSteps
from peers import NOTES, printed, report_rows, step_cases
from problem import SUBTREE_LEVELS, Problem, oracle, relative_error
from stable import Steppable

import warp_corot as wc
import warp_corot.newton as wn

LEVELS = range(SUBTREE_LEVELS, 22)


def model(problem: Problem, as_forest: bool) -> newton.Model:
    builder = newton.ModelBuilder(up_axis=newton.Axis.Z, gravity=tuple(newton_peer.GRAVITY))
    material = problem.material
    if as_forest:
        wn.add_forest(builder, problem.mesh, material, fixed=problem.held, surface=False)
    else:
        mesh = wc.TetMesh(problem.mesh.points, problem.mesh.tets)
        wn.add_mesh(builder, mesh, material, fixed=problem.held, surface=False)
    return builder.finalize(device=problem.device)


def solver(of: newton.Model) -> wn.SolverCorotated:
    """One that takes any step, stable or not, as the search for the largest does."""
    return wn.SolverCorotated(of, stable_dt=1.0)


def force_case(problem: Problem, as_forest: bool) -> Case:
    of = model(problem, as_forest)
    tets, state = solver(of).tetrahedra, of.state()
    padded = np.zeros((problem.node_count, 4), np.float32)
    padded[:, :3] = problem.x
    x = wp.array(padded, dtype=wp.vec4, device=problem.device)
    f = wp.zeros_like(x)
    wp.copy(state.particle_q, wp.array(problem.x.astype(np.float32), dtype=wp.vec3, device=problem.device))

    def run() -> None:
        tets.add_forces(x, f, None)
        tets.add_damping_and_activation(state.particle_q, state.particle_qd, of.tet_activations, f)

    def error() -> float:
        f.zero_()
        run()
        reference = problem.sample.forces("corotated", problem.x, problem.mu, problem.lam)
        return relative_error(f.numpy()[problem.sample.nodes, :3], reference)

    name = f"ours in Newton, {'add_forest' if as_forest else 'add_mesh'}"
    return Case("whole force", name, run, error, problem.tet_count, wrong=WRONG_POSITIONS)


class OurNewtonSteps(NewtonSteps):
    """Steps of ``SolverCorotated``; what is not finite any more has moved infinitely far."""

    def __init__(self, problem: Problem, as_forest: bool):
        of = model(problem, as_forest)
        super().__init__("", problem, of, solver(of), oracle.corotated)
        self.name = f"ours in Newton, {'add_forest' if as_forest else 'add_mesh'}"
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


def steps(problem: Problem) -> list[Steppable]:
    ours: list[Steppable] = [OurNewtonSteps(problem, as_forest) for as_forest in (False, True)]
    return ours + newton_peer.steps(problem)


def main() -> int:
    of = parser(__doc__.split("\n\n")[0], "newton_steps.py")
    options = of.parse_args()
    given = options.level
    device = checked(options, of, LEVELS)
    options.level = (18 if device.is_cuda else 12) if given is None else given
    warnings.simplefilter("ignore", wc.StabilityWarning)
    start = time.perf_counter()
    about = machine(device) | {"level": options.level, "rounds": options.rounds, "peers": {"newton": NAME}}
    copy = about["copy_gb_per_s"] = copy_bandwidth(device)
    problem = Problem(options.level, device)
    print(f"{about['name']} ({device}), Warp {about['warp']}, {NAME}: {problem.tet_count} tetrahedra", flush=True)
    forces = [force_case(problem, as_forest) for as_forest in (False, True)] + [newton_peer.force_case(problem)]
    results = measure(forces, device, options.rounds, tell)
    results += measure(step_cases(problem, [sys.modules[__name__]]), device, options.rounds, tell)
    about["seconds"] = time.perf_counter() - start
    lines = report_rows(results, copy)
    print(printed(lines))
    print(NOTES)
    return finish(options, {"benchmark": "newton_steps", **about, "rows": lines}, results)


__all__ = ["MOST_TETS", "NAME", "steps"]

if __name__ == "__main__":
    sys.exit(main())
