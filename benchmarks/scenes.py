#!/usr/bin/env python3
"""The standing scenes: organs as users have them, on a table, under a tool, in one another's way.

    python benchmarks/scenes.py [--device cuda:0] [--scenes standing,dropped] [--elements 20000,100000]
        [--young 5e3,3e4] [--poisson 0.44,0.49] [--integrators explicit,implicit] [--duration 1] [--limit 20]
        [--only WORDS] [--errors WORDS] [--rows FILE]

Explicit steps follow the state; implicit ones are ``BackwardEuler`` of 1/60 s. A row simulates ``--duration`` seconds,
or as much of them as ``--limit`` seconds of wall time after the first frame allow, in frames of 1/60 s. Its real-time
factor is simulated over wall time after the first frame. That one is given apart, because it has what is compiled or
recorded when steps begin. Launches are counted in one more step, where the host makes them: a loop on the device counts
once. A scene that ends in an error or in positions that are not finite is a failure; how many elements are turned over
at the end is in the table, since laws other than neo-Hookean's let tissue fold under its weight.

``--only`` leaves the rows whose name has all of these words, as in ``--only "dropped 20000 implicit"``; a row's name is
that of the scene, the elements asked for, Young's modulus, Poisson's ratio and the steps. ``--errors`` compares
positions at the end of such rows with the same scene in a quarter of the step and with a tenth of the tolerances, over
the body's size. ``--rows`` adds each row to a file when it ends, as a line of JSON; rows that the file has are not
repeated, so that a run that was stopped goes on.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
import warp.examples
from measure import machine, number, table, tell
from scipy.spatial import cKDTree

import warp_corot as wc
from warp_corot.inputs.checks import checked_device

FRAME = 1.0 / 60.0
DOWN = (0.0, -9.81, 0.0)
HEADER = (
    *("scene", "elements", "kPa", "nu", "steps", "simulated, s", "real time", "ms a frame", "ms a step"),
    *("steps a frame", "launches a step"),
    *("iterations", "unfinished", "turned over", "first frame, s", "ready, s", "error, %"),
)


@dataclass(frozen=True)
class Setting:
    """What a row varies: the number of elements, Young's modulus [Pa], Poisson's ratio, the device, how it is stepped,
    and by how much its step and its tolerances are shortened."""

    elements: int
    young: float
    poisson: float
    device: wp.Device
    implicit: bool
    shorter: int = 1

    @property
    def steps(self) -> str:
        return "implicit" if self.implicit else "explicit"

    def material(self) -> wc.Isotropic:
        return wc.Isotropic(self.young, self.poisson, 1000.0)

    def body(self, mesh: wc.TetForest, worlds: int = 1) -> wc.SoftBody:
        return wc.SoftBody(mesh, self.material(), worlds=worlds, device=self.device)

    def simulation(self, bodies: Any, **options: Any) -> wc.Simulation:
        integrator: Any = wc.SymplecticEuler(damping=2.0)
        if self.implicit and self.shorter == 1:
            integrator = wc.BackwardEuler(FRAME, damping=2.0)
        elif self.implicit:
            finer = {"tolerance": 1e-4, "linear_tolerance": 1e-5}
            integrator = wc.BackwardEuler(FRAME / self.shorter, damping=2.0, **finer)
        elif self.shorter > 1:
            dt = 0.5 * wc.Simulation(bodies).stable_dt / self.shorter
            integrator = wc.SymplecticEuler(FRAME / int(np.ceil(FRAME / dt)), damping=2.0)
        return wc.Simulation(bodies, integrator=integrator, gravity=DOWN, **options)


# --- bodies ----------------------------------------------------------------------------------------------------------


@cache
def bunny(elements: int) -> wc.TetForest:
    """The Stanford bunny, 16 cm long."""
    source = os.path.join(os.path.dirname(warp.examples.__file__), "assets", "bunny.usd")
    return wc.TetForest.from_domain(wc.Domain.from_surface(source, unit=0.1), target_elements=elements)


def _ball(x: np.ndarray, centre: tuple[float, float, float], radius: float) -> np.ndarray:
    return np.linalg.norm(x - np.array(centre), axis=1) - radius


def _liver(x: np.ndarray) -> np.ndarray:
    balls = _ball(x, (0.045, 0, 0), 0.06), _ball(x, (-0.045, 0.0, 0), 0.04), _ball(x, (0, -0.01, 0.045), 0.035)
    return np.maximum(-0.015 * np.log(sum(np.exp(-each / 0.015) for each in balls)), -x[:, 1] - 0.035)


@cache
def liver(elements: int, lift: float = 0.0) -> wc.TetForest:
    """A liver with a flat lower side at y = lift - 35 mm, 19 cm long and about 10 cm high."""
    low, high = np.array([-0.1, -0.04, -0.075]), np.array([0.12, 0.08, 0.1])
    up = np.array([0.0, lift, 0.0])
    domain = wc.Domain.from_function(lambda x: _liver(x - up), [low + up, high + up], 1.2)
    return wc.TetForest.from_domain(domain, target_elements=elements)


@cache
def coil(elements: int) -> wc.TetForest:
    """A tube of 16 mm on a helix of 60 mm whose turns lie 1 mm apart."""
    t = np.linspace(0.0, 6.0 * np.pi, 4000)
    line = np.stack([0.03 * np.cos(t), 0.017 * t / (2.0 * np.pi), 0.03 * np.sin(t)], axis=1)
    tree = cKDTree(line)
    bounds = [line.min(axis=0) - 0.009, line.max(axis=0) + 0.009]
    return wc.TetForest.from_domain(
        wc.Domain.from_function(lambda x: tree.query(x)[0] - 0.008, bounds), target_elements=elements
    )


def ground(height: float) -> wc.Ground:
    return wc.Ground((0.0, 1.0, 0.0), height)


def lowest(mesh: wc.TetForest) -> float:
    return float(mesh.surface().points[:, 1].min())


# --- scenes ----------------------------------------------------------------------------------------------------------


def standing(at: Setting) -> wc.Simulation:
    """The bunny, held in its lowest centimetre, gets its weight."""
    body = at.body(bunny(at.elements))
    body.fix("y < 0.01")
    return at.simulation(body)


def dropped(at: Setting) -> wc.Simulation:
    """The bunny falls 2 cm onto a ground."""
    mesh = bunny(at.elements)
    return at.simulation(at.body(mesh), obstacles=ground(lowest(mesh) - 0.02), contact=wc.Contact())


def pressed(at: Setting) -> wc.Simulation:
    """A liver lies on a table; a ball of 10 mm presses it by 10 mm and is dragged by 20 mm."""
    mesh = liver(at.elements)
    tool = wc.Tool(wc.Sphere(0.01, position=(0.045, 0.071, 0.0)))
    path = [(0.045, 0.071, 0.0), (0.045, 0.060, 0.0), (0.065, 0.060, 0.0)]
    tool.follow([0.0, 0.3, 0.7], path)
    obstacles = [ground(lowest(mesh)), tool]
    return at.simulation(at.body(mesh), obstacles=obstacles, contact=wc.Contact(friction=0.3))


def lifted(at: Setting) -> wc.Simulation:
    """A liver on a table is grasped at its rim and lifted by 5 cm."""
    mesh = liver(at.elements)
    body, tool = at.body(mesh), wc.Tool(wc.Sphere(0.005, position=(-0.1, 0.0, 0.0)))
    tool.follow([0.0, 0.6], [(-0.1, 0.0, 0.0), (-0.1, 0.05, 0.0)])
    sim = at.simulation(body, obstacles=[ground(lowest(mesh)), tool], contact=wc.Contact(friction=0.3))
    wc.Grasp(body, "x < xmin + 0.012", tool=tool)
    return sim


def squeezed(at: Setting) -> wc.Simulation:
    """A plate presses one liver by 2 cm onto another, which lies on a table."""
    lower, upper = liver(at.elements // 2), liver(at.elements // 2, 0.1)
    top = float(upper.surface().points[:, 1].max()) + 0.006
    plate = wc.Tool(wc.Box((0.24, 0.01, 0.24), position=(0.0, top, 0.0)))
    plate.follow([0.0, 0.5], [(0.0, top, 0.0), (0.0, top - 0.04, 0.0)])
    bodies = [at.body(lower), at.body(upper)]
    bodies[0].fix("y < ymin + 0.005")
    return at.simulation(bodies, obstacles=[ground(lowest(lower)), plate], contact=wc.Contact(friction=0.3))


def coiled(at: Setting) -> wc.Simulation:
    """A coiled tube, held at its lower end, sinks onto itself."""
    body = at.body(coil(at.elements))
    body.fix("y < ymin + 0.006")
    return at.simulation(body, contact=wc.Contact(friction=0.3, self_contact=True))


def refined(at: Setting) -> wc.Simulation:
    """A ball is pushed into a slab and dragged, while the mesh is refined where it is."""
    level = int(np.log2(at.elements / 4 / 96))
    body = at.body(wc.TetForest.box((4, 1, 4), 0.03, level))
    body.fix("y < ymin + 1e-6")
    tool = wc.Tool(wc.Sphere(0.01, position=(0.04, 0.041, 0.06)))
    tool.follow([0.0, 0.3, 0.9], [(0.04, 0.041, 0.06), (0.04, 0.033, 0.06), (0.08, 0.033, 0.06)])
    remesh = wc.OnlineRemesh(refine_above=1.1, simplify_below=1.03, every=20)
    return at.simulation(body, obstacles=[tool], contact=wc.Contact(friction=0.3), remesh=remesh)


def worlds(at: Setting) -> wc.Simulation:
    """Blocks of 384 elements, one in each of many worlds, fall 1 cm onto a ground."""
    mesh = wc.TetForest.box((1, 1, 1), 0.05, 6)
    body = at.body(mesh, max(at.elements // len(mesh.tets), 1))
    return at.simulation(body, obstacles=ground(-0.01), contact=wc.Contact(friction=0.3))


SCENES = {scene.__name__: scene for scene in (standing, dropped, pressed, lifted, squeezed, coiled, refined, worlds)}


#: From this size on, only these scenes.
LARGE, LARGE_SCENES = 500_000, ("standing", "dropped")


# --- rows ------------------------------------------------------------------------------------------------------------


def measured(scene: Callable[[Setting], wc.Simulation], at: Setting, duration: float, limit: float) -> dict[str, Any]:
    """A row: one scene, in one setting."""
    row: dict[str, Any] = {
        "scene": scene.__name__,
        "elements": at.elements,
        "young": at.young,
        "poisson": at.poisson,
        "steps": at.steps,
    }
    try:
        started = time.perf_counter()
        sim = scene(at)
        wp.synchronize_device(at.device)
        row["ready"] = time.perf_counter() - started
        row["elements"] = sum(body.sizes.elements for body in sim.bodies)
        frames, begun = [], 0.0
        for number_ in range(round(duration / FRAME)):
            started, steps = time.perf_counter(), sim.steps
            sim.advance(FRAME)
            wp.synchronize_device(at.device)
            frames.append((time.perf_counter() - started, sim.steps - steps))
            if number_ == 0:
                begun = time.perf_counter()
            if number_ > 3 and time.perf_counter() - begun > limit:
                break
        row |= {"first": frames[0][0], "simulated": sim.time} | of_frames(frames[1:])
        if sim.solves is not None:
            row["iterations"] = sim.solves.linear_iterations / max(sim.solves.steps, 1)
            row["unfinished"] = sim.solves.unfinished
        row["positions"] = [body.positions.numpy() for body in sim.bodies]
        row["turned"] = sum(turned_over(body) for body in sim.bodies)
        if not all(np.isfinite(each).all() for each in row["positions"]):
            row["failure"] = "positions are not finite"
        row["launches"] = launches(sim)
    except Exception as error:
        row["failure"] = f"{type(error).__name__}: {error}"
    return row


def turned_over(body: wc.SoftBody) -> int:
    """The number of elements whose volume is not positive."""
    mesh = body.mesh
    corners = body.positions.numpy()[:, :3].reshape(body.worlds, -1, 3)[:, mesh.tets]
    rest = mesh.points[mesh.tets]
    edges, at_rest = corners[..., 1:, :] - corners[..., :1, :], rest[:, 1:] - rest[:, :1]
    return int((np.linalg.det(edges) * np.sign(np.linalg.det(at_rest)) <= 0.0).sum())


def launches(sim: wc.Simulation) -> int | None:
    """The kernels that one more step launches; None if bodies are remeshed, whose steps cannot be recorded alone."""
    if any(sim.remesh):
        return None
    with counted() as count:
        if sim.device.is_cuda:
            with wp.ScopedCapture(sim.device, force_module_load=False):
                sim.step()
        else:
            sim.step()
    return count[0]


@contextmanager
def counted() -> Iterator[list[int]]:
    """Count the kernels that the host launches."""
    count, launch, again = [0], wp.launch, wp.Launch.launch

    def launched(*args: Any, **options: Any) -> Any:
        count[0] += not options.get("record_cmd", False)
        return launch(*args, **options)

    def repeated(*args: Any, **options: Any) -> Any:
        count[0] += 1
        return again(*args, **options)

    wp.launch, wp.Launch.launch = launched, repeated  # type: ignore[assignment, method-assign]
    try:
        yield count
    finally:
        wp.launch, wp.Launch.launch = launch, again  # type: ignore[method-assign]


def of_frames(frames: list[tuple[float, int]]) -> dict[str, float]:
    """Real-time factor and medians of frames' wall times [s] and numbers of steps."""
    seconds, steps = np.array(frames, dtype=np.float64).T
    return {
        "factor": FRAME * len(frames) / seconds.sum(),
        "frame": float(np.median(seconds)),
        "step": float(np.median(seconds / np.maximum(steps, 1))),
        "a_frame": float(np.median(steps)),
    }


