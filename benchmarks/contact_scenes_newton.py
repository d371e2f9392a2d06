"""The scenes of ``contact_scenes.py`` in Newton's VBD. The import fails if Newton is not installed."""

from __future__ import annotations

import time

import contact_scenes as scenes
import newton
import numpy as np
import warp as wp

import warp_corot as wc

NAME = f"Newton {newton.__version__}, VBD, 1 ms"
ITERATIONS, STEP, SKIN = 10, 1e-3, 5e-4
#: Of contact: Newton's own and a hundred times as much [N/m].
STIFFNESSES = (1e3, 1e5)


def outcome(scene: scenes.Scene, stiffness: float) -> scenes.Outcome:
    """Run the scene. Forces are Newton's penalty: stiffness times depth, without damping."""
    model, sizes = _model(scene, stiffness)
    piled = len(scene.meshes) > 1
    solver = newton.solvers.SolverVBD(
        model,
        iterations=ITERATIONS,
        integrate_with_external_rigid_solver=bool(scene.ways),
        particle_enable_self_contact=piled,
        particle_self_contact_radius=2.0 * SKIN,
        particle_self_contact_margin=4.0 * SKIN,
    )
    pipeline = newton.CollisionPipeline(model, soft_contact_gap=5e-3)
    states, control, contacts = [model.state(), model.state()], model.control(), pipeline.contacts()
    steps, felt, started = 0, [], time.process_time()
    while steps * STEP < scene.ends:
        if steps == 1:
            started = time.process_time()  # without compiling
        before, after = states
        for state, at in ((before, steps), (after, steps + 1)):
            _move(scene, state, at * STEP)
        before.clear_forces()
        pipeline.collide(before, contacts)
        solver.step(before, after, control, contacts, STEP)
        states.reverse()
        steps += 1
        if steps * STEP > scene.ends - scene.looked:
            felt.append(_forces(scene, states[0].particle_q.numpy().astype(float), stiffness))
    wp.synchronize()
    taken = time.process_time() - started
    on_ground, on_plate = np.mean(felt, axis=0)
    points = np.split(states[0].particle_q.numpy().astype(float), np.cumsum(sizes)[:-1])
    return scenes.Outcome(taken, steps, on_ground, on_plate, points, SKIN)


def _model(scene: scenes.Scene, stiffness: float) -> tuple[newton.Model, list[int]]:
    builder = newton.ModelBuilder(up_axis=newton.Axis.Z, gravity=(0.0, 0.0, -scenes.GRAVITY))
    mu = scene.young / (2.0 * (1.0 + scenes.POISSON))
    lam = 2.0 * mu * scenes.POISSON / (1.0 - 2.0 * scenes.POISSON)
    for mesh in scene.meshes:
        tets = wc.TetMesh(mesh.points, mesh.tets).tets
        builder.add_soft_mesh(
            pos=(0.0, 0.0, 0.0),
            rot=wp.quat_identity(),
            scale=1.0,
            vel=(0.0, 0.0, 0.0),
            vertices=mesh.points.tolist(),
            indices=tets.ravel().tolist(),
            density=scenes.DENSITY,
            k_mu=mu,
            k_lambda=lam,
            k_damp=0.0,
            particle_radius=SKIN,
        )
    own = newton.ModelBuilder.ShapeConfig(ke=stiffness, kd=0.0, mu=scenes.FRICTION)
    builder.add_ground_plane(cfg=own)
    for way in scene.ways:
        x, y, z = scenes.PLATE
        plate = builder.add_body(xform=wp.transform(wp.vec3(*way[0]), wp.quat_identity()), is_kinematic=True)
        builder.add_shape_box(plate, hx=x, hy=y, hz=z, cfg=own)
    builder.color()
    model = builder.finalize(device="cpu")
    model.soft_contact_ke, model.soft_contact_kd, model.soft_contact_mu = stiffness, 0.0, scenes.FRICTION
    return model, [len(mesh.points) for mesh in scene.meshes]


def _move(scene: scenes.Scene, state: newton.State, t: float) -> None:
    """Put the plates where they are at a time."""
    if scene.ways:
        poses = state.body_q.numpy()
        poses[:, :3] = [scene.place(way, t) for way in scene.ways]
        state.body_q.assign(poses)


def _forces(scene: scenes.Scene, points: np.ndarray, stiffness: float) -> tuple[float, float]:
    """On the ground, and across the first plate [N]."""
    ground = stiffness * np.maximum(SKIN - points[:, 2], 0.0).sum()
    if not scene.ways:
        return float(ground), 0.0
    off = np.abs(points - scene.ways[0][-1]) - scenes.PLATE
    beside = np.delete(off, 1, axis=1).max(axis=1) < 0.0
    return float(ground), float(stiffness * np.maximum(SKIN - off[beside, 1], 0.0).sum())
