"""How far does a beam sag? 256 of the paper's beams, each with a different Young's modulus, hang in one run.

Copies of a body are stepped together. The sag of the free end is drawn over Young's modulus (with matplotlib, if
installed) beside Timoshenko's beam theory, which holds for small strains. Stiff beams sag by 0.75 of the theory's sag,
because the mesh is coarse for a nearly incompressible material (at level 9 it is 0.86). Soft beams hang. The stage
shows the softest one. The run takes a minute on one CPU core.
"""

import argparse
from pathlib import Path

import numpy as np

import warp_corot as wc

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--device", help="cpu or cuda:0")
parser.add_argument("-o", "--output", default="sweep.usd", type=Path)
parser.add_argument("--duration", type=float, default=1.0, help="seconds simulated")
parser.add_argument("--beams", type=int, default=256)
args = parser.parse_args()

SIDE, LENGTH, POISSON, DENSITY, GRAVITY = 0.064, 0.192, 0.49, 10.0, 9.8
young = np.geomspace(100.0, 10000.0, args.beams)  # [Pa]

mesh = wc.TetForest.box(cells=(1, 1, 3), cell_size=SIDE, level=6)
material = wc.Isotropic(young=young[:, None], poisson=POISSON, density=DENSITY)  # [worlds, 1]: one for each world
body = wc.SoftBody(mesh, material, worlds=args.beams, device=args.device)
body.fix(mesh.points[:, 2] < 1e-9)

sim = wc.Simulation(body, integrator=wc.SymplecticEuler(damping=15.0), gravity=(0, -GRAVITY, 0))
tip = np.argmin(np.linalg.norm(mesh.points - [SIDE / 2, SIDE / 2, LENGTH], axis=1))
wc.record(sim, args.output, duration=args.duration, world=0)
sag = -body.displacements.numpy().reshape(args.beams, -1, 3)[:, tip, 1]

# Bending and shear under the beam's own weight; Cowper's shear coefficient of a square.
shear_modulus, coefficient = young / (2 * (1 + POISSON)), 10 * (1 + POISSON) / (12 + 11 * POISSON)
bending = 12 * DENSITY * GRAVITY * LENGTH**4 / (8 * young * SIDE**2)
theory = bending + DENSITY * GRAVITY * LENGTH**2 / (2 * coefficient * shear_modulus)

for k in np.linspace(0, args.beams - 1, 9).astype(int):
    print(f"E {young[k]:7.0f} Pa   sag {1e3 * sag[k]:6.2f} mm   {sag[k] / theory[k]:5.2f} of beam theory's")
try:
    from matplotlib.figure import Figure
except ImportError:
    print("no picture: it needs matplotlib")
else:
    ax = (figure := Figure(figsize=(7, 4.2), layout="constrained")).subplots()
    ax.loglog(young, 1e3 * theory, color="#8a8590", label="beam theory, bending and shear")
    ax.loglog(young, 1e3 * sag, ".", color="#1f6f8b", markersize=4, label=f"{args.beams} beams, corotated")
    ax.set(xlabel="Young's modulus, Pa", ylabel="sag of the free end, mm")
    ax.legend(frameon=False)
    figure.savefig(args.output.with_suffix(".png"), dpi=150)
print(f"wrote {args.output}")
