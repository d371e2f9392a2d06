#!/usr/bin/env python3
"""Steps a second of the environments for learning, and how the policies by hand do on finer bodies and implicit steps.

    python benchmarks/envs.py [--device cuda:0] [--tasks Lift,Reach] [--worlds 1024,4096] [--steps 200]
        [--episodes 100] [--json FILE]

The first table has environment steps a second: a step of one world, 1/50 s, with tools, contact, forces,
observations, rewards and the beginnings of new episodes. Actions are drawn at random on the device before, and
nothing is copied to the host. The second table has how many of so many episodes, one for each world and seed, the
policy by hand ends with success, for each mesh and kind of steps. The environments are those that users make; see
docs/envs.md.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from measure import machine, number, save, table, tell

from warp_corot import envs
from warp_corot.inputs.checks import checked_device

#: Cubes along each edge of the bodies over the tasks' own, and the steps on which policies are tried.
BODIES = ((1, "explicit"), (1, "implicit"), (2, "explicit"), (2, "implicit"))
#: The first seed, as in the tables of docs/envs.md.
SEED = 1000


def steps_a_second(kind: type[envs.SoftEnv], worlds: int, steps: int, device: str, **options: Any) -> dict[str, Any]:
    """A row of the first table."""
    env = kind(worlds, array="warp", device=device, **options)
    draws = np.random.default_rng(0).uniform(-1.0, 1.0, (16, worlds, env.task.actions))
    actions = [wp.array(each, dtype=wp.float32, device=device) for each in draws]
    env.reset(seed=0)

    def run(count: int) -> float:
        wp.synchronize_device(device)
        start = time.perf_counter()
        for k in range(count):
            env.step(actions[k % len(actions)])
        wp.synchronize_device(device)
        return time.perf_counter() - start

    run(10)
    took = min(run(steps) for _ in range(3))
    row = {"task": kind.__name__, "worlds": worlds, "elements": len(env.scene.mesh.tets), "substeps": env.substeps}
    return row | options | {"rate": worlds * steps / took}


def successes(kind: type[envs.SoftEnv], cells: int, integrator: str, episodes: int, device: str) -> dict[str, Any]:
    """A row of the second table."""
    env = kind(episodes, cells=cells, integrator=integrator, device=device)
    observations, _ = env.reset(seed=SEED)
    succeeded, over = np.zeros(episodes, bool), np.zeros(episodes, bool)
    while not over.all():
        observations, _, terminated, truncated, info = env.step(env.scripted_actions(observations))
        succeeded |= info["success"] & ~over
        over |= terminated | truncated
    row = {"task": kind.__name__, "elements": len(env.scene.mesh.tets), "integrator": integrator}
    return row | {"succeeded": int(succeeded.sum()), "episodes": episodes}


def main() -> int:
    of = argparse.ArgumentParser(description=__doc__.split("\n")[0], prog="envs.py")
    of.add_argument("--device", help="cpu, cuda:0, … (default: Warp's)")
    kinds = [kind.__name__ for kind in envs.TASKS.values() if kind is not envs.FrankaLift]
    of.add_argument("--tasks", default=",".join(kinds), help="all but FrankaLift, which needs the extra robots")
    of.add_argument("--worlds", default="1024,4096")
    of.add_argument("--steps", type=int, default=200, help="steps of each world that are timed, three times")
    of.add_argument("--episodes", type=int, default=100, help="0: leave the second table out")
    of.add_argument("--json", type=Path, metavar="FILE", help="write everything to this file, too")
    options = of.parse_args()
    device = str(checked_device(options.device))
    kinds = [getattr(envs, name) for name in options.tasks.split(",")]
    report: dict[str, Any] = {"machine": machine(wp.get_device(device)), "rates": [], "successes": []}
    for kind, worlds, same in itertools.product(kinds, map(int, options.worlds.split(",")), (True, False)):
        row = steps_a_second(kind, worlds, options.steps, device, deterministic=same)
        tell(f"{row}")
        report["rates"].append(row)
    for kind, (cells, integrator) in itertools.product(kinds, BODIES if options.episodes else ()):
        row = successes(kind, cells, integrator, options.episodes, device)
        tell(f"{row}")
        report["successes"].append(row)
    header = ("task", "worlds", "elements", "steps in a step", "deterministic", "steps a second")
    rates = [[str(v) for v in list(row.values())[:-1]] + [number(row["rate"])] for row in report["rates"]]
    print(table(header, rates, 1))
    if report["successes"]:
        print(
            table(
                ("task", "elements", "steps", "succeeded", "of"),
                [list(map(str, r.values())) for r in report["successes"]],
                1,
            )
        )
    if options.json:
        save(options.json, report)
    return 0


if __name__ == "__main__":
    sys.exit(main())
