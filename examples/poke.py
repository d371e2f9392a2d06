"""A fingertip presses into a slab of soft tissue and circles over it: nodal loads that change during the run."""

import argparse

import numpy as np

import warp_corot as wc

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--device", help="cpu or cuda:0")
parser.add_argument("-o", "--output", default="poke.usd")
parser.add_argument("--duration", type=float, default=3.0, help="seconds simulated")
args = parser.parse_args()

mesh = wc.TetForest.box(cells=(4, 1, 4), cell_size=0.03, level=6)  # 12 cm wide, 3 cm thick
body = wc.SoftBody(mesh, wc.Isotropic(young=1e4, poisson=0.45, density=1000.0), device=args.device)
x = mesh.points
body.fix(x[:, 1] < 1e-9)
top = np.flatnonzero(x[:, 1] > 0.03 - 1e-9)

sim = wc.Simulation(body, integrator=wc.SymplecticEuler(damping=20.0))
FORCE, RADIUS = 2.0, 0.012  # of the whole fingertip [N], [m]


def press(sim):
    turn = 2.0 * np.pi * sim.time / 1.5
    center = 0.06 + 0.03 * np.array([np.cos(turn), np.sin(turn)])
    share = np.exp(-np.sum((x[top][:, [0, 2]] - center) ** 2, axis=1) / RADIUS**2)
    down = -FORCE * min(sim.time / 0.3, 1.0) * share / share.sum()
    body.load(top, np.outer(down, [0.0, 1.0, 0.0]))


def watch(sim):
    print(f"{sim.time:5.2f} s   deepest {-1e3 * body.displacements.numpy()[top, 1].min():5.2f} mm")


sim.on_step(press, every=round(0.01 / sim.dt))
sim.on_step(watch, every=round(0.5 / sim.dt))
wc.record(sim, args.output, duration=args.duration)
print(f"wrote {args.output}")
