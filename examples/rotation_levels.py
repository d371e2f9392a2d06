"""How many rotations does a bending beam need? Eight beams have their rotations from levels 0 to 6 of the tree, or
from every element.

At level 0 the whole beam of 1,152 tetrahedra has 18 rotations; each level doubles them. The script prints the distance
of each free end to its position with own rotations.
"""

import argparse

import numpy as np

import warp_corot as wc

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--device", help="cpu or cuda:0")
parser.add_argument("-o", "--output", default="rotation_levels.usd")
parser.add_argument("--duration", type=float, default=1.5, help="seconds simulated")
args = parser.parse_args()

levels = [0, 1, 2, 3, 4, 5, 6, None]  # None: every element has its own
bodies = []
for k in range(len(levels)):
    mesh = wc.TetForest.box(cells=(1, 1, 3), cell_size=0.064, level=6, origin=(0.1 * k, 0.0, 0.0))
    body = wc.SoftBody(mesh, wc.Isotropic(young=500.0, poisson=0.49, density=10.0), device=args.device)
    body.fix(mesh.points[:, 2] < 1e-9)
    bodies.append(body)

models = [wc.Corotated(rotation_level=level) for level in levels]
sim = wc.Simulation(bodies, model=models, integrator=wc.SymplecticEuler(dt=2e-4, damping=15.0), gravity=(0, -9.8, 0))
wc.record(sim, args.output, duration=args.duration)

end = np.flatnonzero(mesh.points[:, 2] > 0.192 - 1e-9)
u = np.stack([body.displacements.numpy()[end].mean(axis=0) for body in bodies])
for k, level in enumerate(levels):
    name = "own rotations" if level is None else f"{18 * 2**level:4d} rotations"
    print(f"{name:14}  end lower by {-1e3 * u[k, 1]:5.1f} mm, off by {1e3 * np.linalg.norm(u[k] - u[-1]):5.2f} mm")
print(f"wrote {args.output}")
