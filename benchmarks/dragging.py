#!/usr/bin/env python3
"""Cost of holding, moving, loading and releasing a patch of a body between steps, like a hand that drags tissue.

    python benchmarks/dragging.py [--device cuda:0] [--level 21] [--json FILE]

The body is one root cube, bisected uniformly to several levels up to the given one. The patch is a part of its top with
about a thousand nodes, whatever the size of the body. Times are the host's, until the call returns; on CUDA the device
may still be working then. ``with a step`` is the time of the change, one step and the wait for both; ``step alone`` is
the same without the change. The script checks that the patch is in the prescribed place, and that no step was recorded
again.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import numpy as np
import warp as wp
from measure import checked, machine, number, parser, save, table, tell

import warp_corot as wc

LEVELS = (9, 12, 15, 18)
HEADER = ("change", "nodes of the body", "of the patch", "ms", "with a step, ms", "step alone, ms")
PATCH = 1000
ROUNDS = 30


def main() -> int:
    of = parser(__doc__.split("\n")[0], "dragging.py")
    options = of.parse_args()
    device = checked(options, of, range(6, 28))
    rows, wrong = [], []
    for level in [each for each in LEVELS if each < options.level] + [options.level]:
        tell(f"level {level}")
        rows += measured(level, device, wrong)
    print(
        table(HEADER, [[str(each) if not isinstance(each, float) else number(each) for each in row] for row in rows], 1)
    )
    if options.json:
        save(options.json, {**machine(device), "rows": rows, "wrong": wrong})
    for each in wrong:
        print(f"WRONG: {each}", file=sys.stderr)
    return int(bool(wrong))


def measured(level: int, device: wp.Device, wrong: list[str]) -> list[tuple]:
    """A row for each kind of change of a body of this level."""
    mesh = wc.TetForest.box((1, 1, 1), 1.0, level)
    body = wc.SoftBody(mesh, wc.Isotropic(1e4, 0.3, 1e3), device=device)
    body.fix(mesh.points[:, 2] == 0.0)
    top = np.flatnonzero(mesh.points[:, 2] == 1.0)
    patch = top[np.argsort(np.linalg.norm(mesh.points[top] - [0.5, 0.5, 1.0], axis=1))[:PATCH]]
    sim = wc.Simulation(body, integrator=wc.SymplecticEuler(dt=0.2 * wc.Simulation(body).stable_dt))
    body.load(patch, [0.0, 0.0, 0.0])
    body.prescribe(patch, times=[0.0, 1.0], displacements=np.zeros((2, 3)))
    force = 1e-4 * np.random.default_rng(0).standard_normal((len(patch), 3))
    on_device = wp.array(force, dtype=wp.vec3, device=device)
    changes: dict[str, Callable[[int], None]] = {
        "follow keyframes": lambda k: body.prescribe(patch, times=[0.0, 1.0 + k], displacements=np.zeros((2, 3))),
        "prescribe a velocity": lambda k: body.prescribe(patch, velocity=[0.0, 0.0, 1e-4 * k]),
        "load": lambda k: body.load(patch, force),
        "load, forces on the device": lambda k: body.load(patch, on_device),
        "fix": lambda k: body.fix(patch),
        "release": lambda k: body.release(patch),
    }
    rows = []
    for name, change in changes.items():
        change(0)
        sim.advance_steps(2)
        revision = body.launch_revision
        alone = median(lambda k: None, change, device)
        with_step = median(lambda k: sim.step(), change, device)
        step = median(lambda k: sim.step(), lambda k: None, device)
        rows.append((name, body.node_count, len(patch), 1e3 * alone[0], 1e3 * with_step[1], 1e3 * step[1]))
        if body.launch_revision != revision:
            wrong.append(f"{name} at level {level} had steps recorded again")
        if body.constrained[patch].all() != (name != "release"):
            wrong.append(f"{name} at level {level} left the patch in a wrong place")
    return rows


def median(then: Callable[[int], None], change: Callable[[int], None], device: wp.Device) -> tuple[float, float]:
    """Median times [s]: until a change returns, and until the device has finished it and the following work."""
    returned, done = [], []
    for k in range(1, ROUNDS + 1):
        wp.synchronize_device(device)
        started = time.perf_counter()
        change(k)
        returned.append(time.perf_counter() - started)
        then(k)
        wp.synchronize_device(device)
        done.append(time.perf_counter() - started)
    return float(np.median(returned)), float(np.median(done))


if __name__ == "__main__":
    sys.exit(main())
