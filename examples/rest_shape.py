"""In what shape must a beam be made so that it is straight under its weight? The search varies its rest shape.

The rest positions of all nodes are unknown. One adjoint solve gives the derivative, with respect to all of them, of the
misfit between the sagging beam and a straight one; SciPy's L-BFGS-B minimises the misfit. The stage shows the result:
the beam begins as it was made, bent upwards, and sags until it is straight.
"""

import argparse
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

import warp_corot as wc

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--device", help="cpu or cuda:0")
parser.add_argument("-o", "--output", default="rest_shape.usd", type=Path)
parser.add_argument("--duration", type=float, default=1.0, help="seconds simulated")
args = parser.parse_args()

GRAVITY = (0.0, -9.8, 0.0)
forest = wc.TetForest.box(cells=(1, 1, 3), cell_size=0.064, level=3)
straight, tets = np.asarray(forest.points), forest.tets
held = straight[:, 2] < 1e-9
material = wc.Isotropic(young=1e5, poisson=0.4, density=1000.0)


def made_as(points):
    body = wc.SoftBody(wc.TetMesh(points, tets), material, device=args.device)
    body.fix(held)
    return body


def misfit(positions):
    """Half of the sum of squares [mm^2], and its derivative."""
    off = positions.numpy() - straight
    return 0.5e6 * np.sum(off**2), 1e6 * off


def cost(moved):
    points = straight.copy()
    points[~held] += 1e-3 * moved.reshape(-1, 3)  # [mm], which scales the search
    found = wc.static_gradient(made_as(points), misfit, wrt="rest", gravity=GRAVITY)
    return found.value, 1e-3 * found.rest[~held].ravel()


start = np.zeros(3 * np.count_nonzero(~held))
before = np.sqrt(2.0 * cost(start)[0] / len(straight))
end = minimize(cost, start, jac=True, method="L-BFGS-B", options={"maxiter": 200, "ftol": 1e-5})
after = np.sqrt(2.0 * end.fun / len(straight))
print(f"{end.nfev} static answers; nodes are off by {before:.2f} mm before, {after:.4f} mm in the end")

points = straight.copy()
points[~held] += 1e-3 * end.x.reshape(-1, 3)
print(f"the end is made {1e3 * (points - straight)[:, 1].max():.1f} mm higher than it hangs")
sim = wc.Simulation(made_as(points), integrator=wc.SymplecticEuler(damping=10.0), gravity=GRAVITY)
wc.record(sim, args.output, duration=args.duration)
print(f"wrote {args.output}")
