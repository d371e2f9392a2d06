#!/usr/bin/env python3
"""Jitter and delay of the haptic loop while a hand presses and strokes a block of tissue.

    python benchmarks/haptics.py [--device cuda:0] [--level 9 | --elements 5000] [--seconds 10] [--json FILE]

A scripted hand moves a sphere of 2 cm in and out of a block of 4 x 4 x 2 cm, 3 mm deep, and around on it, at 1 kHz.
``--seconds`` is the wall time; 600 is ten minutes. ``--elements N`` takes the level with the number nearest to N. The
simulation publishes a state every 2 ms of simulated time, or as fast as it can. Periods above 1.5 ms are counted, and
apart those that the operating system took: in which the loop's thread or that of the simulation waited for a core for
as long as the period was beyond 1 ms (the run delay in /proc, on Linux). The script checks that the hand felt a force,
that the device did not fail, and that the energy put out stayed within the bound.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from dataclasses import asdict

import numpy as np
from measure import checked, machine, parser, save, tell

import warp_corot as wc

YOUNG, VISCOSITY = 2e4, 1e-3
RADIUS, TOP, DEPTH = 0.01, 0.02, 0.003
#: Presses and turns in a second [1/s], and keyframes in a second.
PRESSES, TURNS, KEYS = 0.7, 0.3, 100
BOUND = 1e-3
#: A period that counts as too long [s].
LONG = 1.5e-3


class WatchedDevice(wc.haptics.ScriptedDevice):
    """Also notes when it is read, and how long the loop's thread and the main one have waited for a core [s]."""

    def __init__(self, *keys):
        super().__init__(*keys)
        self.notes: list[tuple[float, float]] = []
        self._waits: list[int] = []

    def read(self):
        if not self._waits:
            for task in (threading.main_thread().native_id, threading.get_native_id()):
                path = f"/proc/self/task/{task}/schedstat"
                self._waits += [os.open(path, os.O_RDONLY)] if os.path.exists(path) else []
        waited = sum(int(os.pread(each, 64, 0).split()[1]) for each in self._waits)
        self.notes.append((time.perf_counter(), 1e-9 * waited))
        return super().read()

    def long_periods(self, period):
        """Periods above LONG: the number, the longest [s], and of those not taken by the system the same."""
        times, waited = np.diff(np.array(self.notes), axis=0).T
        long = times > LONG
        own = long & (waited < times - period)
        return int(long.sum()), float(times.max()), int(own.sum()), float(times[own].max(initial=0.0))


def main() -> int:
    of = parser(__doc__.split("\n")[0], "haptics.py")
    of.add_argument("--seconds", type=float, default=10.0, help="how long, on the wall (default: 10)")
    of.add_argument("--elements", type=int, help="about as many tetrahedra, in place of --level")
    of.add_argument("--rate", type=float, default=1000.0, help="readings per second (default: 1000)")
    options = of.parse_args()
    if not (options.seconds > 0.0 and options.rate > 0.0):
        of.error("--seconds and --rate must be positive")
    if options.elements is not None:
        options.level = round(float(np.log2(max(options.elements, 24) / 24.0)))
    elif options.level is None:
        options.level = 3
    device = checked(options, of, range(16))
    mesh = wc.TetForest.box((2, 2, 1), 0.02, options.level)
    body = wc.SoftBody(mesh, wc.Isotropic(YOUNG, 0.4, 1e3), device=device)
    body.fix("z == zmin")
    tool = wc.Tool(wc.Sphere(RADIUS, position=(0.02, 0.02, TOP + RADIUS)), speed=1.0)
    integrator = wc.SymplecticEuler(viscosity=VISCOSITY)
    sim = wc.Simulation(body, obstacles=[tool], gravity=(0, 0, 0), integrator=integrator)
    tell(f"{len(mesh.tets)} tetrahedra")
    hand = WatchedDevice(*stroke(options.seconds))
    loop = wc.haptics.HapticLoop(sim, tool, hand, rate=options.rate, energy_bound=BOUND)
    loop.connect()
    sim.advance(0.02)  # compiles and records
    with loop:
        share = loop.run(options.seconds)
    report = loop.report
    print(report)
    print(f"simulated  {share:.3g} times real time, {len(mesh.tets)} tetrahedra on {device}")
    count, longest, own, longest_own = hand.long_periods(loop.period)
    print(
        f"long       {count} periods above {1e3 * LONG:g} ms, the longest {1e3 * longest:.3g} ms; less those that the "
        f"system took {own}, {1e3 * longest_own:.3g} ms"
    )
    felt = hand.felt[:, 4:7] if len(hand.felt) else np.zeros((1, 3))
    print(f"force      {np.linalg.norm(felt, axis=1).max():.3g} N at most")
    wrong = []
    if not np.linalg.norm(felt, axis=1).max() > 0.0:
        wrong.append("no force was felt")
    if loop.error is not None:
        wrong.append(loop.error)
    if report.put_out > BOUND * (1.0 + options.seconds) and not report.beyond:
        wrong.append(f"{report.put_out:.3g} J were put out, beyond the bound")
    if options.json:
        save(
            options.json,
            {**machine(device), **asdict(report), "real_time": share, "long": count, "long_own": own, "wrong": wrong},
        )
    for each in wrong:
        print(f"WRONG: {each}", file=sys.stderr)
    return int(bool(wrong))


def stroke(seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Times and positions of the hand."""
    times = np.arange(0.0, seconds + 2.0 / KEYS, 1.0 / KEYS)
    depth = DEPTH * np.sin(np.pi * PRESSES * times) ** 2
    angle = 2.0 * np.pi * TURNS * times
    places = [0.02 + 0.005 * np.sin(angle), 0.02 + 0.005 * (1.0 - np.cos(angle)), TOP + RADIUS - depth]
    return times, np.stack(places, axis=1)


if __name__ == "__main__":
    sys.exit(main())
