"""A ball of soft tissue, meshed adaptively, falls on a rigid box; both come to rest on the ground. Stress is logged.

The surface is drawn and follows the tetrahedra, which reach a little beyond it: cut ones are simulated whole.

python examples/newton/drop.py --viewer null --test, or --viewer usd --output-path drop.usd, gl, rerun, viser.
"""

import newton
import newton.examples
import numpy as np
import warp as wp

import warp_corot as wc
import warp_corot.newton as wn

RADIUS = 0.15


def add_surface(builder, forest, added, pos):
    """Let viewers draw the meshed surface, which follows the forest's tetrahedra."""
    surface, tets = forest.surface(), added.tetrahedra
    elements, weights = forest.embed(surface.points)  # points outside all tetrahedra use the nearest one
    weights = np.clip(weights, 0.0, None) / np.clip(weights, 0.0, None).sum(axis=1, keepdims=True)
    # In Newton the corners of mirrored elements have another order.
    corners = np.array(builder.tet_indices)[tets.start + elements] - added.particles.start
    same = corners[:, :, None] == forest.tets[elements][:, None, :]
    builder.add_deformable_visual_mesh(
        surface.points + pos,
        surface.triangles.ravel(),
        kind="tetrahedron",
        parent=tets.start + elements,
        weights=np.einsum("vij,vj->vi", same, weights),
        tet_range=(tets.start, tets.stop),
    )


class Example:
    def __init__(self, viewer, args):
        self.viewer, self.frame_dt, self.sim_time = viewer, 1.0 / 60.0, 0.0
        builder = newton.ModelBuilder()
        builder.add_ground_plane()
        wn.register_custom_attributes(builder)
        box = builder.add_body(xform=wp.transform(wp.vec3(0.0, 0.0, 0.1), wp.quat_identity()))
        light = newton.ModelBuilder.ShapeConfig(density=200.0)
        builder.add_shape_box(box, hx=0.3, hy=0.3, hz=0.1, cfg=light, color=(0.35, 0.42, 0.5))
        ball = wc.Domain.sphere(RADIUS)
        forest = wc.TetForest.from_domain(ball, 2.2 * RADIUS, max_level=12, surface_error=0.003)
        tissue = wc.Isotropic(young=3e4, poisson=0.4, density=1000.0)
        centre = np.array([0.02, 0.0, 0.5])
        added = wn.add_forest(builder, forest, tissue, pos=centre, k_damp=20.0, particle_radius=0.002, surface=False)
        add_surface(builder, forest, added, centre)
        self.model = builder.finalize()
        self.model.soft_contact_ke, self.model.soft_contact_kd, self.model.soft_contact_mu = 2e3, 2.0, 0.5
        self.model.shape_material_ke.fill_(4e4)
        self.model.shape_material_kd.fill_(400.0)
        self.solver = wn.SolverCorotated(self.model, damping=2.0)  # 1/s, so that the ball comes to rest
        # Contacts are found this often in a frame; the solver divides steps further to stay stable.
        self.steps = 8
        self.pipeline = newton.CollisionPipeline(self.model)
        self.contacts = self.pipeline.contacts()

        self.state_0, self.state_1 = self.model.state(), self.model.state()
        self.control = self.model.control()
        viewer.set_model(self.model)
        viewer.set_camera(wp.vec3(0.95, -0.8, 0.65), pitch=-17.0, yaw=140.0)
        self.simulate()  # compiles the kernels that the recording launches
        self.state_0.assign(self.model.state())
        with wp.ScopedCapture() as capture:
            self.simulate()
        self.graph = capture.graph

    def simulate(self):
        for _ in range(self.steps):
            self.state_0.clear_forces()
            self.viewer.apply_forces(self.state_0)
            self.pipeline.collide(self.state_0, self.contacts)
            self.solver.step(self.state_0, self.state_1, self.control, self.contacts, self.frame_dt / self.steps)
            self.state_0, self.state_1 = self.state_1, self.state_0

    def step(self):
        wp.capture_launch(self.graph)
        self.sim_time += self.frame_dt

    def render(self):
        self.viewer.begin_frame(self.sim_time)
        self.viewer.log_state(self.state_0)
        stress = self.state_0.warp_corot.von_mises.numpy()
        self.viewer.log_scalar("largest_von_mises_stress_in_Pa", float(stress.max()))
        self.viewer.end_frame()

    def test_final(self):
        self.solver.check()
        x, v = self.state_0.particle_q.numpy(), self.state_0.particle_qd.numpy()
        m = self.model.particle_mass.numpy()
        assert x[:, 2].min() > 0.15, x[:, 2].min()
        assert 0.0 <= self.state_0.warp_corot.von_mises.numpy().max() < 1e5
        if self.sim_time > 0.5:
            assert 0.2 < m @ x[:, 2] / m.sum() < 0.5
            assert 0.07 < self.state_0.body_q.numpy()[0, 2] < 0.11
        if self.sim_time > 2.9:
            assert np.abs(m @ v / m.sum()).max() < 0.1


if __name__ == "__main__":
    viewer, args = newton.examples.init()
    try:
        newton.examples.run(Example(viewer, args), args)
    except KeyboardInterrupt:  # rerun and viser run until then; the output is kept
        viewer.close()
