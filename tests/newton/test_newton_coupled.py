"""The Newton solver with other solvers: one of them for the bodies, and in Newton's coupled solvers."""

import numpy as np
import pytest
import warp as wp
from newton_scenes import add_grid, builder, contact_parameters, model_without_particles, newton, run, wn

coupled = pytest.importorskip("newton.solvers.experimental.coupled")


def drop(device, gravity=(0.0, 0.0, -9.81)):
    """A ball falls on a soft block on the ground."""
    made = builder(gravity=gravity)
    made.add_ground_plane()
    add_grid(made, dims=(4, 4, 2), pos=(-0.2, -0.2, 0.01), damp=50.0)
    link = made.add_link(xform=wp.transform(wp.vec3(0.0, 0.0, 0.33), wp.quat_identity()))
    made.add_shape_sphere(link, radius=0.1, cfg=newton.ModelBuilder.ShapeConfig(density=300.0))
    joint = made.add_joint_free(child=link)
    made.add_articulation([joint])
    model = made.finalize(device=device)
    contact_parameters(model, ke=1e4, kd=20.0)
    newton.eval_fk(model, model.joint_q, model.joint_qd, model)
    return model, link, joint


def rests(model, state):
    x, ball = state.particle_q.numpy(), state.body_q.numpy()[0]
    assert np.isfinite(x).all()
    assert x[:, 2].min() > -0.02
    assert 0.2 < ball[2] < 0.33
    assert np.linalg.norm(ball[:2]) < 0.05
    assert np.abs(state.particle_qd.numpy()).max() < 0.5
    assert np.abs(state.body_qd.numpy()).max() < 0.5


@pytest.mark.parametrize(
    "rigid",
    # The others' own kernels compile for ten seconds and more.
    ["semi-implicit", *(pytest.param(name, marks=pytest.mark.slow) for name in ("featherstone", "xpbd", "mujoco"))],
)
def test_with_another_rigid_solver(device, rigid):
    model, _, _ = drop(device)
    if rigid == "mujoco":
        pytest.importorskip("mujoco_warp")
    view = model_without_particles(model)
    solvers = newton.solvers
    make = {
        "semi-implicit": lambda: "semi-implicit",
        "xpbd": lambda: solvers.SolverXPBD(view),
        "featherstone": lambda: solvers.SolverFeatherstone(view),
        "mujoco": lambda: solvers.SolverMuJoCo(view, use_mujoco_contacts=False),
    }
    solver = wn.SolverCorotated(model, rigid_solver=make[rigid]())
    pipeline = newton.CollisionPipeline(model)
    rests(model, run(solver, model, 2000, 5e-4, pipeline=pipeline))


@pytest.mark.parametrize("mode", ["lagged", pytest.param("staggered", marks=pytest.mark.slow)])
def test_in_a_proxy_coupling(device, mode):
    """Newton's SolverCoupledProxy: the ball is stepped by one solver, and is a proxy in this one."""
    model, link, joint = drop(device)
    solver = coupled.SolverCoupledProxy(
        model=model,
        entries=[
            coupled.SolverCoupledProxy.Entry(
                name="rigid",
                solver=lambda view: newton.solvers.SolverSemiImplicit(view, enable_tri_contact=False),
                bodies=[link],
                joints=[joint],
            ),
            coupled.SolverCoupledProxy.Entry(
                name="soft",
                solver=lambda view: wn.SolverCorotated(view),
                particles=list(range(model.particle_count)),
            ),
        ],
        coupling=coupled.SolverCoupledProxy.Config(
            proxies=[
                coupled.SolverCoupledProxy.Proxy(
                    source="rigid",
                    destination="soft",
                    bodies=[link],
                    mode=mode,
                    collision_pipeline=lambda view: newton.CollisionPipeline(view),
                    collide_interval=1,
                )
            ],
        ),
    )
    pipeline = newton.CollisionPipeline(model)
    rests(model, run(solver, model, 2000, 5e-4, pipeline=pipeline))


@pytest.mark.slow
def test_in_an_admm_coupling(device):
    """Newton's SolverCoupledADMM: the ball hangs on the soft block by an attachment, each stepped by its solver."""
    made = builder()
    add_grid(made, dims=(2, 2, 2), pos=(0.0, 0.0, 1.0), damp=50.0, fix_top=False)
    link = made.add_link(xform=wp.transform(wp.vec3(0.1, 0.1, 0.9), wp.quat_identity()))
    made.add_shape_sphere(link, radius=0.03, cfg=newton.ModelBuilder.ShapeConfig(density=2000.0))
    joint = made.add_joint_free(child=link)
    made.add_articulation([joint])
    low = [i for i, x in enumerate(made.particle_q) if x[2] < 1.01]
    high = [i for i, x in enumerate(made.particle_q) if x[2] > 1.19]
    for i in high:
        made.particle_mass[i] = 0.0
    centre = low[4]
    made.add_attachment_particle_body(centre, link, body_point=wp.vec3(0.0, 0.0, 0.1), stiffness=1e3, damping=5.0)
    model = made.finalize(device=device)
    newton.eval_fk(model, model.joint_q, model.joint_qd, model)
    solver = coupled.SolverCoupledADMM(
        model=model,
        entries=[
            coupled.SolverCoupledADMM.Entry(
                name="rigid",
                solver=lambda view: newton.solvers.SolverSemiImplicit(view, enable_tri_contact=False),
                bodies=[link],
                joints=[joint],
            ),
            coupled.SolverCoupledADMM.Entry(
                name="soft",
                solver=lambda view: wn.SolverCorotated(view),
                particles=list(range(model.particle_count)),
            ),
        ],
        coupling=coupled.SolverCoupledADMM.Config(iterations=5),
    )
    state = run(solver, model, 2000, 5e-4)
    ball, particle = state.body_q.numpy()[0], state.particle_q.numpy()[centre]
    assert np.isfinite(state.particle_q.numpy()).all()
    assert 0.7 < ball[2] < 0.91
    assert np.linalg.norm(np.add(ball[:3], [0.0, 0.0, 0.1]) - particle) < 0.05
