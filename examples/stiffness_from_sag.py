"""How stiff is a beam? Young's modulus is found from the measured sag of the free end.

For each guess, one static answer and one adjoint solve give the sag and its derivative with respect to Young's modulus.
Newton's method on the logarithms of both needs about four guesses, even where soft beams hang rather than bend. The
stage shows the beam with the modulus that was found, released from its rest shape.
"""

import argparse
from pathlib import Path

import numpy as np

import warp_corot as wc

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--device", help="cpu or cuda:0")
parser.add_argument("-o", "--output", default="stiffness.usd", type=Path)
parser.add_argument("--duration", type=float, default=1.0, help="seconds simulated")
parser.add_argument("--sag", type=float, default=0.03, help="measured sag of the free end, m")
args = parser.parse_args()

GRAVITY = (0.0, -9.8, 0.0)
mesh = wc.TetForest.box(cells=(1, 1, 3), cell_size=0.064, level=3)
tip = mesh.points[:, 2] > 0.192 - 1e-9


def beam(young):
    body = wc.SoftBody(mesh, wc.Isotropic(young, poisson=0.4, density=1000.0), device=args.device)
    body.fix(mesh.points[:, 2] < 1e-9)
    return body


def sag(positions):
    """The mean sag of the end, and its derivative with respect to positions."""
    weights = np.zeros_like(mesh.points)
    weights[tip, 1] = -1.0 / tip.sum()
    return np.sum(weights * (positions.numpy() - mesh.points)), weights


young = 1e4
for guess in range(20):
    found = wc.static_gradient(beam(young), sag, wrt="young", gravity=GRAVITY)
    print(f"guess {guess}: {young:10.2f} Pa sags by {1e3 * found.value:.4f} mm")
    if abs(found.value - args.sag) < 1e-5 * args.sag:
        break
    slope = found.young * young / found.value  # of log sag over log young
    young *= np.exp(np.clip((np.log(args.sag) - np.log(found.value)) / slope, -2.0, 2.0))

sim = wc.Simulation(beam(young), integrator=wc.SymplecticEuler(damping=10.0), gravity=GRAVITY)
wc.record(sim, args.output, duration=args.duration)
print(f"Young's modulus is {young:.1f} Pa; wrote {args.output}")
