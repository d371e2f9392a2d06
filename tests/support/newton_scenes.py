"""Scenes of Newton for the tests of its solver, and the effect of one step on them."""

import numpy as np
import pytest
import warp as wp

newton = pytest.importorskip("newton")

import warp_corot as wc  # noqa: E402
import warp_corot.newton as wn  # noqa: E402

MU, LAM = 3e4, 5e4


def builder(gravity=(0.0, 0.0, -9.81), radius=0.01):
    made = newton.ModelBuilder(gravity=gravity)
    made.default_particle_radius = radius
    return made


def add_grid(
    to, dims=(3, 2, 2), cell=0.1, pos=(0.0, 0.0, 0.0), mu=MU, lam=LAM, damp=0.0, vel=(0.0, 0.0, 0.0), **options
):
    to.add_soft_grid(
        pos=wp.vec3(*pos),
        rot=options.pop("rot", wp.quat_identity()),
        vel=wp.vec3(*vel),
        **dict(zip(("dim_x", "dim_y", "dim_z"), dims, strict=True)),
        cell_x=cell,
        cell_y=cell,
        cell_z=cell,
        density=1000.0,
        k_mu=mu,
        k_lambda=lam,
        k_damp=damp,
        **options,
    )


def adaptive_forest(level=4, size=0.4):
    """A forest of leaves of several levels."""
    forest = wc.TetForest.box((2, 1, 1), size, level)
    return forest.refine(np.linalg.norm(forest.points[forest.tets].mean(axis=1), axis=1) < 0.6 * size)


def grid_model(device, **options):
    made = builder()
    add_grid(made, **options)
    return made.finalize(device=device)


def impulse(solver, model, q=None, qd=None, control=None, contacts=None, dt=1e-5, state=None):
    """m dv/dt of one step, without gravity [N], float64 [P, 3]."""
    before, after = model.state() if state is None else state, model.state()
    if q is not None:
        before.particle_q.assign(np.asarray(q, np.float32))
    before.particle_qd.assign(np.zeros((model.particle_count, 3)) if qd is None else np.asarray(qd, np.float32))
    v = before.particle_qd.numpy().astype(float)
    solver.step(before, after, control, contacts, dt)
    m, g = model.particle_mass.numpy()[:, None], model.gravity.numpy()[-1]
    return m * ((after.particle_qd.numpy() - v) / dt - g)


def semi_implicit(model):
    """Newton's own explicit solver, with only tetrahedra and contact with shapes."""
    model.particle_grid = None
    return newton.solvers.SolverSemiImplicit(model, enable_tri_contact=False)


def checked_step(solver, before, after, contacts=None, dt=1e-4):
    """Make a step, and report its errors on every device."""
    solver.step(before, after, None, contacts, dt)
    solver.check()


def stepped(solver, model, count, dt, *, pipeline=None, contacts=None, state=None, collides=None, **options):
    """Make steps from a model's initial state, or another one, each after a search for contacts; yields each result.

    Args:
        collides, options: Options of ``collide`` and of ``step``.
    """
    now, after = model.state() if state is None else state, model.state()
    contacts = pipeline.contacts() if pipeline is not None and contacts is None else contacts
    for _ in range(count):
        now.clear_forces()
        if pipeline is not None:
            pipeline.collide(now, contacts, **(collides or {}))
        solver.step(now, after, None, contacts, dt, **options)
        now, after = after, now
        yield now
    getattr(solver, "check", lambda: None)()


def run(solver, model, steps, dt, control=None, pipeline=None, each=None):
    """Make an even number of steps from a model's initial state, two of them recorded and replayed; the last state.

    With ``each``, a function of the state, they are launched one by one.
    """
    now, after = model.state(), model.state()
    contacts = None if pipeline is None else pipeline.contacts()

    def two_steps():
        for before, behind in ((now, after), (after, now)):
            before.clear_forces()
            if pipeline is not None:
                pipeline.collide(before, contacts)
            solver.step(before, behind, control, contacts, dt)
            if each is not None:
                each(behind)

    assert steps % 2 == 0
    two_steps()
    if each is None:
        with wp.ScopedCapture(device=model.device) as capture:
            two_steps()
    for _ in range(steps // 2 - 1):
        two_steps() if each is not None else wp.capture_launch(capture.graph)
    getattr(solver, "check", lambda: None)()
    return now


def momentum(model, state):
    """Linear and angular momentum about the origin of particles and bodies [N s, N m s]."""
    x, v = (a.numpy().astype(float) for a in (state.particle_q, state.particle_qd))
    m = model.particle_mass.numpy().astype(float)
    linear, angular = m @ v, m @ np.cross(x, v)
    if model.body_count:
        q, qd = state.body_q.numpy().astype(float), state.body_qd.numpy().astype(float)
        for b in range(model.body_count):
            mass, inertia = float(model.body_mass.numpy()[b]), model.body_inertia.numpy()[b].astype(float)
            turn = np.array(wp.quat_to_matrix(wp.quat(*q[b, 3:]))).reshape(3, 3)
            centre = q[b, :3] + turn @ model.body_com.numpy()[b]
            linear = linear + mass * qd[b, :3]
            angular = angular + mass * np.cross(centre, qd[b, :3]) + turn @ inertia @ turn.T @ qd[b, 3:]
    return linear, angular


__all__ = [
    "LAM",
    "MU",
    "adaptive_forest",
    "add_grid",
    "builder",
    "checked_step",
    "grid_model",
    "impulse",
    "momentum",
    "newton",
    "run",
    "semi_implicit",
    "stepped",
    "wc",
    "wn",
]
KE = 2e4


def contact_parameters(model, ke=KE, kd=20.0, kf=100.0, mu=0.5):
    """The same contact parameters for particles and shapes."""
    model.soft_contact_ke, model.soft_contact_kd = ke, kd
    model.soft_contact_kf, model.soft_contact_mu = kf, mu
    for array, value in (
        (model.shape_material_ke, ke),
        (model.shape_material_kd, kd),
        (model.shape_material_kf, kf),
        (model.shape_material_mu, mu),
    ):
        array.fill_(value)


def model_without_particles(model):
    from newton.solvers.experimental.coupled import ModelView

    view = ModelView(model, "bodies")
    view.particle_count = view.tet_count = view.tri_count = view.edge_count = 0
    return view
