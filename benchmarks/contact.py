#!/usr/bin/env python3
"""What contact adds to the time of a step: a cube rests, is pressed by a tool, and touches itself or another cube.

    python benchmarks/contact.py [--device cuda:0] [--level 14] [--steps 200] [--json FILE]

The cube has an edge of 0.1 m, 5 kPa and a held lower face. It is bisected to a level (98,304 elements at level 14), and
the step is given. Each row is the median of several runs of steps in one recorded launch, compared with the same cube
without contact in the same process. The script checks that the tool feels the tissue and that nothing passes through.
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
from measure import machine, number, table, tell

import warp_corot as wc

HEADER = ("scene", "elements", "near pairs", "contacts", "us a step", "steps/s", "/ without")
SIZE, ROUNDS = 0.1, 7
SOFT = wc.Isotropic(young=5e3, poisson=0.4, density=1000.0)
DOWN = (0.0, 0.0, -9.81)


def cube(level: int, device: wp.Device, origin: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> wc.SoftBody:
    """A cube of tissue."""
    return wc.SoftBody(wc.TetForest.box((1, 1, 1), SIZE, level, origin=origin), SOFT, device=device)


def held_cube(level: int, device: wp.Device) -> wc.SoftBody:
    """A cube held by its lower face."""
    body = cube(level, device)
    body.fix("z < 1e-9")
    return body


def alone(level: int, device: wp.Device) -> wc.Simulation:
    """No contact."""
    return wc.Simulation(held_cube(level, device), gravity=DOWN, integrator=wc.SymplecticEuler(dt=step(level, device)))


def step(level: int, device: wp.Device) -> float:
    """Half of the stable step at rest [s]."""
    return 0.5 * wc.Simulation(cube(level, device)).stable_dt


def on_ground(level: int, device: wp.Device) -> wc.Simulation:
    """The cube stands on the ground, free."""
    integrator = wc.SymplecticEuler(dt=step(level, device), damping=20.0)
    return wc.Simulation(cube(level, device), obstacles=wc.Ground(), gravity=DOWN, integrator=integrator)


def pressed(level: int, device: wp.Device, *, itself: bool = False) -> wc.Simulation:
    """A horizontal capsule presses into the upper face, by a tenth of the cube in 0.05 s."""
    tool = wc.Tool(wc.Capsule(radius=0.1 * SIZE, length=0.6 * SIZE))
    along_x = (0.0, np.sqrt(0.5), 0.0, np.sqrt(0.5))
    tool.follow([0.0, 0.05], [[0.5 * SIZE, 0.5 * SIZE, height * SIZE] for height in (1.11, 1.0)], along_x)
    return wc.Simulation(
        held_cube(level, device),
        obstacles=tool,
        gravity=DOWN,
        contact=wc.Contact(self_contact=itself),
        integrator=wc.SymplecticEuler(dt=step(level, device), damping=20.0),
    )


def stacked(level: int, device: wp.Device) -> wc.Simulation:
    """A cube on a cube."""
    bodies = [held_cube(level - 1, device), cube(level - 1, device, (0.0, 0.0, SIZE))]
    integrator = wc.SymplecticEuler(dt=step(level, device), damping=20.0)
    return wc.Simulation(bodies, gravity=DOWN, contact=wc.Contact(), integrator=integrator)


CROWDED = "a cube on a cube, ten times as many near pairs"
SCENES: dict[str, Callable[[int, wp.Device], wc.Simulation]] = {
    "on the ground": on_ground,
    "a tool presses": pressed,
    "a tool presses, self-contact": lambda level, device: pressed(level, device, itself=True),
    "a cube on a cube": stacked,
    CROWDED: stacked,
}


def near_pairs(sim: wc.Simulation) -> int:
    """The number of pairs that the last search found."""
    pairs = None if sim.contact is None else sim.contact.pairs
    return 0 if pairs is None else int(pairs.rows.total.numpy()[0])


def crowd(sim: wc.Simulation, until: float) -> None:
    """Search with wider margins until there are ten times as many near pairs as contacts: a million for 100,000."""
    sim.advance(until)
    search = sim.contact.search
    for _ in range(20):
        if near_pairs(sim) >= 10 * len(sim.contacts()):
            return
        search.watch.least.fill_(1.25 * float(search.watch.least.numpy()[0]))
        search.forget()
        sim.advance_steps(2)


def seconds_a_step(sim: wc.Simulation, steps: int, until: float) -> float:
    """Median time of a step [s] once there is contact."""
    sim.advance(until)
    taken = []
    for _ in range(ROUNDS):
        wp.synchronize_device(sim.device)
        started = time.perf_counter()
        sim.advance_steps(steps)
        wp.synchronize_device(sim.device)
        taken.append((time.perf_counter() - started) / steps)
    return float(np.median(taken))


def main() -> int:
    """Print the table."""
    of = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    of.add_argument("--device", help="cpu, cuda:0, … (default: Warp's)")
    of.add_argument("--level", type=int, default=14, help="level of the bisected cube")
    of.add_argument("--steps", type=int, default=200, help="steps that are timed together")
    of.add_argument("--json", type=Path, metavar="FILE", help="write everything to this file, too")
    options = of.parse_args()
    device = wp.get_device(options.device)
    about = machine(device)
    rows = []
    plain = alone(options.level, device)
    base = seconds_a_step(plain, options.steps, 0.02)
    rows.append(["no contact", len(plain.body.mesh.tets), 0, 0, 1e6 * base, 1.0 / base, 1.0])
    for name, scene in SCENES.items():
        tell(name)
        sim = scene(options.level, device)
        if name == CROWDED:
            crowd(sim, 0.1)
        taken = seconds_a_step(sim, options.steps, 0.1)
        elements = sum(len(body.mesh.tets) for body in sim.bodies)
        contacts = len(sim.contacts())
        rows.append([name, elements, near_pairs(sim), contacts, 1e6 * taken, 1.0 / taken, taken / base])
    print(f"{about['name']} ({device}), Warp {about['warp']}")
    cells = [[number(each) if isinstance(each, float) else str(each) for each in row] for row in rows]
    print(table(HEADER, cells, left=1))
    if options.json:
        options.json.write_text(json.dumps({**about, "rows": [dict(zip(HEADER, row, strict=True)) for row in rows]}))
    untouched = [row[0] for row in rows[1:] if not row[3]]
    if untouched:
        print(f"WRONG: nothing touches: {', '.join(untouched)}", file=sys.stderr)
    return 1 if untouched else 0


if __name__ == "__main__":
    sys.exit(main())
