"""A ball is dragged across a slab; the mesh becomes fine at the ball and coarse again behind it.

Elongation would not respond to compression, so elements are refined if they are large for their distance to the ball.
Contact is a penalty: a force that grows with the depth pushes nodes out of the ball.
"""

import argparse

import numpy as np
import warp as wp
from scipy.spatial import ConvexHull

import warp_corot as wc

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--device", help="cpu or cuda:0")
parser.add_argument("-o", "--output", default="remesh.usd")
parser.add_argument("--duration", type=float, default=3.0, help="seconds simulated")
args = parser.parse_args()
RADIUS, STIFFNESS = 0.015, 1.5e6  # of the ball [m]; of the penalty, per kilogram of a node's mass [1/s^2]


@wp.kernel
def push_out(ball: wp.array[wp.float32], x: wp.array[wp.vec3], mass: wp.array[wp.float32], load: wp.array[wp.vec3]):
    arm = x[wp.tid()] - wp.vec3(ball[0], ball[1], ball[2])
    load[wp.tid()] = STIFFNESS * mass[wp.tid()] * wp.max(RADIUS - wp.length(arm), 0.0) * wp.normalize(arm)


mesh, material = wc.TetForest.box(cells=(6, 1, 3), cell_size=0.03, level=3), wc.Isotropic(1e4, 0.4, 1000.0)
slab = wc.SoftBody(mesh, material, device=args.device)  # 18 x 3 x 9 cm
slab.fix(mesh.points[:, 1] < 1e-9)
times = np.array([0.0, 0.4, 2.4, 2.8])
way = np.array([[0.03, 0.052, 0.045], [0.03, 0.035, 0.045], [0.15, 0.035, 0.045], [0.15, 0.1, 0.045]])
# For the picture the ball is a body, too: tetrahedra around its centre, with prescribed motion.
z, angle = np.linspace(-1.0, 1.0, 500), 2.4 * np.arange(500)
shell = RADIUS * np.stack([np.sqrt(1.0 - z**2) * np.cos(angle), np.sqrt(1.0 - z**2) * np.sin(angle), z], axis=1)
fan = wc.TetMesh(way[0] + np.insert(shell, 0, 0, axis=0), np.insert(ConvexHull(shell).simplices + 1, 0, 0, axis=1))
ball = wc.SoftBody(fan, material, device=args.device)
ball.prescribe(np.arange(1, 501), times=times, displacements=way - way[0])

place = wp.array([*way[0], 0, 0, 0, RADIUS, 0.003], dtype=wp.float32, device=args.device)
criterion = wc.remesh.nearness
near = wc.OnlineRemesh(refine_above=1.0, simplify_below=0.4, max_level=10, criterion=criterion, parameters=place)
sim = wc.Simulation([slab, ball], integrator=wc.SymplecticEuler(damping=20.0), remesh=[near, None])


def press(sim):
    place[:3].assign([np.interp(sim.time, times, way[:, axis]) for axis in range(3)])
    inputs = [place, slab.positions, slab.node_mass, slab.loads]
    wp.launch(push_out, dim=slab.node_count, inputs=inputs, device=slab.device)
    if sim.steps % 500 == 0:
        print(f"{sim.time:5.2f} s   {slab.element_count:5} tetrahedra, the finest of level {slab.mesh.levels.max()}")


sim.on_step(press)
done = wc.record(sim, args.output, duration=args.duration)
print(f"{min(done.elements)} to {max(done.elements)} tetrahedra with the ball's; {done.stepping:.1f} s of stepping")
print(f"wrote {args.output}")
