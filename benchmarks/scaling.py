#!/usr/bin/env python3
"""Weak and strong scaling of one body over ranks, and a model that predicts other numbers of ranks.

    python benchmarks/scaling.py [--device cuda] [--ranks 1,2] [--weak 18,21] [--strong 21] [--json FILE]

Without options it measures 1, 2, 4, ... ranks, up to all cards, or up to all cores if there are none. The script starts
``mpirun`` for each number of ranks. It needs this package, mpi4py and MPI, and nccl4py for cards.
Weak scaling has one root cube of the given level on each rank. Strong scaling divides as many cubes as the largest
number of ranks among all ranks. Levels are those of ``TetForest.box``: a cube has 1.6 million tetrahedra at level 18,
12.6 million at 21, 100 million at 24.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import statistics
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

#: Steps in one measurement, on a card and on a CPU; number of measurements; and number of exchanges timed by
#: themselves, which are one graph on cards.
STEPS, CPU_STEPS, ROUNDS, EXCHANGES = 512, 32, 7, 50
#: Calls before the measurements go on until two agree to this fraction of their time; the most calls.
AGREEMENT, MOST_CALLS = 0.03, 12
#: Assumptions about a network between machines: the time of an exchange without data [us], and bytes per microsecond.
NETWORK_LATENCY, NETWORK_RATE = 15.0, 40e3
#: Levels of the cubes of weak and strong scaling that are measured by default, on a card and on a CPU.
LEVELS, CPU_LEVELS = ("18,21", "21"), ("12", "12")
#: A step far below every stable one [s]; its cost does not depend on its length.
SHORT_STEP = 1e-7


def measured(cubes: int, level: int, device: str) -> dict[str, Any]:
    """One rank's measurements of a row of root cubes, bisected to a level; all ranks must call this."""
    import warp as wp

    wp.config.quiet = True
    import warp_corot as wc
    import warp_corot.distributed as wd

    began = time.perf_counter()
    mesh = wd.box((1, 1, cubes), 0.1, level=level)
    body = wc.SoftBody(mesh, wc.Isotropic(5e3, 0.4, 1000.0), device=device)
    edge = 0.1 * 0.5 ** (level // 3)
    body.displacements = np.random.default_rng(20130705).uniform(-0.05 * edge, 0.05 * edge, mesh.points.shape)
    sim = wd.Simulation(body, integrator=wc.SymplecticEuler(dt=SHORT_STEP), gravity=(0, 0, 0))
    ready = time.perf_counter() - began

    def timed() -> float:
        """Time of a step [s]."""
        steps = STEPS if sim.device.is_cuda else CPU_STEPS
        began = time.perf_counter()
        sim.advance_steps(steps)
        return (time.perf_counter() - began) / steps

    before = timed()
    for _ in range(MOST_CALLS if sim.device.is_cuda else 1):
        # All ranks go on or stop together.
        last = sum(sim.comm.allgather(timed())) / sim.size
        if abs(last - before) <= AGREEMENT * last:
            break
        before = last
    seconds = [timed() for _ in range(ROUNDS)]
    computed, copied = sim.elements_here
    return {
        "step_us": 1e6 * statistics.median(seconds),
        "spread": (max(seconds) - min(seconds)) / statistics.median(seconds),
        "exchange_us": 1e6 * exchange_seconds(sim),
        "sent_bytes": sum(each.sent_bytes for each in sim.ranks.lists),
        "elements": mesh.element_count,
        "computed": computed,
        "copied": copied,
        "ready_s": ready,
        "memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "device": sim.device.name,
        "rank": sim.rank,
        "ranks": sim.size,
    }


def exchange_seconds(sim: Any) -> float:
    """The mean time of one exchange of displacements alone, of ``EXCHANGES`` in a row, which cards record [s]."""
    import warp as wp

    values = [wp.zeros_like(part.state.displacements) for part in sim.parts]

    def exchange() -> None:
        for _ in range(EXCHANGES):
            for k, each in enumerate(values):
                sim.ranks.exchange(k, each)

    made = exchange
    if sim.device.is_cuda:
        exchange()
        with wp.ScopedCapture(device=sim.device) as capture:
            exchange()
        made = partial(wp.capture_launch, capture.graph)
    times = []
    for _ in range(ROUNDS):
        wp.synchronize_device(sim.device)
        sim.comm.Barrier()
        began = time.perf_counter()
        made()
        wp.synchronize_device(sim.device)
        times.append(time.perf_counter() - began)
    return statistics.median(times) / EXCHANGES


def on_ranks(ranks: int, cubes: int, level: int, device: str) -> dict[str, Any]:
    """The slowest rank's measurements of a run on this number of ranks.

    Raises:
        RuntimeError: The run failed.
    """
    beside = Path(sys.executable).with_name("mpirun")
    mpirun = str(beside) if beside.exists() else shutil.which("mpirun")
    if mpirun is None:
        raise RuntimeError('there is no mpirun; pip install "warp-corot[distributed]"')
    start = [mpirun, "--oversubscribe", "--allow-run-as-root", "--bind-to", "none", "-n", str(ranks), sys.executable]
    asked = ["--worker", str(cubes), "--level", str(level), "--device", device]
    done = subprocess.run([*start, __file__, *asked], capture_output=True, text=True, check=False)
    rows = [json.loads(line[4:]) for line in done.stdout.splitlines() if line.startswith("ROW ")]
    if done.returncode or len(rows) != ranks:
        said = [line for line in done.stderr.splitlines() if line.startswith(("warp-corot:", "Error", "warp_corot."))]
        raise RuntimeError(f"{ranks} ranks, level {level}: {said[0] if said else done.stderr.strip()[-2000:]}")
    slowest = max(rows, key=lambda row: row["step_us"])
    return slowest | {"level": level, **{name: max(row[name] for row in rows) for name in ("computed", "memory_mb")}}


def fitted(rows: list[dict[str, Any]]) -> dict[str, float]:
    """The parameters of a model of a step's time [us], by non-negative least squares of relative errors.

    A step on one rank takes start + per_element * computed. An exchange by itself takes latency + per_byte * sent. A
    step on several ranks takes as long as its elements would on one rank, plus the fraction ``exposed`` of the
    exchange.
    """
    from scipy.optimize import nnls

    alone = [row for row in rows if row["ranks"] == 1]
    several = [row for row in rows if row["ranks"] > 1]
    found: dict[str, float] = {}
    for names, key, value, chosen in (
        (("start", "per_element"), "computed", "step_us", alone),
        (("latency", "per_byte"), "sent_bytes", "exchange_us", several),
    ):
        if chosen:
            system = np.array([[1.0, row[key]] for row in chosen])
            weight = 1.0 / np.array([row[value] for row in chosen])
            solution, _ = nnls(system * weight[:, None], np.ones(len(chosen)))
            found |= dict(zip(names, solution.tolist(), strict=True))
    if {"start", "latency"} <= found.keys():
        more = [row["step_us"] - found["start"] - found["per_element"] * row["computed"] for row in several]
        exchanges = [row["exchange_us"] for row in several]
        weight = np.array([1.0 / row["step_us"] for row in several])
        slope = np.sum(np.array(more) * exchanges * weight**2) / np.sum(np.square(exchanges) * weight**2)
        found["exposed"] = max(float(slope), 0.0)
    return found


def predicted(model: dict[str, float], ranks: int, level: int, *, machines: int = 1) -> dict[str, float]:
    """The model's prediction of weak scaling, with a cube of the level on each rank, and neighbours on two sides.

    With several machines, exchanges between them take the time assumed for a network. The part that is longer than the
    computation of the elements cannot be hidden.
    """
    elements = 6 * 2**level
    # The number of nodes on a cut through a cube with an edge of 2^(level/3) cells; copies lie on it in layers.
    nodes = (2.0 ** (level / 3) + 1.0) ** 2
    sides = min(ranks - 1, 2)
    computed = elements + sides * 12.0 * nodes
    alone = model["start"] + model["per_element"] * elements
    step = model["start"] + model["per_element"] * computed
    if ranks > 1:
        sent = sides * 16.0 * nodes
        exchange = model["latency"] + model["per_byte"] * sent
        if machines > 1:
            exchange = max(exchange, NETWORK_LATENCY + sent / NETWORK_RATE)
        step += max(model["exposed"] * exchange, exchange - model["per_element"] * elements)
    return {"ranks": ranks, "machines": machines, "level": level, "step_us": step, "efficiency": alone / step}


def chosen(options: argparse.Namespace) -> tuple[str, list[int]]:
    """The device, and the numbers of ranks, ascending from one.

    Raises:
        ValueError: A number of ranks is not positive, or there are fewer cards.
    """
    import warp as wp

    wp.config.log_level = wp.LOG_ERROR
    cards = wp.get_cuda_device_count()
    device = options.device or ("cuda" if cards else "cpu")
    most = cards if device == "cuda" else len(os.sched_getaffinity(0))
    if device == "cuda" and not cards:
        raise ValueError("there is no card; --device must be cpu")
    if options.ranks is None:
        return device, sorted({*(2**k for k in range(most.bit_length())), most})
    counts = sorted({1, *(int(n) for n in options.ranks.split(","))})
    if counts[0] < 1 or (device == "cuda" and counts[-1] > cards):
        raise ValueError(f"--ranks is {options.ranks}; they must be at least 1, and on cards at most {cards}")
    return device, counts


def main() -> int:
    of = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    of.add_argument("--device", choices=("cpu", "cuda"), help="cuda: each rank takes a card (default if there are any)")
    of.add_argument("--ranks", help="numbers of ranks; 1 is always among them (default: 1, 2, 4, ... and all)")
    of.add_argument(
        "--weak", help=f"levels of the cubes of weak scaling ({LEVELS[0]} on cards, {CPU_LEVELS[0]} on a CPU)"
    )
    of.add_argument(
        "--strong",
        help=f"levels of cubes in strong scaling, as many as the most ranks ({LEVELS[1]}, {CPU_LEVELS[1]})",
    )
    of.add_argument("--json", type=Path, help="write all numbers to this file, too")
    of.add_argument("--worker", type=int, help=argparse.SUPPRESS)
    of.add_argument("--level", type=int, help=argparse.SUPPRESS)
    options = of.parse_args()
    if options.worker is not None:
        row = measured(options.worker, options.level, options.device)
        # Each line is one write, so that the lines of ranks do not mix.
        os.write(1, f"ROW {json.dumps(row)}\n".encode())
        return 0
    try:
        options.device, counts = chosen(options)
        return measure(options, counts)
    except (RuntimeError, ValueError) as error:
        print(f"scaling.py: {error}", file=sys.stderr)
        return 1


def measure(options: argparse.Namespace, counts: list[int]) -> int:
    """Measure, fit and predict, and print it all.

    Raises:
        RuntimeError: A run failed.
    """
    usual = LEVELS if options.device == "cuda" else CPU_LEVELS
    options.weak = usual[0] if options.weak is None else options.weak
    options.strong = usual[1] if options.strong is None else options.strong
    rows: list[dict[str, Any]] = []
    print(
        "scaling  level  ranks    elements    computed  copied      step     spread  exchange  efficiency    memory",
        flush=True,
    )
    for kind, levels in (("weak", options.weak), ("strong", options.strong)):
        for level in (int(n) for n in levels.split(",") if n):
            alone = None
            for ranks in counts:
                row = on_ranks(ranks, ranks if kind == "weak" else max(counts), level, options.device)
                alone = alone or row["step_us"] * (1 if kind == "weak" else row["ranks"])
                share = alone / row["step_us"] / (1 if kind == "weak" else ranks)
                rows.append(row | {"scaling": kind, "efficiency": share})
                print(
                    f"{kind:7} {level:6} {ranks:6} {row['elements']:11} {row['computed']:11} {row['copied']:7} "
                    f"{row['step_us']:9.1f} us {row['spread']:6.1%} {row['exchange_us']:6.1f} us {share:10.1%} "
                    f"{row['memory_mb']:6.0f} MB",
                    flush=True,
                )
    model = fitted(rows)
    print("model [us, us an element or byte]: " + ", ".join(f"{name} {value:.4g}" for name, value in model.items()))
    predictions = []
    if {"start", "latency"} <= model.keys():
        levels = sorted({int(n) for n in options.weak.split(",") if n})
        sizes = [(ranks, 1) for ranks in (*counts, 8)] + [(64, 8)]
        predictions = [predicted(model, n, level, machines=machines) for level in levels for n, machines in sizes]
        for each in predictions:
            print(
                f"prediction, not measured: level {each['level']}, {each['ranks']} ranks on {each['machines']} "
                f"machines: {each['step_us']:.1f} us a step, {each['efficiency']:.1%}"
            )
    if options.json is not None:
        found = {"benchmark": "scaling", "device": options.device, "rows": rows, "model": model}
        options.json.write_text(json.dumps(found | {"predictions": predictions}, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