def error_of(row: dict[str, Any], finer: dict[str, Any]) -> float | None:
    """Root mean square of differences of positions, over the body's size."""
    if "failure" in row or "failure" in finer or row["simulated"] != finer["simulated"]:
        return None
    here, there = np.concatenate(row["positions"]), np.concatenate(finer["positions"])
    if here.shape != there.shape:
        return None
    return float(np.sqrt(((here - there) ** 2).sum(axis=-1).mean()) / np.ptp(there, axis=0).max())


def words(row: dict[str, Any]) -> list[str]:
    """The cells of a row."""
    own = [row["scene"], str(row["elements"]), f"{row['young'] / 1e3:g}", f"{row['poisson']:g}", row["steps"]]
    if "failure" in row:
        return [*own, *["–"] * (len(HEADER) - len(own) - 1), row["failure"][:60]]
    scaled = [
        row["simulated"],
        row["factor"],
        1e3 * row["frame"],
        1e3 * row["step"],
        row["a_frame"],
        row.get("launches"),
        row.get("iterations"),
    ]
    rest = [number(each) for each in scaled]
    error = row.get("error")
    ends = [str(row.get("unfinished", "–")), str(row["turned"]), number(row["first"]), number(row["ready"])]
    return [*own, *rest, *ends, "–" if error is None else number(100.0 * error)]


