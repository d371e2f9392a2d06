#!/usr/bin/env python3
"""Cost of a remeshing pass: one that changes nothing, one that changes 1 %, one that doubles the mesh.

    python benchmarks/remesh.py [--device cuda:0] [--level 21] [--json FILE]

One root cube, bisected uniformly to several levels up to the given one. Each pass begins with the same mesh; restoring
it is not timed. The script checks that the leaves fill the cube and that the expected number was bisected.
"""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Callable, Sequence

import numpy as np
import warp as wp
from measure import Case, Result, checked, finish, machine, measure, number, parser, percent, table, tell

import warp_corot as wc
from warp_corot.discretization.changing.pools import DeviceForest
from warp_corot.kernels.remesh.criteria import ElementState
from warp_corot.mesh.lattice import volume_shares
from warp_corot.simulation.simulation import Simulation

LEVELS = (7, 10, 14, 17)
HEADER = ("what", "of it", "leaves", "ms", "spread", "ns/leaf", "bisected", "ns/bisected")
PASS, WHOLE = "pass", "with plan and readback"
#: Parameters of the criterion: a radius around the cube's corner, or a fraction of all leaves.
CHANGES = {"nothing": (0.0, 0.0), "1 %, in one place": (1.0, 0.0), "1 %, scattered": (0.0, 0.01), "doubled": (0.0, 2.0)}


@wp.func
def choice(element: ElementState, parameters: wp.array[wp.float32]):
    """1 for leaves near the corner, or for a random fraction of them."""
    x = element.corner + 0.25 * (element.rest[1] + element.rest[2] + element.rest[3])
    seed = wp.rand_init(int(4096.0 * x[0]) * 4099 + int(4096.0 * x[1]), int(4096.0 * x[2]))
    chosen = wp.length(x) < parameters[0] or wp.randf(seed) < parameters[1]
    return wp.where(chosen, 1.0, 0.0)


class Scene:
    """A cube and its pass, alone or within a simulation."""

    def __init__(self, level: int, device: wp.Device):
        mesh = wc.TetForest.box((1, 1, 1), 1.0, level)
        self.count = len(mesh.tets)
        self.body = wc.SoftBody(mesh, wc.Isotropic(1e4, 0.3, 1e3), device=device)
        self.numbers = wp.zeros(2, dtype=wp.float32, device=device)
        options = wc.OnlineRemesh(
            refine_above=0.5,
            simplify_below=-1.0,
            min_level=0,
            max_level=level + 6,
            capacity=2 * self.count,
            criterion=choice,
            parameters=self.numbers,
        )
        # With gravity, because a CPU is slow with subnormal numbers.
        self.sim = Simulation(self.body, integrator=wc.SymplecticEuler(dt=1e-6), remesh=options)
        self.changing = self.sim.remeshing.changing[0]
        assert self.changing is not None
        self.forest: DeviceForest = self.changing.forest
        with wp.ScopedCapture(device=device) as capture:
            self.changing.passes.launch()
        self.graph = capture.graph

    def case(self, what: str, how: str) -> Case:
        run: Callable[[], object] = self.changing.run if how == WHOLE else lambda: wp.capture_launch(self.graph)
        extra: dict[str, object] = {}

        def error() -> float:
            """Missing volume, or a number of bisections far from the expected one."""
            self.reset(what)
            run()
            counts = np.bincount(self.forest.pools.level.numpy()[self.forest.leaf_elements])
            bisected = int(counts.sum()) - self.count
            extra["bisected"] = bisected
            least = {"nothing": 0, "doubled": self.count}.get(what, round(0.008 * self.count))
            fits = bisected == least if what in ("nothing", "doubled") else bisected >= least
            volume = float(counts @ volume_shares(np.arange(len(counts))))
            return abs(volume - 1.0) if fits else np.inf

        return Case(
            what,
            how,
            run,
            error,
            tets=self.count,
            recorded=False,
            reset=lambda: self.reset(what),
            wrong=1e-9,
            extra=extra,
        )

    def step(self) -> Case:
        """One time step of the same mesh, for comparison."""

        def prepare() -> None:
            # Other rows leave meshes of other sizes: the step is recorded again.
            self.reset("nothing")
            self.sim.step()

        def error() -> float:
            prepare()
            return float(np.abs(self.body.displacements.numpy()).max())

        return Case(
            "a time step",
            "",
            self.sim.step,
            error,
            tets=self.count,
            recorded=False,
            reset=prepare,
            wrong=1e-9,
            extra={"bisected": 0},
        )

    def reset(self, what: str) -> None:
        near, share = CHANGES[what]
        # An eighth of a ball with a hundredth of the cube's volume.
        self.numbers.assign([near * (0.01 * 6.0 / np.pi) ** (1 / 3), share])
        self.sim.reset()


def rows(results: Sequence[Result]) -> list[list[str]]:
    """One line for each result; the cost of a bisection on top of a pass that changes nothing."""
    nothing = {r.case.variant: r.ns * r.case.tets for r in results if r.case.stage == "nothing"}
    lines = []
    for r in results:
        whole, bisected = r.ns * r.case.tets, r.case.extra["bisected"]
        each = (whole - nothing[r.case.variant]) / bisected if bisected else None
        r.case.extra |= {"ms": 1e-6 * whole, "ns_per_bisected": each}
        cells = [r.case.stage, r.case.variant, str(r.case.tets), number(1e-6 * whole), percent(r.spread), number(r.ns)]
        lines.append([*cells, str(bisected), number(each)])
    return lines


def main() -> int:
    of = parser(__doc__.split("\n\n")[0], "remesh.py")
    options = of.parse_args()
    given = options.level
    device = checked(options, of, range(3, 22))
    if given is None:
        options.level = 21 if device.is_cuda else 17
    warnings.simplefilter("ignore", wc.StabilityWarning)
    start = time.perf_counter()
    about = machine(device) | {"rounds": options.rounds}
    print(f"{about['name']} ({device}), Warp {about['warp']}", flush=True)
    results, lines = [], []
    for level in [each for each in LEVELS if each < options.level] + [options.level]:
        tell(f"building level {level}")
        scene = Scene(level, device)
        cases = [scene.step()] + [scene.case(what, how) for what in CHANGES for how in (PASS, WHOLE)]
        found = measure(cases, device, options.rounds, tell)
        results += found
        lines += rows(found)
        del scene, cases
    about["seconds"] = time.perf_counter() - start
    tell("")
    print(table(HEADER, lines, 2))
    report = {"benchmark": "remesh", **about, "rows": [r.as_dict(1.0) for r in results]}
    return finish(options, report, results)


if __name__ == "__main__":
    sys.exit(main())
