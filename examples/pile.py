"""Soft cubes and balls fall into a pit between four slopes and come to rest on one another, with friction."""

import argparse

import numpy as np

import warp_corot as wc

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--device", help="cpu or cuda:0")
parser.add_argument("-o", "--output", default="pile.usd")
parser.add_argument("--duration", type=float, default=1.2, help="seconds simulated")
args = parser.parse_args()

EDGE, SLOPE = 0.04, 0.6  # of a cube [m]; of the pit's sides
cube = wc.TetForest.box(cells=(1, 1, 1), cell_size=EDGE, level=3)
ball = wc.TetForest.from_domain(wc.Domain.sphere(0.5 * EDGE, up_axis="Z"), target_elements=300)
bodies = []
for k in range(8):
    mesh, centre = (cube, 0.5 * EDGE) if k % 2 else (ball, 0.0)
    body = wc.SoftBody(mesh, wc.Isotropic(young=2e4, poisson=0.4, density=1000.0), device=args.device)
    angle = 2.4 * k  # round the middle, each higher than the last
    place = np.array([0.6 * EDGE * np.cos(angle), 0.6 * EDGE * np.sin(angle), EDGE * (1.2 + 1.1 * k)])
    body.displacements = np.broadcast_to(place - centre, mesh.points.shape)
    bodies.append(body)

pit = [wc.Ground(normal=(SLOPE * x, SLOPE * y, 1.0), offset=0.0) for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1))]
sim = wc.Simulation(
    bodies,
    obstacles=pit,
    contact=wc.Contact(friction=0.4),
    gravity=(0.0, 0.0, -9.81),
    integrator=wc.SymplecticEuler(damping=1.0, viscosity=2e-3),
)
wc.record(sim, args.output, duration=args.duration, tets=True)
weight = 9.81 * sum(body.masses.sum() for body in bodies)
borne = -sum(side.wrench.numpy()[0, 2] for side in pit)
print(f"the pit bears {borne:.2f} N, the bodies weigh {weight:.2f} N; wrote {args.output}")
