"""A rubber bar is twisted by a full turn along keyframes, held, and released."""

import argparse

import numpy as np

import warp_corot as wc

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--device", help="cpu or cuda:0")
parser.add_argument("-o", "--output", default="twist.usd")
parser.add_argument("--duration", type=float, default=4.0, help="seconds simulated")
args = parser.parse_args()

mesh = wc.TetForest.box(cells=(5, 1, 1), cell_size=0.04, level=6)
body = wc.SoftBody(mesh, wc.Isotropic(young=5e4, poisson=0.4, density=1000.0), device=args.device)
x = mesh.points
left, right = np.flatnonzero(x[:, 0] < 1e-9), np.flatnonzero(x[:, 0] > 0.2 - 1e-9)
body.fix(left)

# Keyframes of the right end: 33 for one turn, since nodes move straight between keyframes.
times = np.linspace(0.0, 2.0, 33)
arm = x[right] - [0.2, 0.02, 0.02]
angle = 2.0 * np.pi * (0.5 - 0.5 * np.cos(np.pi * times / 2.0))[:, None]
turned = np.stack(
    [
        np.zeros((len(times), len(right))),
        np.cos(angle) * arm[:, 1] - np.sin(angle) * arm[:, 2],
        np.sin(angle) * arm[:, 1] + np.cos(angle) * arm[:, 2],
    ],
    axis=-1,
)
body.prescribe(right, times=times, displacements=turned - [0.0, 1.0, 1.0] * arm)

sim = wc.Simulation(body, integrator=wc.SymplecticEuler(damping=6.0), gravity=(0.0, 0.0, 0.0))


def watch(sim):
    moment = np.cross(body.positions.numpy()[left] - [0.0, 0.02, 0.02], body.reactions.numpy()[left]).sum(axis=0)
    print(f"{sim.time:5.2f} s   moment at the fixed end {1e3 * moment[0]:+8.2f} N mm")
    if sim.time > 2.5:
        body.release(right)


sim.on_step(watch, every=round(0.25 / sim.dt))
wc.record(sim, args.output, duration=args.duration)
print(f"wrote {args.output}")
