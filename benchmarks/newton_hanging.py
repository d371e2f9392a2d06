#!/usr/bin/env python3
"""Newton's example ``softbody_hanging`` with the line of its solver changed, beside the original (VBD, 10 iterations).

    python benchmarks/newton_hanging.py [--frames 60] [--device cpu]

Each solver has its own copy of the scene: 4 grids of 960 tetrahedra, 10 steps a frame of 1/60 s. All run in one
process and alternate frame by frame, so that a busy machine slows all of them alike. Medians leave out the first ten
frames. The last row makes one step a frame, which takes one more changed line.
"""

from __future__ import annotations

import argparse
import sys
import time
from typing import Any

import newton
import newton.examples
import newton.examples.softbody.example_softbody_hanging as hanging
import numpy as np
import warp as wp
from measure import machine, table

from warp_corot.newton import SolverCorotated

SKIPPED = 10


def scene(device: str, steps: int = 10, **options: Any) -> hanging.Example:
    """The example with this many steps a frame; with options, with this package's solver."""
    original = newton.solvers.SolverVBD
    if options:
        newton.solvers.SolverVBD = lambda model, **_: SolverCorotated(model, **options)
    try:
        with wp.ScopedDevice(device):
            parser = newton.examples.create_parser()
            args = parser.parse_args(["--viewer", "null", "--device", device, "--quiet"])
            args.solver = "vbd"
            example = hanging.Example(newton.viewer.ViewerNull(), args)
            example.sim_substeps, example.sim_dt = steps, example.frame_dt / steps
            example.capture()
            return example
    finally:
        newton.solvers.SolverVBD = original


def main() -> int:
    of = argparse.ArgumentParser(description=__doc__.split("\n")[0], prog="newton_hanging.py")
    of.add_argument("--frames", type=int, default=60)
    of.add_argument("--device", default="cpu")
    options = of.parse_args()
    scenes = {
        "SolverVBD, as in the example": scene(options.device),
        "SolverCorotated(model)": scene(options.device, integrator="explicit"),
        'SolverCorotated(model, integrator="implicit")': scene(options.device, integrator="implicit"),
        "the same, sim_substeps = 1": scene(options.device, 1, integrator="implicit"),
    }
    times: dict[str, list[float]] = {name: [] for name in scenes}
    for _ in range(options.frames):
        for name, example in scenes.items():
            with wp.ScopedDevice(options.device):
                wp.synchronize_device()
                started = time.perf_counter()
                example.step()
                wp.synchronize_device()
                times[name].append(time.perf_counter() - started)
    medians = {name: float(np.median(each[SKIPPED:])) for name, each in times.items()}
    most = next(iter(medians.values()))
    rows = []
    for name, example in scenes.items():
        low = float(example.state_0.particle_q.numpy()[:, 2].min())
        rows.append([name, f"{1e3 * medians[name]:.1f}", f"{most / medians[name]:.1f}", f"{low:.3f}"])
    print(", ".join(str(value) for value in machine(wp.get_device(options.device)).values()))
    print(table(["solver", "ms a frame", "times as fast", "lowest node, m"], rows, 1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