def settings(options: argparse.Namespace, device: wp.Device) -> Iterator[tuple[str, Setting, str]]:
    """The scene, the setting and the name of each row, the smallest bodies first."""
    of_bodies = itertools.product(sorted(options.elements), options.young, options.poisson)
    for (elements, young, poisson), name in itertools.product(of_bodies, options.scenes):
        if elements >= LARGE and name not in LARGE_SCENES:
            continue
        for steps in options.integrators:
            at = Setting(elements, young, poisson, device, steps == "implicit")
            yield name, at, f"{name} {elements} {young:g} {poisson:g} {steps}"


def are_in(asked: str | None, name: str) -> bool:
    return asked is not None and set(asked.split()) <= set(name.split())


def main() -> int:
    options = _parser().parse_args()
    device = checked_device(options.device)
    lines = options.rows.read_text(encoding="utf-8").splitlines() if options.rows and options.rows.exists() else []
    rows = {row["name"]: row for row in map(json.loads, lines)}
    for scene, at, name in settings(options, device):
        if name in rows or not are_in(options.only, name):
            continue
        row = {"name": name, "machine": machine(device), **measured(SCENES[scene], at, options.duration, options.limit)}
        if are_in(options.errors, name) and "failure" not in row:
            finer = Setting(at.elements, at.young, at.poisson, device, at.implicit, 4)
            row["error"] = error_of(row, measured(SCENES[scene], finer, row["simulated"], np.inf))
        row.pop("positions", None)
        rows[name] = row
        tell("  ".join(words(row)))
        if options.rows:
            with options.rows.open("a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")
    print(table(HEADER, [words(row) for row in rows.values()], 1))
    failures = [f"{name}: {row['failure']}" for name, row in rows.items() if "failure" in row]
    for line in failures:
        print(f"FAILED: {line}", file=sys.stderr)
    return int(bool(failures))


