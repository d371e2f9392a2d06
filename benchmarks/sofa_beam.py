#!/usr/bin/env python3
"""The beam of SOFA's benchmark scene ``TetrahedronFEMForceField_beam10x10x40``, in this package.

    python benchmarks/sofa_beam.py [--steps 200] [--device cpu]

40 x 10 x 10 points, 18,954 tetrahedra, 16 x 4 x 4 m, 50 kg, E = 2 kPa, nu = 0.3, held at one end, backward Euler of
10 ms with Rayleigh damping of 0.1 1/s and 0.1 s. SOFA stops its conjugate gradients after 20 iterations; here they run
to their tolerance. Its authors gave 23.5 steps a second on a CPU and 158 on a card (sofa-framework/sofa, pull request
2561); SOFA is not run here.
"""

from __future__ import annotations

import argparse
import sys
import time

import numpy as np
import warp as wp
from measure import machine

import warp_corot as wc

POINTS, SIZE = np.array([40, 10, 10]), np.array([16.0, 4.0, 4.0])
#: The corners of the six tetrahedra of a cell, along its diagonal.
PATHS = [(0, 1, 3, 7), (0, 1, 5, 7), (0, 2, 3, 7), (0, 2, 6, 7), (0, 4, 5, 7), (0, 4, 6, 7)]


def beam() -> wc.TetMesh:
    points = np.stack(np.meshgrid(*map(np.arange, POINTS), indexing="ij"), -1).reshape(-1, 3)
    numbers = np.arange(len(points)).reshape(POINTS)
    ends = slice(None, -1), slice(1, None)
    corners = [numbers[i, j, k] for k in ends for j in ends for i in ends]
    cells = np.stack([each.ravel() for each in corners], -1)
    tets = cells[:, PATHS].reshape(-1, 4)
    x = points * (SIZE / (POINTS - 1))
    turned = np.linalg.det(x[tets[:, 1:]] - x[tets[:, :1]]) < 0.0
    tets[turned] = tets[turned][:, [0, 2, 1, 3]]
    return wc.TetMesh(x, tets)


def main() -> int:
    of = argparse.ArgumentParser(description=__doc__.split("\n")[0], prog="sofa_beam.py")
    of.add_argument("--steps", type=int, default=200)
    of.add_argument("--device", default="cpu")
    options = of.parse_args()
    body = wc.SoftBody(beam(), wc.Isotropic(2000.0, 0.3, 50.0 / SIZE.prod()), device=options.device)
    body.fix("x == xmin")
    integrator = wc.BackwardEuler(0.01, damping=0.1, viscosity=0.1)
    sim = wc.Simulation(body, integrator=integrator, gravity=(0.0, -9.0, 0.0))
    times = []
    for _ in range(options.steps):
        started = time.perf_counter()
        sim.advance(0.01)
        wp.synchronize_device(body.device)
        times.append(1e3 * (time.perf_counter() - started))
    solves = sim.solves
    assert solves is not None
    print(", ".join(str(value) for value in machine(body.device).values()))
    print(f"{len(body.mesh.tets)} tetrahedra: {np.median(times):.2f} ms a step, {np.min(times):.2f} at best")
    print(
        f"{solves.linear_iterations / solves.steps:.1f} linear iterations a step, {solves.unfinished} unfinished solves"
    )
    sag = float(body.mesh.points[:, 1].min() - body.positions.numpy()[:, 1].min())
    print(f"the end is {sag:.2f} m lower after {sim.time:.2f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
