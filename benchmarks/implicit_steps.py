#!/usr/bin/env python3
"""Time of implicit steps of a swinging beam, and how well they are solved.

    python benchmarks/implicit_steps.py [--device cuda:0] [--levels 6 9] [--dt 0.01] [--tolerances 1e-2 1e-4]
                                        [--dilatation element] [--json FILE]

The paper's beam, 64 x 64 x 192 mm, 50 kPa, Poisson's ratio 0.45, 1000 kg/m^3, is clamped at one end and falls under its
weight from rest, by backward Euler with one linear solve a step. The last 0.42 of 0.7 s are timed. The error compares
the sag of the end at five times with that of solves to 1e-6: the largest difference over the largest sag. On the CPU
the process's own time counts, so that other programs disturb less.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import paper_beam as paper
import warp as wp
from measure import Parser, machine, number, save, table, tell

import warp_corot as wc
from warp_corot.inputs.checks import checked_device

#: The time is divided into parts [s]. The first ones record the steps and are not timed.
PART, WARM_UP, PARTS = 0.14, 2, 5
TIGHT = 1e-6
HEADER = ("elements", "tolerance", "iterations a step", "set-ups", "ms/step", "ns/element", "error")


@dataclass
class Row:
    """A run; ``error`` is relative."""

    elements: int
    tolerance: float
    iterations: float
    setups: int
    seconds: float
    error: float

    def cells(self) -> list[str]:
        shown = [str(self.elements), f"{self.tolerance:.0e}", number(self.iterations), str(self.setups)]
        per_element = number(1e9 * self.seconds / self.elements)
        return [*shown, number(1e3 * self.seconds), per_element, f"{self.error:.0e}"]


def run(level: int, tolerance: float, options: argparse.Namespace, device: wp.Device) -> tuple[Row, np.ndarray]:
    """Run the beam; returns the row, and the sag of the end at five times [m]."""
    mesh = wc.TetForest.box(paper.CELLS, paper.CELL_SIZE, level)
    body = wc.SoftBody(mesh, wc.Isotropic(50e3, 0.45, 1000.0), device=device)
    body.fix(mesh.points[:, 2] < 1e-9)
    integrator = wc.BackwardEuler(dt=options.dt, linear_tolerance=tolerance)
    model = wc.Corotated(dilatation=options.dilatation)
    sim = wc.Simulation(body, model=model, integrator=integrator, gravity=(0.0, -9.81, 0.0))
    clock = time.process_time if device.is_cpu else time.perf_counter
    count, seconds = max(round(PART / options.dt), 1), 0.0
    ends, begun = [], sim.solves
    for part in range(PARTS):
        if part == WARM_UP:
            begun, seconds = sim.solves, 0.0
        began = clock()
        sim.advance_steps(count)
        wp.synchronize_device(device)
        seconds += clock() - began
        ends.append(float(body.displacements.numpy()[:, 1].min()))
    solves = sim.solves
    assert solves is not None
    assert begun is not None
    steps = solves.steps - begun.steps
    kept = sim.kept.get("setup.0.counts")
    setups = 0 if kept is None else int(kept.numpy()[0])
    iterations = (solves.linear_iterations - begun.linear_iterations) / steps
    return Row(len(mesh.tets), tolerance, iterations, setups, seconds / steps, 0.0), np.array(ends)


def rows(options: argparse.Namespace, device: wp.Device) -> Iterator[Row]:
    for level in options.levels:
        _, reference = run(level, TIGHT, options, device)
        for tolerance in options.tolerances:
            tell(f"level {level}, tolerance {tolerance}")
            best = None
            for _ in range(options.repeats):
                row, ends = run(level, tolerance, options, device)
                row.error = float(np.abs(ends - reference).max() / np.abs(reference).max())
                best = row if best is None or row.seconds < best.seconds else best
            assert best is not None
            yield best


def main() -> int:
    of = Parser(prog="implicit_steps.py", description="Time of implicit steps of a swinging beam.")
    of.add_argument("--device", help="cpu, cuda:0, … (default: Warp's)")
    of.add_argument("--levels", type=int, nargs="+", default=[6, 9], help="3 to 21 (default: 6 9)")
    of.add_argument("--dt", type=float, default=0.01, help="step [s] (default: 0.01)")
    of.add_argument("--tolerances", type=float, nargs="+", default=[1e-2, 1e-4], help="of linear solves")
    of.add_argument("--dilatation", default="element", choices=["element", "shared"], help="of the law")
    of.add_argument("--repeats", type=int, default=3, help="how often to run; the fastest run counts (default: 3)")
    of.add_argument("--json", type=Path, metavar="FILE", help="write everything to this file, too")
    options = of.parse_args()
    if not all(3 <= level <= 21 for level in options.levels):
        of.error(f"--levels is {options.levels}; levels must be from 3 to 21")
    if not all(0.0 < tolerance < 1.0 for tolerance in options.tolerances):
        of.error(f"--tolerances is {options.tolerances}; they must be between 0 and 1")
    if not 0.0 < options.dt <= 0.05 or options.repeats < 1:
        of.error(f"--dt is {options.dt} and --repeats {options.repeats}; a step of up to 0.05 s, and one run at least")
    wp.config.log_level = wp.LOG_ERROR
    device = checked_device(options.device)
    found = list(rows(options, device))
    print(table(HEADER, [row.cells() for row in found], left=0))
    if options.json is not None:
        save(options.json, machine(device) | {"dt": options.dt, "rows": [asdict(row) for row in found]})
    wrong = [row for row in found if not np.isfinite(row.error) or row.error > 10.0 * row.tolerance]
    for row in wrong:
        print(f"WRONG: {row.elements} elements, {row.tolerance}: error {row.error:.1e}", file=sys.stderr)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
