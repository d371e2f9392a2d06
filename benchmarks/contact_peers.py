#!/usr/bin/env python3
"""A ball pressed into a cube, here, in MuJoCo's flex and in Newton's VBD: time, force and depth on one CPU core.

    python benchmarks/contact_peers.py [--level 9] [--finer 3] [--json FILE]

A rigid ball of 30 mm radius moves 10 mm into the upper face of a cube of 0.1 m, 5 kPa, whose lower face is held. It
moves for 0.1 s and then stays until 0.3 s, without friction. The table has the mean force of the last 25 ms and the
deepest node at the end. The elastic laws differ: corotated here, St. Venant-Kirchhoff on edges in MuJoCo, neo-Hookean
in VBD. The last row is this package on a finer mesh, which shows how far the others are from convergence. Newton is
left out if it is not installed.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import mujoco
import numpy as np
import warp as wp
from measure import machine, number, table

import warp_corot as wc

HEADER = ("program", "elements", "seconds", "steps", "force N", "deepest mm")
SIZE, RADIUS, DEPTH, GAP = 0.1, 0.03, 0.01, 1e-3
YOUNG, POISSON = 5e3, 0.3
ARRIVES, ENDS, LOOKED = 0.1, 0.3, 0.025
HIGH, LOW = SIZE + RADIUS + GAP, SIZE + RADIUS - DEPTH
#: Radius of its nodes, with which they touch [m].
SKIN = 5e-4
#: Contact of VBD: Newton's own stiffness for soft contacts and a hundred times as much [N/m]; its step [s].
VBD_STIFFNESSES, VBD_STEP = (1e3, 1e5), 1e-3

XML = """
<mujoco>
  <option timestep="{dt}" integrator="{integrator}" gravity="0 0 0"/>
  <worldbody>
    <body mocap="true" pos="{middle} {middle} {high}"><geom type="sphere" size="{radius}"/></body>
    <flexcomp name="body" type="direct" dim="3" mass="1" radius="{skin}" point="{points}" element="{tets}">
      <contact selfcollide="none" condim="1"/>
      <edge equality="false"/>
      <pin id="{held}"/>
      <elasticity young="{young}" poisson="{poisson}" damping="0.005"/>
    </flexcomp>
  </worldbody>
