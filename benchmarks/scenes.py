#!/usr/bin/env python3
"""The standing scenes: organs as users have them, on a table, under a tool, in one another's way.

    python benchmarks/scenes.py [--device cuda:0] [--scenes standing,dropped] [--elements 20000,100000]
        [--young 5e3,3e4] [--poisson 0.44,0.49] [--integrators explicit,implicit] [--duration 1] [--limit 20]
        [--errors] [--json FILE]

Explicit steps follow the state; implicit ones are ``BackwardEuler`` of 1/60 s. A row simulates ``--duration`` seconds,
or as much of them as ``--limit`` seconds of wall time after the first frame allow, in frames of 1/60 s. Its real-time
factor is simulated over wall time after the first frame. That one is given apart, because it has what is compiled or
recorded when steps begin. A scene that ends in an error or in positions that are not finite is a failure. ``--errors``
compares positions at the end with the same scene in a quarter of the step and with a tenth of the tolerances, over the
body's size.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
import warp.examples
from measure import machine, number, save, table, tell
from scipy.spatial import cKDTree

import warp_corot as wc
from warp_corot.inputs.device import checked_device

FRAME = 1.0 / 60.0
DOWN = (0.0, -9.81, 0.0)
HEADER = (
    *("scene", "elements", "kPa", "nu", "steps", "simulated, s", "real time", "ms a frame", "ms a step"),
    "steps a frame",
    *("iterations", "unfinished", "first frame, s", "ready, s", "error, %"),
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


# --- rows ------------------------------------------------------------------------------------------------------------


def measured(scene: Callable[[Setting], wc.Simulation], at: Setting, duration: float, limit: float) -> dict[str, Any]:
    """A row: one scene, in one setting."""
    row: dict[str, Any] = {
        "scene": scene.__name__,
        "elements": at.elements,
        "young": at.young,
        "poisson": at.poisson,
        "steps": "implicit" if at.implicit else "explicit",
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
        if not all(np.isfinite(each).all() for each in row["positions"]):
            row["failure"] = "positions are not finite"
    except Exception as error:
        row["failure"] = f"{type(error).__name__}: {error}"
    return row


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
        row.get("iterations"),
    ]
    rest = [number(each) for each in scaled]
    error = row.get("error")
    ends = [str(row.get("unfinished", "–")), number(row["first"]), number(row["ready"])]
    return [*own, *rest, *ends, "–" if error is None else number(100.0 * error)]


def main() -> int:
    options = _parser().parse_args()
    device = checked_device(options.device)
    rows: list[dict[str, Any]] = []
    for elements in options.elements:
        for young in options.young:
            for poisson in options.poisson:
                for name in options.scenes:
                    for steps in options.integrators:
                        at = Setting(elements, young, poisson, device, steps == "implicit")
                        row = measured(SCENES[name], at, options.duration, options.limit)
                        if options.errors and "failure" not in row:
                            finer = Setting(elements, young, poisson, device, steps == "implicit", 4)
                            other = measured(SCENES[name], finer, row["simulated"], np.inf)
                            row["error"] = error_of(row, other)
                        row.pop("positions", None)
                        rows.append(row)
                        tell("  ".join(words(row)))
    print(table(HEADER, [words(row) for row in rows], 1))
    if options.json:
        save(options.json, {**machine(device), "rows": rows})
    failures = [row for row in rows if "failure" in row]
    for row in failures:
        print(f"FAILED: {row['scene']}, {row['elements']} elements, {row['steps']}: {row['failure']}", file=sys.stderr)
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
    of.add_argument("--errors", action="store_true", help="also run with finer steps, and compare")
    of.add_argument("--device", help="default: CUDA if there is a card, else the CPU")
    of.add_argument("--json", type=Path, help="write the rows to this file")
    return of


if __name__ == "__main__":
    sys.exit(main())
