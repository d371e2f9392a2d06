"""How stiff are the two layers of a block? Their moduli are found from the motion of its surface under a load.

A stiff layer lies below a soft one, or the other way round, where nobody can test it by itself. The displacements of
the upper face under a push and a shear are measured. Here they are computed from known moduli, to see whether these are
found again. SciPy's L-BFGS-B minimises the misfit; one adjoint solve gives its gradient for any number of moduli.
"""

import argparse
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

import warp_corot as wc

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--device", help="cpu or cuda:0")
parser.add_argument("-o", "--output", default="two_layers.usd", type=Path)
parser.add_argument("--duration", type=float, default=1.0, help="seconds simulated")
parser.add_argument("--moduli", type=float, nargs=2, default=(4e3, 15e3), help="of the upper and the lower layer, Pa")
args = parser.parse_args()

mesh = wc.TetForest.box(cells=(2, 2, 2), cell_size=0.03, level=3)
upper = (mesh.points[mesh.tets].mean(axis=1)[:, 1] > 0.03).astype(int)
face = mesh.points[:, 1] > 0.06 - 1e-9
pushed = face & (mesh.points[:, 0] < 0.02)


def block(moduli):
    young = np.where(upper, *moduli)  # of each element
    body = wc.SoftBody(mesh, wc.Isotropic(young, poisson=0.4, density=1000.0), device=args.device)
    body.fix(mesh.points[:, 1] < 1e-9)
    body.load(pushed, np.array([0.4, -0.8, 0.0]) / pushed.sum())
    return body


truth = block(args.moduli)
wc.solve_static(truth)
measured = truth.positions.numpy()[face]


def misfit(positions):
    """Half of the sum of squares over the face [mm^2], and its derivative."""
    off = np.zeros_like(mesh.points)
    off[face] = positions.numpy()[face] - measured
    return 0.5e6 * np.sum(off**2), 1e6 * off


def cost(logarithms):
    moduli = np.exp(logarithms)
    found = wc.static_gradient(block(moduli), misfit, wrt="young")
    return found.value, moduli * [found.young[upper == 1].sum(), found.young[upper == 0].sum()]


end = minimize(cost, np.log([8e3, 8e3]), jac=True, method="L-BFGS-B", options={"ftol": 1e-12, "gtol": 1e-7})
found = np.exp(end.x)
print(f"{end.nfev} static answers; the upper layer has {found[0]:.0f} Pa, and the lower one {found[1]:.0f} Pa")
sim = wc.Simulation(block(found), integrator=wc.SymplecticEuler(damping=10.0))
wc.record(sim, args.output, duration=args.duration)
print(f"wrote {args.output}")
