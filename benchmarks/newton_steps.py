#!/usr/bin/env python3
"""This package's solver for Newton next to Newton's own: forces, and whole steps with the largest stable step.

    python benchmarks/newton_steps.py [--device cuda:0] [--level 21] [--step-level 18] [--json FILE]

These are the rows of ``peers.py`` in Newton: the same tetrahedra under gravity, fixed at the floor.
Newton must be installed.
"""

from __future__ import annotations

import sys
import time
import warnings

import newton_cases
from measure import checked, copy_bandwidth, finish, machine, measure, parser, tell
from peers import LEVELS, NOTES, add_step_level, check_step_level, printed, problems, report_rows, step_cases

import warp_corot as wc


def main() -> int:
    of = parser(__doc__.split("\n\n")[0], "newton_steps.py")
    add_step_level(of)
    options = of.parse_args()
    device = checked(options, of, LEVELS)
    check_step_level(options, of, device)
    warnings.simplefilter("ignore", wc.StabilityWarning)
    start = time.perf_counter()
    about = machine(device) | {"level": options.level, "step_level": options.step_level, "rounds": options.rounds}
    about["peers"] = {"newton": newton_cases.NAME}
    copy = about["copy_gb_per_s"] = copy_bandwidth(device)
    problem, stepping = problems(options, device)
    print(f"{about['name']} ({device}), Warp {about['warp']}, {newton_cases.NAME}: forces of ", end="")
    print(f"{problem.tet_count} tetrahedra, steps of {stepping.tet_count}", flush=True)
    results = measure(newton_cases.force_cases(problem), device, options.rounds, tell)
    results += measure(step_cases(stepping, [newton_cases], ours=False), device, options.rounds, tell)
    about["seconds"] = time.perf_counter() - start
    lines = report_rows(results, copy)
    tell("")
    print(printed(lines))
    print(NOTES)
    return finish(options, {"benchmark": "newton_steps", **about, "rows": lines}, results)


if __name__ == "__main__":
    sys.exit(main())
