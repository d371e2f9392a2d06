#!/usr/bin/env python3
"""Cost of forces in the states of tissue: under its weight, twisted, pulled, inverted.

    python benchmarks/states.py [--device cuda:0] [--levels 6 9 12 15 18] [--organs 20000 100000] [--json FILE]

Every law on the users' path, leaf by leaf and on the same elements as a general mesh, timed in turn and checked
against float64. Young's modulus is 5 kPa, density 1000 kg/m^3; with --poisson 0.45 or more the elements of isotropic
laws share their dilatation, as they do by default. state_bodies.py describes how each state is made.
"""

from __future__ import annotations

import dataclasses
import gc
import math
import sys
import time
import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np
import warp as wp
from measure import Case, Parser, Result, checked, finish, machine, measure, number, parser, percent, table, tell
from state_bodies import MAKERS, MATERIAL, State, Subject, beam, cube, graded_ball, notched_beam, organ
from state_cases import DEFAULT, GENERAL, LEAF, Row, rows_of

import warp_corot as wc

LEVELS = {"cuda": [6, 9, 12, 15, 18], "cpu": [6, 12]}
ORGANS = {"cuda": [20_000, 100_000, 1_000_000], "cpu": [20_000]}
ROUNDS = {"cuda": 9, "cpu": 5}
BODIES = ("beam", "beams", "notch", "cube", "ball", "bunny", "balls", "graded")
#: Number of copies of the level-6 beam that are stepped together.
WORLDS = {"cuda": 1024, "cpu": 16}
#: Number of copies of a ball that are stepped together, and approximate number of elements of each.
BALLS = {"cuda": (64, 10_000), "cpu": (4, 1_000)}
#: Level of the graded ball of 3 million elements.
GRADED_LEVEL = 12
#: Of larger meshes, a random sample of this size is examined.
LOOKED_AT = 200_000

STATES = ("body", "state", "made by", "tets", "inverted", "cond 50 %", "90 %", "99 %")
FORCES = ("state", "law", "ns/tet", "spread", "Gtet/s", "/ leaf", "/ rest", "/ general", "flagged", "error")


def subjects(options: Any, where: str) -> Iterator[Subject]:
    """The subjects, one at a time, so that only one is in memory, until there is no time to begin another one."""
    begin = time.perf_counter()
    for subject in made(options, where):
        if time.perf_counter() - begin > options.seconds:
            print(f"left out, after {options.seconds:g} s: {subject.name} and all that follow", flush=True)
            return
        chosen = tuple(name for name in subject.states if options.states is None or name in options.states)
        yield dataclasses.replace(subject, poisson=options.poisson, states=chosen)


def made(options: Any, where: str) -> Iterator[Subject]:
    for level in options.levels:
        for name, make in (("beam", beam), ("notch", notched_beam), ("cube", cube)):
            if name in options.bodies and not (name == "notch" and level < 6):
                tell(f"building {name} {level}")
                yield make(level)
    if "beams" in options.bodies:
        yield beam(options.levels[0], WORLDS[where])
    if "graded" in options.bodies and where == "cuda" and not options.quick:
        tell("building the graded ball")
        yield graded_ball(GRADED_LEVEL)
    if "balls" in options.bodies and options.organs:
        worlds, count = BALLS[where]
        yield organ("ball", count, worlds)
    for count in options.organs:
        for name in ("ball", "bunny"):
            if name in options.bodies:
                tell(f"building {name} {count}")
                yield organ(name, count)


def look(subject: Subject, state: State) -> dict[str, Any]:
    """Strain of a state: the fraction of inverted elements, and condition numbers of F."""
    tets = subject.mesh.tets
    if len(tets) > LOOKED_AT:
        chosen = np.random.default_rng(5).integers(0, len(tets), LOOKED_AT)
    else:
        chosen = np.arange(len(tets))
    F = subject.deformation_gradients(chosen, state.u)
    s = np.linalg.svd(F, compute_uv=False)
    with np.errstate(divide="ignore"):
        condition = np.percentile(s[:, 0] / s[:, 2], [50, 90, 99])
    return {
        "body": subject.name,
        "state": state.name,
        "how": state.how,
        "tets": len(tets) * subject.worlds,
        "inverted": float((np.linalg.det(F) < 0).mean()),
        "condition": condition.tolist(),
    }


def line(subject: Subject, row: Row, results: dict[int, Result], rest: Result) -> dict[str, Any]:
    """A row of the report."""
    found = {path: results[id(case)] for path, case in row.paths.items()}
    own = found[DEFAULT]
    own.case.run()
    return {
        "stage": f"{subject.name}, {row.state.name}",
        "variant": row.law,
        "tets": own.case.tets,
        "ns_per_tet": own.ns,
        "spread": own.spread,
        "gtet_per_s": 1.0 / own.ns,
        "over_leaf_by_leaf": own.relative_to(found[LEAF]) if LEAF in found else None,
        "over_rest": own.relative_to(rest),
        "over_general": own.relative_to(found[GENERAL]) if GENERAL in found else None,
        "flagged": row.flagged(),
        "error": max(r.error for r in found.values()),
        "paths": {path: {"ns_per_tet": r.ns, "spread": r.spread, "error": r.error} for path, r in found.items()},
    }


