"""A probe presses a block of tissue on a table, strokes it and lifts off: contact with friction, and its force."""

import argparse

import numpy as np

import warp_corot as wc

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--device", help="cpu or cuda:0")
parser.add_argument("-o", "--output", default="press.usd")
parser.add_argument("--duration", type=float, default=1.5, help="seconds simulated")
args = parser.parse_args()

mesh = wc.TetForest.box(cells=(4, 3, 1), cell_size=0.03, level=4, origin=(0.0, 0.0, 0.0))  # 12 x 9 x 3 cm
body = wc.SoftBody(mesh, wc.Isotropic(young=5e3, poisson=0.45, density=1060.0), device=args.device)

table = wc.Ground(normal=(0, 0, 1), offset=0.0, friction=0.8)
probe = wc.Tool(wc.Capsule(radius=0.008, length=0.1))
TOP = 0.03 + 0.008 + 0.05  # height of the probe's centre when it touches [m]
probe.follow(
    times=[0.0, 0.2, 0.5, 1.1, 1.3],
    positions=[
        (0.04, 0.045, TOP + 0.005),
        (0.04, 0.045, TOP - 0.005),
        (0.04, 0.045, TOP - 0.012),
        (0.08, 0.045, TOP - 0.012),
        (0.08, 0.045, TOP + 0.02),
    ],
)
sim = wc.Simulation(
    body,
    obstacles=[table, probe],
    contact=wc.Contact(friction=0.2),
    gravity=(0.0, 0.0, -9.81),
    integrator=wc.SymplecticEuler(damping=2.0, viscosity=2e-3),
)


def watch(sim):
    force = probe.wrench.numpy()[0][:3]
    print(f"{sim.time:5.2f} s   force on the probe {np.array2string(force, precision=2, suppress_small=True)} N")


sim.on_step(watch, every=round(0.1 / sim.dt))
wc.record(sim, args.output, duration=args.duration)
print(f"wrote {args.output}")
