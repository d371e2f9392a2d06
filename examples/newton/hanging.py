"""Four cantilevers of the same rubber in Newton, each with less damping than the last; the fourth is a forest.

python examples/newton/hanging.py --viewer null --test, or --viewer usd --output-path hanging.usd, gl, rerun, viser.
"""

import newton
import newton.examples
import numpy as np
import warp as wp

import warp_corot as wc
import warp_corot.newton as wn

LENGTH, WIDTH, SPACING = 1.2, 0.4, 0.6


class Example:
    def __init__(self, viewer, args):
        self.viewer, self.frame_dt, self.sim_time = viewer, 1.0 / 60.0, 0.0
        material = wc.Isotropic(young=1e6, poisson=0.25, density=1000.0)
        builder = newton.ModelBuilder()
        builder.add_ground_plane()
        for k, k_damp in enumerate((3e3, 1e3, 3e2)):
            builder.add_soft_grid(
                pos=wp.vec3(0.0, k * SPACING, 1.0),
                rot=wp.quat_identity(),
                vel=wp.vec3(),
                dim_x=12,
                dim_y=4,
                dim_z=4,
                cell_x=0.1,
                cell_y=0.1,
                cell_z=0.1,
                density=material.density,
                k_mu=material.mu,
                k_lambda=material.lam,
                k_damp=k_damp,
                fix_left=True,
                particle_radius=0.02,
            )
        forest = wc.TetForest.box((3, 1, 1), WIDTH, 6)
        held = forest.points[:, 0] == 0
        pos = (0.0, 3 * SPACING, 1.0)
        wn.add_forest(builder, forest, material, pos=pos, k_damp=1e2, fixed=held, particle_radius=0.02)
        # The wall is only drawn: nothing touches anything here.
        drawn = newton.ModelBuilder.ShapeConfig(has_shape_collision=False, has_particle_collision=False)
        wall = wp.transform(wp.vec3(-0.05, 1.5 * SPACING + 0.5 * WIDTH, 0.8), wp.quat_identity())
        builder.add_shape_box(-1, xform=wall, hx=0.05, hy=1.3, hz=0.8, cfg=drawn, color=(0.35, 0.42, 0.5))
        self.model = builder.finalize()
        self.solver = wn.SolverCorotated(self.model, damping=4.0)  # 1/s, so that all come to rest

        self.state_0, self.state_1 = self.model.state(), self.model.state()
        self.control = self.model.control()
        viewer.set_model(self.model)
        viewer.set_camera(wp.vec3(3.6, -1.3, 2.0), pitch=-14.0, yaw=142.0)
        self.simulate()  # compiles the kernels that the recording launches
        self.state_0.assign(self.model.state())
        with wp.ScopedCapture() as capture:
            self.simulate()
        self.graph = capture.graph

    def simulate(self):
        # Two substeps, so that the two states do not change places; the solver divides them to stay stable.
        for _ in range(2):
            self.state_0.clear_forces()
            self.viewer.apply_forces(self.state_0)
            self.solver.step(self.state_0, self.state_1, self.control, None, self.frame_dt / 2)
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
        x = self.state_0.particle_q.numpy() - self.model.particle_q.numpy()
        beam = np.round(self.model.particle_q.numpy()[:, 1] // SPACING).astype(int)
        sag = [float(x[beam == k, 2].min()) for k in range(4)]
        assert all(-0.6 < tip < -0.05 for tip in sag), sag
        if self.sim_time > 2.9:
            assert np.abs(self.state_0.particle_qd.numpy()).max() < 0.02


if __name__ == "__main__":
    viewer, args = newton.examples.init()
    try:
        newton.examples.run(Example(viewer, args), args)
    except KeyboardInterrupt:  # rerun and viser run until then; the output is kept
        viewer.close()
