#!/usr/bin/env python3
"""The whole table of states.py in one run: processes build the bodies side by side, and time them one at a time.

    python benchmarks/all_states.py [--device cuda:0] [--seconds 190] [--json FOLDER]

Parts that are not finished after ``--seconds`` are left out and named. On one GPU with sixteen CPU cores three minutes
are enough.
"""

from __future__ import annotations

import argparse
import contextlib
import multiprocessing
import sys
import tempfile
import time
import traceback
from pathlib import Path
from typing import Any

LAWS = ["corotated", "corotated, rotations 3 up", "linear", "StVK", "neo-Hookean", "corotated, whole step"]
MAPS = ["falling", "twisted by pi", "stretched to 1.8", "squeezed to 0.5"]
FIBRES, ONE, LOADED = ["transversely isotropic"], ["one leaf turned over"], ["under its weight"]
#: The parts of the table: their names, and the options of states.py.
PARTS = {
    f"{name}, Poisson's ratio {poisson}": ["--poisson", poisson, *options]
    for poisson in ("0.49", "0.44")
    for name, options in {
        "beams and notched beams": ["--bodies", "beam", "notch", "--levels", "6", "12", "18", "--organs"],
        "cubes": ["--bodies", "cube", "--levels", "12", "18", "--organs"],
        "worlds": ["--bodies", "beams", "balls", "--levels", "6", "--organs", "1"],
        "the graded ball": ["--bodies", "graded", "--levels", "6", "--organs", "--laws", LAWS[0], "--states", *LOADED],
        "the finest beam": ["--bodies", "beam", "--levels", "21", "--organs", "--states", *MAPS],
        **{
            f"organs of {count} elements": ["--bodies", "ball", "bunny", "--levels", "6", "--organs", count]
            for count in ("20000", "100000", "1000000")
        },
    }.items()
} | {
    "fibres": ["--bodies", "beam", "cube", "--levels", "18", "--organs", "--laws", *FIBRES, "--states", *MAPS],
    "fibres, the finest cube": ["--bodies", "cube", "--levels", "21", "--organs", "--laws", *FIBRES, "--states", *ONE],
}


def run_part(options: list[str], path: str, lock: Any) -> None:
    """Run states.py with its output in a file; only timing is behind the lock."""
    import states
    from measure import measure

    def checked_first(cases: list, *others: Any) -> list:
        errors = [float(case.error()) for case in cases]
        for case, error in zip(cases, errors, strict=True):
            case.error = lambda error=error: error
        with lock:
            return measure(cases, *others)

    states.measure = checked_first
    sys.argv = ["states.py", *options]
    with (
        open(path, "w", encoding="utf-8", buffering=1) as file,
        contextlib.redirect_stdout(file),
        contextlib.redirect_stderr(file),
    ):
        try:
            states.main()
        except Exception:
            traceback.print_exc()


def main() -> int:
    of = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    of.add_argument("--device", default="cuda:0")
    of.add_argument("--seconds", type=float, default=190.0, help="end after this time, with what is there")
    of.add_argument("--rounds", type=int, default=5)
    of.add_argument("--json", type=Path, metavar="FOLDER", help="write what states.py finds to files there")
    of.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    options = of.parse_args()
    end = time.perf_counter() + options.seconds
    context = multiprocessing.get_context("spawn")
    lock, running = context.Lock(), {}
    with tempfile.TemporaryDirectory() as folder:
        for number, name in enumerate(options.parts):
            given = ["--device", options.device, "--rounds", str(options.rounds), "--laws", *LAWS, *PARTS[name]]
            if options.json is not None:
                given += ["--json", str(options.json / f"states_{number}.json")]
            path = f"{folder}/{number}.txt"
            running[name] = context.Process(target=run_part, args=(given, path, lock)), path
            running[name][0].start()
        late = []
        for name, (process, path) in running.items():
            process.join(max(end - time.perf_counter(), 0.0))
            if process.is_alive():
                process.kill()
                late.append(name)
            found = Path(path).read_text(encoding="utf-8") if Path(path).exists() else ""
            print(f"## {name}\n\n{found}", flush=True)
    if late:
        print("not done in time:", "; ".join(late))
    return 1 if late else 0


if __name__ == "__main__":
    sys.exit(main())
