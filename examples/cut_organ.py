"""A blade slices an organ while two hands pull it apart, and the force that it feels."""

import argparse

import numpy as np

import warp_corot as wc

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--device", help="cpu or cuda:0")
parser.add_argument("-o", "--output", default="cut_organ.usd")
parser.add_argument("--duration", type=float, default=1.2, help="seconds simulated")
args = parser.parse_args()


def lobe(x):
    """A flat ellipsoid with a dent, 12 x 8 x 4 cm; negative inside."""
    radius = np.linalg.norm(x / [0.06, 0.04, 0.02], axis=1)
    dent = np.linalg.norm((x - [0.0, 0.055, 0.0]) / [0.03, 0.025, 0.04], axis=1)
    return 0.02 * np.maximum(radius - 1.0, 1.0 - dent)


organ = wc.Domain.from_function(lobe, bounds=[(-0.06, -0.04, -0.02), (0.06, 0.04, 0.02)])
mesh = wc.TetForest.from_domain(organ, cell_size=0.02, max_level=5)
tissue = wc.Isotropic(young=8e3, poisson=0.45, density=1060.0, toughness=3.0)
body = wc.SoftBody(mesh, tissue, device=args.device)
for side, pull in ((-1.0, "x < xmin + 0.02"), (1.0, "x > xmax - 0.02")):
    body.prescribe(pull, times=[0.0, 1.2], displacements=[[0, 0, 0], [side * 0.01, 0, 0]])

blade = wc.Blade(edge=[(0, 0, -0.03), (0, 0, 0.03)], position=(0.002, 0.045, 0.0))
blade.follow(times=[0.0, 1.0], positions=[(0.002, 0.045, 0.0), (0.002, -0.05, 0.0)])
sim = wc.Simulation(
    body,
    cuts=[blade],
    contact=wc.Contact(friction=0.2, self_contact=True),
    gravity=(0.0, 0.0, -9.81),
    integrator=wc.SymplecticEuler(damping=10.0),
)


def watch(sim):
    force, work = blade.wrench.numpy()[0][1], 1e3 * blade.work
    print(f"{sim.time:5.2f} s   {body.pieces} piece(s), {1e4 * body.cut_area:5.2f} cm², {force:5.2f} N, {work:5.2f} mJ")


sim.on_step(watch, every=round(0.2 / sim.dt))
wc.record(sim, args.output, duration=args.duration, tets=True)
print(f"wrote {args.output}")
