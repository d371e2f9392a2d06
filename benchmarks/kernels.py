#!/usr/bin/env python3
"""The cost of each stage of a time step, and its lower bound.

    python benchmarks/kernels.py [--device cuda:0] [--level 21] [--json FILE]

The mesh is one root cube, bisected to a level, with nodes jittered by 5 % of the edge length, in float32. Every timed
result is checked against float64 in the same run.
"""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Sequence

from measure import (
    Result,
    checked,
    copy_bandwidth,
    finish,
    machine,
    measure,
    number,
    parser,
    percent,
    table,
    tell,
)
from problem import SUBTREE_LEVELS, Problem
from solver_cases import force_cases, integration_case, step_cases
from stage_cases import product_cases, rotation_cases, scatter_cases

import warp_corot as wc

HEADER = ("stage", "variant", "ns/tet", "spread", "Gtet/s", "B/tet", "flop/tet", "of copy", "error")


def rows(results: Sequence[Result], copy_gb_s: float) -> list[list[str]]:
    lines = []
    for r in results:
        d = r.as_dict(copy_gb_s)
        lines.append(
            [
                d["stage"],
                d["variant"],
                number(d["ns_per_tet"]),
                percent(d["spread"]),
                number(d["gtet_per_s"]),
                number(d["bytes_per_tet"]),
                number(d["flops_per_tet"]),
                percent(d["copy_fraction"]),
                f"{d['error']:.1e}",
            ]
        )
    return lines


def main() -> int:
    of = parser(__doc__.split("\n\n")[0], "kernels.py")
    options = of.parse_args()
    device = checked(options, of, range(SUBTREE_LEVELS, 25))
    warnings.simplefilter("ignore", wc.StabilityWarning)
    start = time.perf_counter()
    about = machine(device)
    tell(f"building level {options.level}")
    problem = Problem(options.level, device)
    about |= {"level": options.level, "tets": problem.tet_count, "nodes": problem.node_count, "rounds": options.rounds}
    about["copy_gb_per_s"] = copy_bandwidth(device)
    print(
        f"{about['name']} ({device}), Warp {about['warp']}: level {options.level}, {problem.tet_count} tetrahedra, ",
        end="",
    )
    print(f"{problem.node_count} nodes, copy {about['copy_gb_per_s']:.0f} GB/s", flush=True)
    cases = [
        *rotation_cases(problem),
        *product_cases(problem),
        *scatter_cases(problem),
        *force_cases(problem),
        integration_case(problem),
        *step_cases(problem),
    ]
    results = measure(cases, device, options.rounds, tell)
    copy = about["copy_gb_per_s"]
    about["seconds"] = time.perf_counter() - start
    tell("")
    print(table(HEADER, rows(results, copy), 2))
    report = {"benchmark": "kernels", **about, "rows": [r.as_dict(copy) for r in results]}
    return finish(options, report, results)


if __name__ == "__main__":
    sys.exit(main())
