#!/usr/bin/env python3
"""Other programs on the same mesh in the same process, and their times relative to this package.

    python benchmarks/peers.py [--device cuda:0] [--level 21] [--step-level 18] [--json FILE]

Rotations, whole forces, and whole time steps with the largest stable step. Peers that are not installed are left
out, with a note. Every timed result is checked against float64 in the same run.
"""

from __future__ import annotations

import argparse
import importlib
import math
import sys
import time
import warnings
from collections.abc import Sequence
from types import ModuleType
from typing import Any

import numpy as np
import stages
import warp as wp
from measure import (
    SAMPLE_SECONDS,
    WRONG,
    Case,
    Result,
    Stopwatch,
    checked,
    copy_bandwidth,
    finish,
    kind,
    machine,
    measure,
    number,
    parser,
    percent,
    table,
    tell,
)
from problem import SUBTREE_LEVELS, Problem, oracle, relative_error
from solver_cases import DAMPING, force_case, put_back, step_error
from stable import Steppable
from stage_cases import SVD_WRONG

import warp_corot as wc
from warp_corot.elasticity import Model
from warp_corot.elasticity.polar import rotation_function
from warp_corot.kernels.math.rotation import byers_xu, rotate_all

HEADER = ("stage", "variant", "ns/tet", "spread", "Gtet/s", "x ours", "error", "largest dt", "simulated s/s")

PEERS = {"newton": "newton_cases", "mujoco": "mujoco_peer"}

LEVELS = range(SUBTREE_LEVELS, 25)

GRAVITY = (0.0, 0.0, -9.81)

NOTES = """\
x ours: time over that of the stage's first row, round by round, median. Newton: particle contacts and triangles off.
error: largest error over largest value against float64, of the rotation, the force, or one step's displacement; of
MuJoCo's step, of its elastic force; of VBD and XPBD, how much of the implicit step's residual their iterations leave.
largest dt: found by trial, 100 steps from the jittered state under gravity, up to 1/60 s; simulated s/s with it."""


def peer(package: str) -> ModuleType | None:
    """The module for a peer; None, with a note, if it is not installed."""
    try:
        return importlib.import_module(PEERS[package])
    except ImportError as error:
        print(f"{package}: left out ({' '.join(str(error).split())})")
        return None


# --- rotations and forces ---------------------------------------------------------------------------------------------


def rotation_cases(count: int, device: wp.Device) -> list[Case]:
    """Matrices in, rotations out."""
    rng = np.random.default_rng(6)
    matrices = np.eye(3, dtype=np.float32) + rng.uniform(-0.1, 0.1, (count, 3, 3)).astype(np.float32)
    F = wp.array(matrices, dtype=wp.mat33, device=device)
    some = rng.integers(0, count, 2000)
    reference = oracle.polar(matrices[some].astype(float))

    def case(name: str, kernel: wp.Kernel, wrong: float = WRONG) -> Case:
        R = wp.zeros_like(F)

        def run() -> None:
            wp.launch(kernel, count, [F], [R], device=device)

        def error() -> float:
            run()
            return relative_error(R.numpy()[some], reference)

        return Case("rotation", name, run, error, count, 72.0, wrong=wrong)

    return [
        case("ours, Byers-Xu to tolerance", rotate_all(byers_xu)),
        case("ours, Byers-Xu, 4 iterations", rotate_all(rotation_function("byers-xu", 4))),
        case("Warp, svd3", stages.rotate_by_svd3, SVD_WRONG),
    ]


