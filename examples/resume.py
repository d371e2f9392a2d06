"""A run is saved half-way and resumed later; on a CPU the result is the same bit for bit as without the break."""

import argparse
from pathlib import Path

import numpy as np

import warp_corot as wc

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--device", help="cpu or cuda:0")
parser.add_argument("-o", "--output", default="resume.usd", type=Path)
parser.add_argument("--duration", type=float, default=2.0, help="seconds simulated")
args = parser.parse_args()


def cantilever() -> wc.Simulation:
    mesh = wc.TetForest.box(cells=(4, 1, 1), cell_size=0.03, level=3)
    body = wc.SoftBody(mesh, wc.Isotropic(young=3e4, poisson=0.4, density=1000.0), device=args.device)
    body.fix(mesh.points[:, 0] < 1e-9)
    # The step is given, because a step that follows the state is adjusted to meet the ends of frames.
    return wc.Simulation(body, integrator=wc.SymplecticEuler(dt=2e-4, damping=3.0))


half = args.duration / 2.0
sim = cantilever()
wc.record(sim, args.output, duration=half)
checkpoint = args.output.with_suffix(".npz")
sim.save(checkpoint)

resumed = wc.Simulation.load(checkpoint)
later = args.output.with_stem(args.output.stem + "-later")
wc.record(resumed, later, duration=half)  # its first frame is the last one of the other file

whole = cantilever()
whole.advance_steps(resumed.steps)
difference = np.abs(whole.body.positions.numpy() - resumed.body.positions.numpy()).max()
print(f"after {resumed.steps} steps the two runs differ by {difference:g} m")
print(f"wrote {args.output}, {checkpoint} and {later}")
