"""A frog of ten tissues, picked up by its back, hangs limp (pip install pyvista matplotlib).

The segmentation of the Whole Frog Project comes with PyVista. It has no skin and no muscle, so flesh fills the space
between the tissues and surrounds them, four voxels thick. It has no unit; the frog is assumed to be 9 cm long. Moduli
are those of soft tissues. Bone is as soft as gristle, because real bone would need steps hundreds of times shorter.
"""

import argparse
import time
from importlib.util import find_spec

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from scipy.ndimage import binary_dilation, binary_erosion

import warp_corot as wc
from warp_corot.io.pictures.drawing import draw_body
from warp_corot.io.read.filemesh import load_volume

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--device", help="cpu or cuda:0")
parser.add_argument("-o", "--output", default="frog.usd")
parser.add_argument("--duration", type=float, default=1.0, help="seconds simulated")
args = parser.parse_args()
if not (pyvista := find_spec("pyvista")):
    raise SystemExit("this example needs PyVista, which has the frog: pip install pyvista")

# Tissue: numbers in the file (99 is the filling), Young's modulus [kPa], colour.
flesh, bone = ((99, 1, 12, 14, 16), 3.0, "#e9b8a0"), (13, 40.0, "#f3ecd8")
liver, stomach, heart = (10, 2.0, "#8c3b2e"), (15, 4.0, "#d98a6a"), (6, 10.0, "#c4202e")
lungs, kidneys, gut = (11, 1.0, "#8fb4cc"), (8, 4.0, "#7d2f5a"), ((3, 7, 9), 2.0, "#c9a24a")
tissues = {"flesh": flesh, "bone": bone, "liver": liver, "stomach": stomach, "heart": heart, "lungs": lungs}
tissues |= {"kidneys": kidneys, "gut": gut, "eyes": ((4, 5), 10.0, "#4a7c59"), "brain": (2, 1.0, "#8d7fb5")}
voxels = load_volume(pyvista.submodule_search_locations[0] + "/examples/frog_tissues.vti").values[::2, ::2, ::2]
voxels = np.pad(voxels, 12)
voxels[binary_erosion(binary_dilation(voxels > 0, iterations=12), iterations=8) & (voxels == 0)] = 99
labels = {name: numbers for name, (numbers, _, _) in tissues.items()}
frog = wc.Domain.from_labels(voxels, affine=np.diag([0.4, -0.4, -0.6, 1]), unit="mm", labels=labels, smoothing=4e-4)
mesh = wc.TetForest.from_domain(frog, 0.012, max_level=8, surface_error=6e-4)
print(*frog.report(), *mesh.summary(), f"meshed after {time.process_time():.1f} s", sep="\n")
x, middle = mesh.points, frog.bounds.mean(axis=0)[1]
young = 1e3 * np.array([modulus for _, modulus, _ in tissues.values()])[mesh.labels - 1]
body = wc.SoftBody(mesh, wc.Isotropic(young, poisson=0.45, density=1050.0), device=args.device)
back = (np.abs(x - [0.045, middle, -0.012]) < [0.013, 0.012, 0.01]).all(axis=1)
body.fix(mesh.nodes_of("bone") & back)
sim = wc.Simulation(body, integrator=wc.SymplecticEuler(damping=4.0))
done = wc.record(sim, args.output, duration=args.duration, tets=True)
print(f"{done.steps} steps in {done.stepping:.1f} s; it hangs down by up to {100 * done.final_displacement:.1f} cm")
u, look = body.displacements.numpy(), mesh.surface()
right, above = np.meshgrid(np.arange(0.0, 0.105, 4e-4), np.arange(-0.055, 0.0, 4e-4))  # a plane, in squares
plane, shape = np.stack([right, np.full_like(right, middle), above], axis=-1).reshape(-1, 3), right.shape
tissue = np.ma.masked_equal(frog.labels_at(plane).reshape(shape)[1:, 1:], 0)
table = ListedColormap([colour for _, _, colour in tissues.values()])
axes = (figure := Figure(figsize=(12, 3.8), layout="constrained")).subplots(1, 3)
for ax, moved in ((axes[0], None), (axes[1], u)):
    at = plane if moved is None else mesh.bind(plane).moved(moved)
    ax.pcolormesh(at[:, 0].reshape(shape), at[:, 2].reshape(shape), tissue, cmap=table, vmin=0.5, vmax=10.5)
    ax.set(xlim=(0.0, 0.105), ylim=(-0.09, 0.0), aspect="equal", frame_on=False, xticks=[], yticks=[])
draw_body(axes[2], look.moved(u), look.triangles, rest=look.points, up_axis="Z", ground=False)
figure.savefig(args.output.rpartition(".")[0] + ".png", dpi=150)
print(f"wrote {args.output}")