def _parser() -> argparse.ArgumentParser:
    of = argparse.ArgumentParser(description=__doc__.split("\n")[0], prog="scenes.py")

    def several(kind: Callable[[str], Any]) -> Callable[[str], list[Any]]:
        return lambda text: [kind(word) for word in text.split(",")]

    def scene(word: str) -> str:
        if word not in SCENES:
            raise argparse.ArgumentTypeError(f"{word!r} is no scene; there are {', '.join(SCENES)}")
        return word

    of.add_argument("--scenes", type=several(scene), default=list(SCENES))
    of.add_argument("--elements", type=several(lambda word: int(float(word))), default=[5000, 20000, 100000])
    of.add_argument("--young", type=several(float), default=[5e3, 3e4])
    of.add_argument("--poisson", type=several(float), default=[0.44, 0.49])
    of.add_argument("--integrators", type=several(str), default=["explicit", "implicit"])
    of.add_argument("--duration", type=float, default=1.0, help="simulated time of a row [s]")
    of.add_argument("--limit", type=float, default=20.0, help="wall time of a row [s]")
    of.add_argument("--only", metavar="WORDS", default="", help="only the rows whose names have these words")
    of.add_argument("--errors", metavar="WORDS", nargs="?", const="", help="rows to run with finer steps, too")
    of.add_argument("--device", help="default: CUDA if there is a card, else the CPU")
    of.add_argument("--rows", type=Path, help="add each row to this file, and leave out those that it has")
    return of


if __name__ == "__main__":
    sys.exit(main())
