"""Two fingers close on a soft block, lift it and hold it.

python examples/newton/gripper.py --viewer null --test --num-frames 180, or --viewer usd --output-path gripper.usd, gl,
rerun, viser.
"""

import newton
import newton.examples
import numpy as np
import warp as wp

import warp_corot as wc
import warp_corot.newton as wn

HALF, FINGER, GREY = 0.05, 0.02, (0.35, 0.42, 0.5)
CLOSED, LIFTED = 0.5, 1.5  # times when the fingers are closed and when they are up [s]
SQUEEZE, HEIGHT = 0.012, 0.2  # how far they press in, and how far they lift [m]


@wp.kernel
def move_fingers(time: wp.array[wp.float32], dt: float, q: wp.array[wp.transform], qd: wp.array[wp.spatial_vector]):
    side = 2.0 * float(wp.tid()) - 1.0
    t = time[0]
    closing = wp.clamp(t / CLOSED, 0.0, 1.0)
    lifting = wp.clamp((t - CLOSED) / (LIFTED - CLOSED), 0.0, 1.0)
    x = side * (HALF + FINGER + 0.02 - closing * (0.02 + SQUEEZE))
    z = HALF + HEIGHT * lifting * lifting * (3.0 - 2.0 * lifting)
    before = wp.transform_get_translation(q[wp.tid()])
    now = wp.vec3(x, 0.0, z)
    q[wp.tid()] = wp.transform(now, wp.quat_identity())
    qd[wp.tid()] = wp.spatial_vector((now - before) / dt, wp.vec3())


@wp.kernel
def advance(dt: float, time: wp.array[wp.float32]):
    time[0] = time[0] + dt


class Example:
    def __init__(self, viewer, args):
        self.viewer, self.frame_dt, self.sim_time = viewer, 1.0 / 60.0, 0.0
        builder = newton.ModelBuilder()
        builder.add_ground_plane()
        drawn = newton.ModelBuilder.ShapeConfig(density=0.0, has_shape_collision=False, has_particle_collision=False)
        arm = wp.transform(wp.vec3(0.0, 0.0, 0.1), wp.quat_identity())
        for side in (-1.0, 1.0):
            start = wp.vec3(side * (HALF + FINGER + 0.02), 0.0, HALF)
            finger = builder.add_body(xform=wp.transform(start, wp.quat_identity()))
            builder.add_shape_box(finger, hx=FINGER, hy=0.04, hz=0.04, color=GREY)
            builder.add_shape_box(finger, xform=arm, hx=0.5 * FINGER, hy=0.015, hz=0.06, cfg=drawn, color=GREY)
            builder.body_flags[finger] = int(newton.BodyFlags.KINEMATIC)
        forest = wc.TetForest.box((1, 1, 1), 2 * HALF, 9)
        rubber = wc.Isotropic(young=5e4, poisson=0.4, density=500.0)
        wn.add_forest(builder, forest, rubber, pos=(-HALF, -HALF, 0.003), k_damp=20.0, particle_radius=0.002)
        self.model = builder.finalize()
        # Stiffness [N/m], damping and friction's slope [N s/m] of a particle's contact, and friction.
        for name, value in (("ke", 2e3), ("kd", 1.0), ("kf", 1e4), ("mu", 0.8)):
            setattr(self.model, f"soft_contact_{name}", value)
            getattr(self.model, f"shape_material_{name}").fill_(value)
        self.solver = wn.SolverCorotated(self.model)
        self.substeps = 2 * int(np.ceil(self.frame_dt / (2.0 * self.solver.recorded_dt)))
        self.pipeline = newton.CollisionPipeline(self.model)
        self.contacts = self.pipeline.contacts()
        self.time = wp.zeros(1, dtype=wp.float32)

        self.state_0, self.state_1 = self.model.state(), self.model.state()
        self.control = self.model.control()
        viewer.set_model(self.model)
        viewer.set_camera(wp.vec3(0.28, -0.68, 0.3), pitch=-13.0, yaw=112.0)
        self.simulate()  # compiles the kernels that the recording launches
        self.state_0.assign(self.model.state())
        self.time.zero_()
        with wp.ScopedCapture() as capture:
            self.simulate()
        self.graph = capture.graph

    def simulate(self):
        dt = self.frame_dt / self.substeps  # short enough that the solver does not divide it
        for _ in range(self.substeps):
            self.state_0.clear_forces()
            wp.launch(move_fingers, dim=2, inputs=[self.time, dt, self.state_0.body_q, self.state_0.body_qd])
            wp.launch(advance, dim=1, inputs=[dt, self.time])
            self.pipeline.collide(self.state_0, self.contacts)
            self.solver.step(self.state_0, self.state_1, self.control, self.contacts, dt)
            self.state_0, self.state_1 = self.state_1, self.state_0

    def step(self):
        wp.capture_launch(self.graph)
        self.sim_time += self.frame_dt

    def render(self):
        self.viewer.begin_frame(self.sim_time)
        self.viewer.log_state(self.state_0)
        self.viewer.end_frame()

    def test_final(self):
        self.solver.check()
        x = self.state_0.particle_q.numpy()
        assert np.isfinite(x).all()
        if self.sim_time > LIFTED + 0.2:
            assert 0.9 * HEIGHT < x[:, 2].mean() - HALF < 1.1 * HEIGHT, x[:, 2].mean()
            assert np.abs(self.state_0.particle_qd.numpy()).max() < 0.1


if __name__ == "__main__":
    viewer, args = newton.examples.init()
    try:
        newton.examples.run(Example(viewer, args), args)
    except KeyboardInterrupt:  # rerun and viser run until then; the output is kept
        viewer.close()