def timed(subject: Subject, device: wp.Device, options: Any) -> tuple[list[dict], list[dict], list[Result]]:
    """States, rows and results of one body."""
    states = list(subject.all_states(device))
    rows = rows_of(subject, states, device, options.laws)
    cases: list[Case] = [case for row in rows for case in row.paths.values()]
    results = measure(cases, device, options.rounds, lambda said: tell(f"{subject.name}: {said}"))
    by_case = {id(case): result for case, result in zip(cases, results, strict=True)}
    rests = {row.law: by_case[id(row.paths[DEFAULT])] for row in rows if row.state is states[0]}
    lines = [line(subject, row, by_case, rests[row.law]) for row in rows]
    return [look(subject, state) for state in states], lines, [without_arrays(result) for result in results]


def without_arrays(result: Result) -> Result:
    """The result without references to device memory."""
    case = dataclasses.replace(result.case, run=lambda: None, error=lambda error=result.error: error, reset=None)
    return dataclasses.replace(result, case=case)


def show(looks: list[dict], lines: list[dict], seconds: float) -> None:
    cells = [
        [d["body"], d["state"], d["how"], str(d["tets"]), percent(d["inverted"]), *map(number, d["condition"])]
        for d in looks
    ]
    print(table(STATES, cells, 3))
    print()
    cells = [
        [
            d["stage"],
            d["variant"],
            number(d["ns_per_tet"]),
            percent(d["spread"]),
            number(d["gtet_per_s"]),
            *(number(d[over]) for over in ("over_leaf_by_leaf", "over_rest", "over_general")),
            percent(d["flagged"]),
            f"{d['error']:.1e}",
        ]
        for d in lines
    ]
    print(table(FORCES, cells, 2))
    print(f"({seconds:.0f} s)\n", flush=True)


def command_line() -> Parser:
    of = parser(__doc__.split("\n\n")[0], "states.py")
    of.add_argument("--levels", type=int, nargs="+", help="several (default: 6 12, on CUDA 6 9 12 15 18)")
    of.add_argument("--organs", type=int, nargs="*", help="approximate numbers of elements of balls and bunnies")
    of.add_argument("--bodies", nargs="+", choices=BODIES, default=BODIES)
    of.add_argument("--states", nargs="+", choices=MAKERS, help="only these, besides that at rest")
    of.add_argument("--laws", nargs="+", help="only these laws, by their names in the table")
    of.add_argument(
        "--poisson", type=float, default=MATERIAL["poisson"], help="from 0.45 on elements share their dilatation"
    )
    of.add_argument("--seconds", type=float, default=math.inf, help="begin no further body after this time")
    of.add_argument("--quick", action="store_true", help="one small beam and cube, two rounds, as a test")
    return of


def main() -> int:
    of = command_line()
    options = of.parse_args()
    one, rounds = options.level, options.rounds
    device = checked(options, of, range(3, 25))
    where = "cuda" if device.is_cuda else "cpu"
    options.rounds = rounds or (2 if options.quick else ROUNDS[where])
    options.levels = options.levels or ([one] if one is not None else [3] if options.quick else LEVELS[where])
    if not 0.0 <= options.poisson < 0.5:
        of.error(f"--poisson is {options.poisson}; it must be at least 0 and below 0.5")
    for level in options.levels:
        if not 3 <= level <= 24:
            of.error(f"--levels has {level}; they must be from 3 to 24")
    if options.organs is None:
        options.organs = [] if options.quick else ORGANS[where]
    if options.quick:
        options.bodies = ("beam", "cube")
    warnings.simplefilter("ignore", wc.StabilityWarning)
    start = time.perf_counter()
    about = machine(device) | {"rounds": options.rounds, "poisson": options.poisson}
    print(f"{about['name']} ({device}), Warp {about['warp']}, Poisson's ratio {options.poisson:g}", flush=True)
    looks, lines, results = [], [], []
    for subject in subjects(options, where):
        before = time.perf_counter()
        found = timed(subject, device, options)
        tell("")
        show(*found[:2], time.perf_counter() - before)
        for kept, new in zip((looks, lines, results), found, strict=True):
            kept += new
        gc.collect()
    about["seconds"] = time.perf_counter() - start
    return finish(options, {"benchmark": "states", **about, "states": looks, "rows": lines}, results)


if __name__ == "__main__":
    sys.exit(main())