</mujoco>"""


def deepest(points: np.ndarray, radius: float) -> float:
    """Depth of the deepest node in the ball [m]; negative if no node is inside: the gap of the closest node."""
    return float(radius - np.linalg.norm(points - (0.5 * SIZE, 0.5 * SIZE, LOW), axis=1).min())


def ours(mesh: wc.TetForest) -> tuple[float, int, float, float]:
    """Seconds, steps, force [N] and depth [m]."""
    body = wc.SoftBody(mesh, wc.Isotropic(YOUNG, POISSON, 1000.0), device="cpu")
    body.fix("z < 1e-9")
    tool = wc.Tool(wc.Sphere(RADIUS))
    tool.follow([0.0, ARRIVES], [(0.5 * SIZE, 0.5 * SIZE, height) for height in (HIGH, LOW)])
    contact, integrator = wc.Contact(friction=0.0), wc.SymplecticEuler(viscosity=1e-3, damping=20.0)
    sim = wc.Simulation(body, obstacles=tool, contact=contact, gravity=(0.0, 0.0, 0.0), integrator=integrator)
    sim.advance(0.01)
    started = time.process_time()
    sim.advance(ENDS - LOOKED - sim.time)
    forces = []
    for _ in range(10):
        sim.advance(0.1 * LOOKED)
        forces.append(tool.wrench.numpy()[0, 2])
    taken = time.process_time() - started
    return taken, sim.steps, float(np.mean(forces)), deepest(body.positions.numpy().astype(float), RADIUS)


def flex(mesh: wc.TetForest, integrator: str, dt: float) -> tuple[float, int, float, float]:
    """The same for MuJoCo."""
    held = mesh.points[:, 2] < 1e-9
    text = XML.format(
        dt=dt,
        integrator=integrator,
        middle=0.5 * SIZE,
        high=HIGH,
        radius=RADIUS,
        skin=SKIN,
        points=_joined(mesh.points),
        tets=_joined(wc.TetMesh(mesh.points, mesh.tets).tets),
        held=_joined(np.flatnonzero(held)),
        young=YOUNG,
        poisson=POISSON,
    )
    model = mujoco.MjModel.from_xml_string(text)
    masses = wc.SoftBody(mesh, wc.Isotropic(YOUNG, POISSON, 1000.0), device="cpu").masses
    model.body_mass[model.flex_vertbodyid[~held]] = masses[~held]
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)
    steps, forces = 0, []
    started = time.process_time()
    while data.time < ENDS:
        data.mocap_pos[0, 2] = HIGH + (LOW - HIGH) * min(data.time / ARRIVES, 1.0)
        mujoco.mj_step(model, data)
        steps += 1
        if data.time > ENDS - LOOKED:
            forces.append(_force_on_tool(model, data))
    taken = time.process_time() - started
    return taken, steps, float(np.mean(forces)), deepest(data.flexvert_xpos, RADIUS + SKIN)


def _force_on_tool(model: mujoco.MjModel, data: mujoco.MjData) -> float:
    total, wrench = 0.0, np.zeros(6)
    for k in range(data.ncon):
        mujoco.mj_contactForce(model, data, k, wrench)
        total += (data.contact[k].frame.reshape(3, 3).T @ wrench[:3])[2]
    return abs(total)


def newton_rows(mesh: wc.TetForest) -> dict[str, tuple[float, int, float, float]]:
    """VBD with Newton's own contact stiffness and with a large one."""
    try:
        import contact_newton_peer as peer
    except ImportError as error:
        print(f"Newton: left out ({error})", file=sys.stderr)
        return {}

    def place(t: float) -> tuple[float, float, float]:
        return 0.5 * SIZE, 0.5 * SIZE, HIGH + (LOW - HIGH) * min(t / ARRIVES, 1.0)

    masses = wc.SoftBody(mesh, wc.Isotropic(YOUNG, POISSON, 1000.0), device="cpu").masses
    rows = {}
    for stiffness in VBD_STIFFNESSES:
        found = peer.vbd(mesh, (YOUNG, POISSON), (RADIUS, place), masses, SKIN, stiffness, VBD_STEP, ENDS, LOOKED)
        rows[f"{peer.NAME}, {stiffness:g} N/m, {1e3 * VBD_STEP:g} ms"] = (*found[:3], deepest(found[3], RADIUS + SKIN))
    return rows


def _joined(values: np.ndarray) -> str:
    return " ".join(map(repr, values.ravel().tolist()))


def main() -> None:
    """Print the table."""
    of = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    of.add_argument("--level", type=int, default=9, help="level of the bisected cube")
    of.add_argument(
        "--finer", type=int, default=3, metavar="LEVELS", help="levels that the reference is finer; 0: none"
    )
    of.add_argument("--json", type=Path, metavar="FILE", help="write everything to this file, too")
    options = of.parse_args()
    mesh = wc.TetForest.box((1, 1, 1), SIZE, options.level)
    finer = wc.TetForest.box((1, 1, 1), SIZE, options.level + options.finer)
    flexed = f"MuJoCo {mujoco.__version__}, flex"
    found = {
        "warp-corot": ours(mesh),
        f"{flexed}, discrete, 1 ms": flex(mesh, "discrete", 1e-3),
        f"{flexed}, Euler, 0.2 ms": flex(mesh, "Euler", 2e-4),
        **newton_rows(mesh),
    }
    rows = [[name, len(mesh.tets), *row[:3], 1e3 * row[3]] for name, row in found.items()]
    if options.finer > 0:
        row = ours(finer)
        rows.append(["warp-corot, finer", len(finer.tets), *row[:3], 1e3 * row[3]])
    about = machine(wp.get_device("cpu"))
    print(f"{about['name']}, Warp {about['warp']}")
    print(
        table(
            HEADER, [[number(each) if isinstance(each, float) else str(each) for each in row] for row in rows], left=1
        )
    )
    if options.json:
        options.json.write_text(json.dumps({**about, "rows": [dict(zip(HEADER, row, strict=True)) for row in rows]}))


if __name__ == "__main__":
    main()
