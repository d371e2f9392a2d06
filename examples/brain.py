"""Brain shift: the skull is opened, the fluid around the brain drains, and it sags (pip install nilearn matplotlib).

The part above the fluid loses its buoyancy. Below the fluid the skull holds the brain, above it nothing does (Dumpuri
et al. 2007, Med. Image Anal. 11). Moduli: Budday et al. (2015, J. Mech. Behav. Biomed. Mater. 46). In operations the
brain sags by 1 cm on average (Roberts et al. 1998, Neurosurgery 43); here the sag depends mostly on the fluid's level.
Head: MNI ICBM 152.
"""

import argparse
import time
from importlib.util import find_spec

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from scipy.ndimage import binary_closing

import warp_corot as wc
from warp_corot.io.pictures.drawing import draw_body

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--device", help="cpu or cuda:0")
parser.add_argument("-o", "--output", default="brain.usd")
parser.add_argument("--duration", type=float, default=2.0, help="seconds simulated")
parser.add_argument("--drained", type=float, default=0.06, help="depth of fluid lost [m]")
args = parser.parse_args()
if not (nilearn := find_spec("nilearn")):
    raise SystemExit("this example needs nilearn, which has the brain: pip install nilearn")
files = nilearn.submodule_search_locations[0] + "/datasets/data/mni_icbm152_{}_tal_nlin_sym_09a_converted.nii.gz"
maps = {"grey": files.format("gm"), "white": files.format("wm")}
brain = wc.Domain.from_probabilities(maps, certain=255, unit="mm", smoothing=1e-3)
mesh = wc.TetForest.from_domain(brain, 0.032, max_level=8, surface_error=1.5e-3)  # the simulated mesh
look = wc.TetForest.from_domain(brain, 0.032, max_level=10, surface_error=5e-4).surface()
look = mesh.bind(look.points, look.triangles)  # the drawn surface
print(*brain.report(), *mesh.summary(), f"meshed after {time.process_time():.1f} s", sep="\n")
closed = binary_closing(np.pad(brain.numbers[::2, ::2, ::2] > 0, 9), np.ones((3, 3, 3)), iterations=6)[9:-9, 9:-9, 9:-9]
skull = wc.Domain.from_labels(closed, affine=brain.affine @ np.diag([2, 2, 2, 1]), smoothing=2e-3)
across, up = np.array([[0.8, 0.0, -0.6], [0.6, 0.0, 0.8]])
top = look.points[np.argmax(look.points @ up)]
dry = (mesh.points - top) @ up > -args.drained
body = wc.SoftBody(mesh, wc.Isotropic(np.where(mesh.elements_of("grey"), 1400, 1900), 0.49, 1040), device=args.device)
body.fix((skull.phi(mesh.points) > -3e-3) & ~dry)
body.load(dry, np.outer(body.masses[dry], -9.81 * 1007.0 / 1040.0 * up))  # the lost buoyancy
sim = wc.Simulation(body, integrator=wc.SymplecticEuler(damping=8.0), gravity=(0.0, 0.0, 0.0))
done = wc.record(sim, args.output, duration=args.duration, fps=12.0, surface=look, tets=True)
u = body.displacements.numpy()
sag = 1e3 * (look.points - look.moved(u)) @ up
print(f"{done.steps} steps in {done.stepping:.1f} s; the brain sags by up to {sag.max():.1f} mm")
x, y = np.meshgrid(np.arange(-0.12, 0.09, 5e-4), np.arange(-0.15, 0.015, 5e-4))  # a plane, in squares
plane, table = top + np.stack([x.ravel(), y.ravel()], axis=1) @ [across, up], ListedColormap(["#c98f86", "#f3e7d3"])
bone, tissue = skull.phi(plane).reshape(x.shape), np.ma.masked_equal(brain.labels_at(plane).reshape(x.shape), 0)
axes = (figure := Figure(figsize=(12, 4.2), layout="constrained")).subplots(1, 3)
for ax, moved, level in ((axes[0], None, 0.0), (axes[1], u, -args.drained)):
    ax.contourf(x, y, np.maximum(bone, y - level), [-1.0, 1e-3], colors=["#cfe3ee"])
    ax.contourf(x, y, np.where((np.abs(x) < 0.035) & (y > -0.04), np.nan, bone), [1e-3, 7e-3], colors=["#a9a294"])
    at = (plane if moved is None else mesh.bind(plane).moved(moved)) - top
    ax.pcolormesh((at @ across).reshape(x.shape), (at @ up).reshape(x.shape), tissue[1:, 1:], cmap=table)
    ax.set(xlim=(-0.12, 0.09), ylim=(-0.15, 0.015), aspect="equal", frame_on=False, xticks=[], yticks=[])
front = look.moved(u) @ np.stack([-across, [0.0, -1.0, 0.0], up], axis=1)
draw_body(axes[2], front, look.triangles, scalars=np.maximum(sag, 0), up_axis="Z", ground=False)
figure.savefig(args.output.rpartition(".")[0] + ".png", dpi=150)
print(f"wrote {args.output}")