def force_cases(problem: Problem, newton: ModuleType | None) -> list[Case]:
    body, general = problem.body, problem.general_body
    shared = wc.Corotated(rotation_level=problem.level - SUBTREE_LEVELS).bind(body)
    cases = [
        force_case(problem, "ours, corotated, own rotations", body, wc.Corotated().bind(body), "corotated"),
        force_case(
            problem,
            "ours, corotated, rotations 3 up",
            body,
            shared,
            "corotated",
            R=lambda: problem.shared_rotations(SUBTREE_LEVELS),
        ),
        force_case(problem, "ours, corotated, general mesh", general, wc.Corotated().bind(general), "corotated"),
        force_case(problem, "ours, neo-Hookean", body, wc.NeoHookean().bind(body), "neo_hookean"),
        force_case(problem, "ours, neo-Hookean, general mesh", general, wc.NeoHookean().bind(general), "neo_hookean"),
    ]
    return cases if newton is None else cases + newton.force_cases(problem)


# --- steps ------------------------------------------------------------------------------------------------------------


class OurSteps(Steppable):
    """``Simulation`` from the problem's state."""

    def __init__(self, name: str, problem: Problem, model: Model, of: str, levels_up: int | None = None):
        self.name = f"ours, {name}"
        self.problem = problem
        self.model = model
        self.of = of
        self.levels_up = levels_up
        self.body = problem.new_body(problem.mesh)
        self.body.fix(problem.held)
        self.start = wp.clone(self.body.state.displacements)
        self.sim = self._simulation(None)

    @property
    def dt(self) -> float:
        return self.sim.dt

    @dt.setter
    def dt(self, value: float) -> None:
        if value != self.sim.dt:
            self.sim = self._simulation(value)

    def _simulation(self, dt: float | None) -> wc.Simulation:
        integrator = wc.SymplecticEuler(dt, DAMPING)
        return wc.Simulation(self.body, model=self.model, integrator=integrator, gravity=GRAVITY)

    def reset(self) -> None:
        put_back(self.body, self.start)

    def step(self, count: int) -> None:
        try:
            self.sim.advance_steps(count)
        except wc.UnstableError:
            # It must not be asked again, and its state shows what happened.
            self.sim = self._simulation(self.sim.dt)

    def largest_displacement(self) -> float:
        u = self.body.displacements.numpy()
        return float(np.abs(u).max()) if np.isfinite(u).all() else math.inf

    def error(self) -> float:
        problem = self.problem
        options = {} if self.levels_up is None else {"R": problem.shared_rotations(self.levels_up)}
        forces = problem.sample.forces(self.of, problem.x, problem.mu, problem.lam, **options)
        return step_error(self.sim, self.start, problem.sample, forces)


def our_steps(problem: Problem) -> list[Steppable]:
    up = SUBTREE_LEVELS
    shared = wc.Corotated(rotation_level=problem.level - up)
    return [
        OurSteps("corotated, own rotations", problem, wc.Corotated(), "corotated"),
        OurSteps("corotated, rotations 3 up", problem, shared, "corotated", up),
        OurSteps("neo-Hookean", problem, wc.NeoHookean(), "neo_hookean"),
    ]


def step_cases(problem: Problem, peers: Sequence[ModuleType], ours: bool = True) -> list[Case]:
    """Steps at four fifths of the largest stable one."""
    solvers = our_steps(problem)
    guess = solvers[0].dt
    solvers = solvers if ours else []
    for module in peers:
        if problem.tet_count > module.MOST_TETS:
            print(f"{module.NAME}: steps left out above {module.MOST_TETS} tetrahedra; try a lower --step-level")
            continue
        tell(f"building {module.NAME}'s model")
        solvers += module.steps(problem)
    return [_step_case(problem, solver, guess) for solver in solvers]


def _step_case(problem: Problem, solver: Steppable, guess: float) -> Case:
    tell(f"whole step: largest dt of {solver.name}")
    largest = solver.largest_stable_step(guess)
    solver.dt = 0.8 * (largest or guess)
    solver.reset()
    watch = Stopwatch(problem.device)
    solver.step(2)
    once = watch.seconds(lambda: solver.step(2)) / 2
    # An even number, since Newton's solvers swap two states.
    steps = 2 * max(1, min(32, math.ceil(SAMPLE_SECONDS[kind(problem.device)] / once / 2)))
    # Newton's solvers allocate while they step, which a graph on the CPU would not keep.
    recorded = None if problem.device.is_cuda and solver.recordable else False
    return Case(
        "whole step",
        solver.name,
        lambda: solver.step(steps),
        solver.error,
        problem.tet_count,
        repeats=steps,
        recorded=recorded,
        reset=solver.reset,
        wrong=solver.wrong,
        extra={"largest_dt": largest, "dt": solver.dt},
    )


