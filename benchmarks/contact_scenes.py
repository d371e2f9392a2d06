#!/usr/bin/env python3
"""The same gripper and the same pile here, in MuJoCo's flex and in Newton's VBD: time and errors; one CPU core.

    python benchmarks/contact_scenes.py [gripper] [pile] [--level 5] [--json FILE]

Gripper: two rigid plates squeeze a soft cube of 4 cm that stands on the ground, by 3 mm each, and lift it by 30 mm.
Pile: three cubes fall 1 mm onto the ground and onto one another. The table says how far the lowest cube was lifted, how
far a cube has moved aside, the force of a plate or of the ground over the weight, and how deep the deepest node is.
Newton is left out where it is not installed.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import warp as wp
from measure import machine, number, table

import warp_corot as wc

HEADER = ("scene", "program", "elements", "seconds", "steps", "lifted mm", "aside mm", "force / weight", "deepest mm")
SIZE, POISSON, DENSITY, GRAVITY = 0.04, 0.3, 1000.0, 9.81
#: Half of a plate's sides [m], and how far it goes into the cube and up.
PLATE, SQUEEZED, LIFTED = (0.025, 0.005, 0.025), 0.003, 0.03
FRICTION, GAP = 0.8, 1e-3
#: Of this package's bodies, as MuJoCo's damping [s]. VBD is damped by its steps.
VISCOSITY = 5e-3

Points = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Scene:
    """Soft cubes on the ground, and plates that move.

    Attributes:
        name: What it is.
        young: Young's modulus [Pa].
        meshes: The cubes' meshes.
        keys: Times of the plates' keyframes [s].
        ways: For each plate its places at these times [m].
        ends: When it ends [s]; forces are averaged over its last eighth.
    """

    name: str
    young: float
    meshes: tuple[wc.TetForest, ...]
    keys: tuple[float, ...]
    ways: tuple[Points, ...]
    ends: float

    @property
    def looked(self) -> float:
        return self.ends / 8.0

    @property
    def weight(self) -> float:
        """Of all cubes [N]."""
        return len(self.meshes) * SIZE**3 * DENSITY * GRAVITY

    def place(self, way: Points, t: float) -> Points:
        """Where a plate is at a time [m]."""
        return np.array([np.interp(t, self.keys, way[:, axis]) for axis in range(3)])


@dataclass(frozen=True)
class Outcome:
    """What a program found.

    Attributes:
        seconds: Processor time.
        steps: How many.
        ground, plate: Mean force on the ground and across one plate [N].
        points: Nodes of each cube at the end [m].
        skin: The radius that its nodes have [m].
    """

    seconds: float
    steps: int
    ground: float
    plate: float
    points: list[Points]
    skin: float = 0.0


def cube(level: int, height: float) -> wc.TetForest:
    return wc.TetForest.box((1, 1, 1), SIZE, level, origin=(-0.5 * SIZE, -0.5 * SIZE, height))


def gripper(level: int) -> Scene:
    """Plates at two sides."""
    out, into = 0.5 * SIZE + PLATE[1] + GAP, 0.5 * SIZE + PLATE[1] - SQUEEZED
    middle, top = 0.5 * SIZE + 0.006, 0.5 * SIZE + 0.006 + LIFTED
    ways = tuple(np.array([(0.0, s * y, z) for y, z in ((out, middle), (into, middle), (into, top))]) for s in (-1, 1))
    return Scene("gripper", 5e3, (cube(level, 0.0),), (0.0, 0.1, 0.4), ways, 0.8)


def pile(level: int) -> Scene:
    """Three cubes, one above the other."""
    return Scene("pile", 2e4, tuple(cube(level, GAP + k * (SIZE + GAP)) for k in range(3)), (), (), 1.6)


def ours(scene: Scene) -> Outcome:
    """Explicit steps of this package."""
    material = wc.Isotropic(scene.young, POISSON, DENSITY)
    bodies = [wc.SoftBody(mesh, material, device="cpu") for mesh in scene.meshes]
    ground, plates = wc.Ground(), [wc.Tool(wc.Box(tuple(2.0 * half for half in PLATE))) for _ in scene.ways]
    for tool, way in zip(plates, scene.ways, strict=True):
        tool.follow(scene.keys, way)
    sim = wc.Simulation(
        bodies,
        obstacles=[ground, *plates],
        contact=wc.Contact(friction=FRICTION),
        gravity=(0.0, 0.0, -GRAVITY),
        integrator=wc.SymplecticEuler(viscosity=VISCOSITY),
    )
    sim.advance_steps(2)  # compiles
    started, felt = time.process_time(), []
    sim.advance(scene.ends - scene.looked - sim.time)
    for _ in range(20):
        sim.advance(scene.looked / 20)
        across = plates[0].wrench.numpy()[0, 1] if plates else 0.0
        felt.append((abs(ground.wrench.numpy()[0, 2]), abs(across)))
    taken = time.process_time() - started
    on_ground, on_plate = np.mean(felt, axis=0)
    points = [body.positions.numpy().astype(float) for body in bodies]
    return Outcome(taken, sim.steps, on_ground, on_plate, points)


def deepest(scene: Scene, found: Outcome) -> float:
    """How deep nodes are in the ground, in plates, or in the cube below [m]; negative for the gap of the closest."""
    depths = [found.skin - float(points[:, 2].min()) for points in found.points]
    for way in scene.ways:
        off = np.abs(found.points[0] - way[-1]) - PLATE
        depths.append(found.skin - float(off.max(axis=1).min()))
    for k in range(len(scene.meshes) - 1):
        low, high = (each.points for each in scene.meshes[k : k + 2])
        top, bottom = (
            np.flatnonzero(np.abs(p[:, 2] - end) < 1e-9)
            for p, end in ((low, low[:, 2].max()), (high, high[:, 2].min()))
        )
        # Nodes face one another: the meshes are alike.
        order = [each[np.lexsort(p[each, :2].T)] for each, p in ((top, low), (bottom, high))]
        apart = found.points[k + 1][order[1], 2] - found.points[k][order[0], 2]
        depths.append(2.0 * found.skin - float(apart.min()))
    return max(depths)


def row(scene: Scene, name: str, found: Outcome) -> list[str | int | float]:
    lifted = float(found.points[0][:, 2].mean() - scene.meshes[0].points[:, 2].mean())
    force = (found.plate if scene.ways else found.ground) / scene.weight
    elements = sum(len(mesh.tets) for mesh in scene.meshes)
    aside = max(float(np.abs(points[:, :2].mean(axis=0)).max()) for points in found.points)
    measured = (1e3 * lifted, 1e3 * aside, force, 1e3 * deepest(scene, found))
    return [scene.name, name, elements, found.seconds, found.steps, *measured]


def programs(scene: Scene) -> dict[str, Outcome]:
    import contact_scenes_mujoco as flex

    found = {"warp-corot": ours(scene), flex.NAME: flex.outcome(scene)}
    try:
        import contact_scenes_newton as vbd
    except ImportError as error:
        print(f"Newton: left out ({error})", file=sys.stderr)
        return found
    return found | {f"{vbd.NAME}, {stiffness:g} N/m": vbd.outcome(scene, stiffness) for stiffness in vbd.STIFFNESSES}


def main() -> None:
    """Print the table."""
    of = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    of.add_argument("scenes", nargs="*", choices=["gripper", "pile", []], help="which (default: both)")
    of.add_argument("--level", type=int, default=5, help="level of the bisected cubes")
    of.add_argument("--json", type=Path, metavar="FILE", help="write everything to this file, too")
    options = of.parse_args()
    rows = []
    for make in (gripper, pile):
        if not options.scenes or make.__name__ in options.scenes:
            scene = make(options.level)
            rows += [row(scene, name, found) for name, found in programs(scene).items()]
    about = machine(wp.get_device("cpu"))
    print(f"{about['name']}, Warp {about['warp']}")
    print(
        table(HEADER, [[number(each) if isinstance(each, float) else str(each) for each in of] for of in rows], left=2)
    )
    if options.json:
        options.json.write_text(json.dumps({**about, "rows": [dict(zip(HEADER, of, strict=True)) for of in rows]}))


if __name__ == "__main__":
    main()
