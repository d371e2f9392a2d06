"""The press of ``contact_peers.py`` in Newton's VBD. The import fails if Newton is not installed."""

from __future__ import annotations

import time
from collections.abc import Callable

import newton
import numpy as np
import warp as wp

import warp_corot as wc

NAME = f"Newton {newton.__version__}, VBD"
ITERATIONS = 10


def vbd(
    mesh: wc.TetForest,
    material: tuple[float, float],
    ball: tuple[float, Callable[[float], tuple[float, float, float]]],
    masses: np.ndarray,
    skin: float,
    stiffness: float,
    dt: float,
    ends: float,
    looked: float,
) -> tuple[float, int, float, np.ndarray]:
    """Processor time [s], number of steps, mean force on the ball [N], and final positions of the nodes [m].

    The force is that of Newton's penalty, stiffness times depth along each contact's normal, without damping.

    Args:
        mesh: The body, held at its lower face.
        material: Young's modulus [Pa] and Poisson's ratio.
        ball: Radius of the ball [m], and a function from the time [s] to its position [m].
        masses: Masses of the nodes [kg].
        skin: Radius of the nodes [m].
        stiffness: Stiffness of contact, the same for nodes and ball [N/m].
        dt: The step [s].
        ends: End of the run [s].
        looked: Time before the end over which forces are averaged [s].
    """
    radius, place = ball
    builder = newton.ModelBuilder(up_axis=newton.Axis.Z, gravity=(0.0, 0.0, 0.0))
    held = mesh.points[:, 2] < 1e-9
    n = len(mesh.points)
    moving = np.where(held, 0.0, masses)
    builder.add_particles(mesh.points.tolist(), [(0.0, 0.0, 0.0)] * n, moving.tolist(), [skin] * n)
    young, poisson = material
    mu, lam = young / (2.0 * (1.0 + poisson)), young * poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson))
    for i, j, k, m in wc.TetMesh(mesh.points, mesh.tets).tets.tolist():
        builder.add_tetrahedron(i, j, k, m, k_mu=mu, k_lambda=lam, k_damp=0.0)
    builder.add_shape_sphere(-1, radius=radius, cfg=newton.ModelBuilder.ShapeConfig(ke=stiffness, kd=0.0, mu=0.0))
    builder.color()
    model = builder.finalize(device="cpu")
    model.soft_contact_ke, model.soft_contact_kd, model.soft_contact_mu = stiffness, 0.0, 0.0
    solver = newton.solvers.SolverVBD(model, iterations=ITERATIONS)
    pipeline = newton.CollisionPipeline(model, soft_contact_gap=5e-3)
    states, control, contacts = [model.state(), model.state()], model.control(), pipeline.contacts()
    pose = model.shape_transform.numpy()
    steps, forces, started = 0, [], time.process_time()
    while steps * dt < ends:
        if steps == 1:
            started = time.process_time()  # without compiling
        pose[0, :3] = place(steps * dt)
        model.shape_transform.assign(pose)
        before, after = states
        before.clear_forces()
        pipeline.collide(before, contacts)
        solver.step(before, after, control, contacts, dt)
        states.reverse()
        steps += 1
        if steps * dt > ends - looked:
            forces.append(_push(states[0], pose[0, :3], radius + skin, stiffness))
    wp.synchronize()
    taken = time.process_time() - started
    return taken, steps, float(np.mean(forces)), states[0].particle_q.numpy().astype(float)


def _push(state: newton.State, centre: np.ndarray, reach: float, stiffness: float) -> float:
    way = centre - state.particle_q.numpy().astype(float)
    length = np.linalg.norm(way, axis=1)
    deep = np.maximum(reach - length, 0.0)
    return float(stiffness * (deep * way[:, 2] / length).sum())