# --- the report -------------------------------------------------------------------------------------------------------


def report_rows(results: Sequence[Result], copy_gb_s: float) -> list[dict[str, Any]]:
    first: dict[str, Result] = {}
    lines = []
    for r in results:
        ours = first.setdefault(r.case.stage, r)
        line = r.as_dict(copy_gb_s) | {"times_ours": r.relative_to(ours)}
        if "largest_dt" in line:
            line["simulated_s_per_s"] = line["largest_dt"] / (r.ns * 1e-9 * r.case.tets)
        lines.append(line)
    return lines


def printed(lines: Sequence[dict[str, Any]]) -> str:
    def dt(line: dict[str, Any]) -> str:
        return f"{1e3 * line['largest_dt']:.3g} ms" if "largest_dt" in line else "-"

    rows = [
        [
            d["stage"],
            d["variant"],
            number(d["ns_per_tet"]),
            percent(d["spread"]),
            number(d["gtet_per_s"]),
            number(d["times_ours"]),
            f"{d['error']:.1e}",
            dt(d),
            number(d.get("simulated_s_per_s")),
        ]
        for d in lines
    ]
    return table(HEADER, rows, 2)


def add_step_level(of: argparse.ArgumentParser) -> None:
    of.add_argument("--step-level", type=int, help="level for whole steps (default: 18 on CUDA, 12 on the CPU)")


def check_step_level(options: argparse.Namespace, of: argparse.ArgumentParser, device: wp.Device) -> None:
    if options.step_level is None:
        options.step_level = min(options.level, 18 if device.is_cuda else 12)
    if options.step_level not in LEVELS:
        of.error(f"--step-level is {options.step_level}; it must be from {LEVELS.start} to {LEVELS.stop - 1}")


def problems(options: argparse.Namespace, device: wp.Device) -> tuple[Problem, Problem]:
    """The problem for forces, and the one for steps."""
    tell(f"building level {options.level}")
    problem = Problem(options.level, device)
    return problem, problem if options.step_level == options.level else Problem(options.step_level, device)


def main() -> int:
    of = parser(__doc__.split("\n\n")[0], "peers.py")
    add_step_level(of)
    options = of.parse_args()
    device = checked(options, of, LEVELS)
    check_step_level(options, of, device)
    warnings.simplefilter("ignore", wc.StabilityWarning)
    start = time.perf_counter()
    about = machine(device)
    newton, mujoco = peer("newton"), peer("mujoco")
    copy = about["copy_gb_per_s"] = copy_bandwidth(device)
    problem, stepping = problems(options, device)
    about |= {"level": options.level, "step_level": options.step_level, "rounds": options.rounds}
    about["peers"] = {m.__name__: m.NAME for m in (newton, mujoco) if m is not None}
    print(f"{about['name']} ({device}), Warp {about['warp']}: rotations and forces at level {options.level}, ", end="")
    print(f"{problem.tet_count} tetrahedra, steps at level {options.step_level}, {stepping.tet_count}", flush=True)
    results = measure(rotation_cases(problem.tet_count, device), device, options.rounds, tell)
    results += measure(force_cases(problem, newton), device, options.rounds, tell)
    results += measure(
        step_cases(stepping, [m for m in (newton, mujoco) if m is not None]), device, options.rounds, tell
    )
    about["seconds"] = time.perf_counter() - start
    lines = report_rows(results, copy)
    tell("")
    print(printed(lines))
    print(NOTES)
    return finish(options, {"benchmark": "peers", **about, "rows": lines}, results)


if __name__ == "__main__":
    sys.exit(main())
