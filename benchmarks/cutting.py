#!/usr/bin/env python3
"""Time of a blade step over the size of a body.

    python benchmarks/cutting.py [--device cuda:0] [--sizes 20000 100000 1000000] [--json FILE]

A blade goes down through the middle of a box. A *blade step* is what follows when a cut is due: the search for what the
blade has swept, the cut, all that is derived from the mesh, and the host's part; the table has its median and its 90th
percentile, how often it is due, and what a step of the same body costs with and without the blade. It also says how
long it takes to record steps again after a cut, and how much longer steps take after cuts than those of a body that was
made of the same elements. The script checks that the box is in two pieces in the end.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import warp as wp

import warp_corot as wc

#: Boxes with about that many elements: cubes along each axis, and the level.
BOXES = {20_000: ((3, 3, 3), 7), 100_000: ((4, 2, 2), 10), 1_000_000: ((5, 2, 2), 13)}
CELL = 0.04
#: Share of the height through which the blade goes while time is taken.
SHARE = 0.5


def scene(size: int, device: str, *, cuts: bool, contact: bool = False) -> wc.Simulation:
    cells, level = BOXES[size]
    mesh = wc.TetForest.box(cells, CELL, level)
    body = wc.SoftBody(mesh, wc.Isotropic(3e4, 0.4, 1000.0, toughness=3.0), device=device)
    body.fix("x == xmin or x == xmax")
    x, y, z = CELL * np.array(cells)
    blade = wc.Blade([(0, 0, -0.01), (0, 0, z + 0.01)], position=(0.52 * x, y + 0.003, 0.0))
    blade.follow([0.0, 0.4], [(0.52 * x, y + 0.003, 0.0), (0.52 * x, -0.01, 0.0)])
    steps = wc.SymplecticEuler(damping=10.0)
    return wc.Simulation(body, gravity=(0, 0, 0), integrator=steps, cuts=[blade] if cuts else None)


def now(device: wp.Device) -> float:
    """Seconds of a clock once the device is ready; on the CPU, of the time that the process has a core."""
    wp.synchronize_device(device)
    return time.process_time() if device.is_cpu else time.perf_counter()


class Timed:
    """A function that keeps the time of each call [s]."""

    def __init__(self, called: Callable[..., object], device: wp.Device):
        self.called, self.device, self.seconds = called, device, []

    def __call__(self, *arguments: object, **options: object) -> object:
        begin = now(self.device)
        found = self.called(*arguments, **options)
        self.seconds.append(now(self.device) - begin)
        return found


def measured(size: int, device: str) -> dict[str, float]:
    sim = scene(size, device, cuts=True)
    plain = scene(size, device, cuts=False)
    assert sim.blades is not None
    height = CELL * BOXES[size][0][1]
    # The blade is in the tissue, and everything is compiled and recorded.
    sim.advance(0.4 * (0.003 + 0.2 * height) / (height + 0.013))
    plain.advance_steps(2 * plain.recorded.interval)
    follow = sim.follow_motion = Timed(sim.follow_motion, sim.device)
    replay = sim.recorded.replay = Timed(sim.recorded.replay, sim.device)
    find = sim._find_stable_steps = Timed(sim._find_stable_steps, sim.device)
    steps = sim.steps
    begin = now(sim.device)
    sim.advance(0.4 * SHARE * height / (height + 0.013))
    whole = now(sim.device) - begin
    steps = sim.steps - steps
    begin = now(sim.device)
    plain.advance_steps(max(min(steps, 512), plain.recorded.interval))
    alone = (now(sim.device) - begin) / max(min(steps, 512), plain.recorded.interval)
    row = {
        "elements": len(plain.body.mesh.tets),
        "steps": steps,
        "every": sim.blades.every,
        "cuts": len(follow.seconds),
        "median": float(np.median(follow.seconds)),
        "tenth": float(np.quantile(follow.seconds, 0.9)),
        "step": whole / steps,
        "replay": sum(replay.seconds) / steps,
        "find": sum(find.seconds),
        "finds": len(find.seconds),
        "plain": alone,
    }
    sim.advance_until(0.42)
    if sim.body.pieces != 2:
        raise SystemExit(f"the body of {row['elements']} elements is in {sim.body.pieces} pieces")
    return row


def after(size: int, device: str, repeats: int = 9) -> dict[str, float]:
    """Seconds of a step after three planes have cut a box, and of a body that was made of the same elements."""
    sim = scene(size, device, cuts=False)
    centre = 0.5 * CELL * np.array(BOXES[size][0])
    for normal in ((1.0, 0.2, 0.1), (0.1, 1.0, 0.2), (0.1, -0.2, 1.0)):
        sim.cut(wc.Plane(normal, point=centre))
    other = wc.SoftBody(sim.body.mesh, sim.body.material, device=device)
    other.fix(sim.body.constrained)
    precut = wc.Simulation(other, gravity=(0, 0, 0), integrator=wc.SymplecticEuler(damping=10.0))
    each = max(64, sim.recorded.interval)
    seconds = np.zeros((repeats + 1, 2))
    for repeat in range(repeats + 1):  # the first ones compile and record
        for k, one in enumerate((sim, precut)):
            begin = now(one.device)
            one.advance_steps(each)
            seconds[repeat, k] = (now(one.device) - begin) / each
    cut, whole = np.median(seconds[1:], axis=0)
    return {"pieces": sim.body.pieces, "after": cut, "precut": whole}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", default=None, help="cpu or cuda:0")
    parser.add_argument("--sizes", type=int, nargs="+", choices=BOXES, default=list(BOXES), help="numbers of elements")
    parser.add_argument("--json", help="file for the numbers")
    args = parser.parse_args()
    wp.config.quiet, wp.config.enable_backward = True, False
    device = str(wp.get_device(args.device))
    rows = []
    print(f"{'elements':>9} {'steps a cut':>11} {'cuts':>5} {'blade step':>11} {'90 %':>9} {'step with':>10} "
          f"{'of it steps':>11} {'step without':>12} {'searches for dt':>16}   [ms] on {device}")  # fmt: skip
    for size in args.sizes:
        row = measured(size, device) | after(size, device)
        rows.append(row)
        ms = {name: 1e3 * row[name] for name in ("median", "tenth", "step", "replay", "plain", "find")}
        print(f"{row['elements']:>9} {row['every']:>11} {row['cuts']:>5} {ms['median']:>11.2f} {ms['tenth']:>9.2f} "
              f"{ms['step']:>10.3f} {ms['replay']:>11.3f} {ms['plain']:>12.3f} "
              f"{row['finds']:>7} x {ms['find'] / max(row['finds'], 1):6.1f}", flush=True)  # fmt: skip
        print(f"{'':>9} in {row['pieces']} pieces a step takes {1e3 * row['after']:.3f} ms, "
              f"{row['after'] / row['precut']:.2f} times that of a body of these elements", flush=True)  # fmt: skip
    if args.json:
        Path(args.json).write_text(json.dumps(rows, indent=1))
    sys.exit(0)


if __name__ == "__main__":
    main()
