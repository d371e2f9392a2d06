"""The Newton solver as a solver: the motions of this package's simulation, Newton's conventions, bad input."""

import gc
import re
import subprocess
import sys
import weakref
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from newton_scenes import adaptive_forest, add_grid, builder, checked_step, grid_model, impulse, newton, run, wc, wn

from warp_corot.newton.scene import ForestName

PACKAGE = Path(wn.__file__).parent


@pytest.mark.parametrize("kind", ["mesh", "forest"])
def test_a_beam_ends_where_simulation_has_it(device, kind):
    """The same beam sags under its weight in this package's simulation and in Newton."""
    forest = wc.TetForest.box((4, 1, 1), 0.1, 3, up_axis="Z")
    mesh = forest if kind == "forest" else wc.TetMesh(forest.points, forest.tets, up_axis="Z")
    material = wc.Isotropic(young=1e5, poisson=0.35, density=1000.0)
    held = forest.points[:, 0] == 0
    tip = np.argmax(forest.points @ [1.0, 1.0, 1.0])
    body = wc.SoftBody(mesh, material, device=device)
    body.fix(held)
    sim = wc.Simulation(body, integrator=wc.SymplecticEuler(damping=15.0))
    sim.advance(3.0)
    wanted = body.displacements.numpy()[tip]

    made = builder()
    add = wn.add_forest if kind == "forest" else wn.add_mesh
    add(made, mesh, material, fixed=held)
    model = made.finalize(device=device)
    solver = wn.SolverCorotated(model, damping=15.0)
    assert solver.stable_dt == pytest.approx(sim.stable_dt, rel=0.02)
    state = run(solver, model, 2 * round(1.5 / sim.dt), sim.dt)
    found = state.particle_q.numpy()[tip] - model.particle_q.numpy()[tip]
    assert wanted[2] < -0.02
    np.testing.assert_allclose(found, wanted, atol=2e-3 * np.abs(wanted).max())


def test_masses_are_this_packages(device):
    forest = adaptive_forest(3)
    made = builder()
    added = wn.add_forest(made, forest, wc.Isotropic(1e4, 0.3, 500.0), fixed=[0])
    body = wc.SoftBody(forest, wc.Isotropic(1e4, 0.3, 500.0), device="cpu")
    model = made.finalize(device=device)
    assert (len(added.particles), len(added.tetrahedra)) == (len(forest.points), len(forest.tets))
    np.testing.assert_allclose(model.particle_mass.numpy()[1:], body.masses[1:], rtol=1e-6)
    assert model.particle_mass.numpy()[0] == 0
    poses = model.tet_poses.numpy().astype(float)
    np.testing.assert_allclose(1 / (6 * np.linalg.det(poses)), forest.volumes, rtol=1e-5)


class TestParticles:
    def model(self, device):
        made = builder()
        add_grid(made, dims=(1, 1, 1))
        made.add_particle(wp.vec3(3.0, 0.0, 0.0), wp.vec3(1.0, 2.0, 3.0), 1.0)  # free
        made.add_particle(wp.vec3(4.0, 0.0, 0.0), wp.vec3(1.0, 2.0, 3.0), 0.0)  # kinematic
        made.add_particle(wp.vec3(5.0, 0.0, 0.0), wp.vec3(1.0, 2.0, 3.0), 1.0, flags=0)  # frozen
        return made.finalize(device=device)

    def test_are_kinematic_and_frozen_as_newton_means_them(self, device):
        model = self.model(device)
        states = []
        for solver in (wn.SolverCorotated(model), newton.solvers.SolverSemiImplicit(model, enable_tri_contact=False)):
            model.particle_grid = None
            before, after = model.state(), model.state()
            solver.step(before, after, None, None, 1e-3)
            states.append((after.particle_q.numpy()[8:], after.particle_qd.numpy()[8:]))
        for found, wanted in zip(*states, strict=True):
            np.testing.assert_allclose(found, wanted, rtol=1e-6)
        x, v = states[0]
        np.testing.assert_allclose(x[1], [4.001, 0.002, 0.003], rtol=1e-5)
        np.testing.assert_array_equal(x[2], [5.0, 0.0, 0.0])
        assert v[0, 2] == pytest.approx(3.0 - 9.81e-3)

    def test_are_no_faster_than_the_model_says(self, device):
        model = self.model(device)
        model.particle_max_velocity = 0.5
        before, after = model.state(), model.state()
        wn.SolverCorotated(model).step(before, after, None, None, 1e-3)
        speed = np.linalg.norm(after.particle_qd.numpy()[8:10], axis=1)
        np.testing.assert_allclose(speed, 0.5, rtol=1e-5)

    def test_one_state_can_be_both(self, device, rng):
        model = grid_model(device)
        x = model.particle_q.numpy() + 0.01 * rng.standard_normal((model.particle_count, 3)).astype(np.float32)
        solver = wn.SolverCorotated(model)
        before, after, both = model.state(), model.state(), model.state()
        before.particle_q.assign(x)
        both.particle_q.assign(x)
        solver.step(before, after, None, None, 1e-4)
        solver.step(both, both, None, None, 1e-4)
        # CUDA sums forces in any order.
        few = 0.0 if model.device.is_cpu else 2e-6
        for name in ("particle_q", "particle_qd"):
            a, b = (getattr(state, name).numpy() for state in (after, both))
            np.testing.assert_allclose(a, b, rtol=0, atol=few * np.abs(a).max())
        assert np.abs(after.particle_qd.numpy()).max() > 0.01

    def test_substeps_are_steps(self, device):
        model = grid_model(device, fix_left=True)
        whole = run(wn.SolverCorotated(model), model, 40, 2e-4).particle_q.numpy()
        parts = run(wn.SolverCorotated(model, substeps=4), model, 10, 8e-4).particle_q.numpy()
        np.testing.assert_allclose(parts, whole, atol=1e-6)


class TestAttributes:
    """Rotations and stresses in the state."""

    def model(self, device, forest=False):
        made = builder(gravity=(0.0, 0.0, 0.0))
        wn.SolverCorotated.register_custom_attributes(made)
        if forest:
            wn.add_forest(made, adaptive_forest(3), wc.Isotropic(1e4, 0.3, 1000.0))
        add_grid(made, pos=(0.0, 2.0, 0.0))
        return made.finalize(device=device)

    def test_of_a_stretched_and_turned_body(self, device):
        model = self.model(device, forest=True)
        turn = wp.quat_from_axis_angle(wp.normalize(wp.vec3(1.0, 2.0, -1.0)), 1.0)
        Q = np.array(wp.quat_to_matrix(turn)).reshape(3, 3)
        U = np.diag([1.1, 0.95, 1.0])
        before, after = model.state(), model.state()
        before.particle_q.assign((model.particle_q.numpy() @ (Q @ U).T).astype(np.float32))
        wn.SolverCorotated(model).step(before, after, None, None, 1e-8)
        mu, lam = (model.tet_materials.numpy().reshape(-1, 3)[:, k, None, None] for k in (0, 1))
        stress = Q @ (2 * mu * (U - np.eye(3)) + lam * np.trace(U - np.eye(3)) * np.eye(3)) @ Q.T
        q = after.warp_corot.rotation.numpy()
        np.testing.assert_allclose(q * np.sign(q[:, 3:]), np.broadcast_to(np.array(turn), q.shape), atol=1e-5)
        size = np.abs(stress).max()
        np.testing.assert_allclose(after.warp_corot.stress.numpy(), stress, atol=1e-4 * size)
        dev = stress - np.trace(stress, axis1=1, axis2=2)[:, None, None] * np.eye(3) / 3
        equivalent = np.sqrt(1.5 * np.einsum("tij,tij->t", dev, dev))
        np.testing.assert_allclose(after.warp_corot.von_mises.numpy(), equivalent, rtol=1e-3)

    def test_travel_with_states(self, device, rng):
        model = self.model(device)
        before, after, copied = model.state(), model.state(), model.state()
        before.particle_q.assign(model.particle_q.numpy() + 0.01 * rng.standard_normal((36, 3)).astype(np.float32))
        solver = wn.SolverCorotated(model)
        solver.step(before, after, None, None, 1e-4)
        copied.assign(after)
        np.testing.assert_array_equal(copied.warp_corot.rotation.numpy(), after.warp_corot.rotation.numpy())
        solver.reset(copied)
        initial = model.state().warp_corot
        np.testing.assert_allclose(copied.warp_corot.rotation.numpy(), initial.rotation.numpy(), atol=1e-7)
        np.testing.assert_array_equal(copied.particle_q.numpy(), model.particle_q.numpy())

    def test_are_found_again_in_newtons_recordings(self, device, rng, tmp_path):
        """Newton's recorder returns a model and states that continue like the recorded ones, forests included."""
        from newton.viewer import ViewerFile

        model = self.model(device, forest=True)
        before, after = model.state(), model.state()
        x = model.particle_q.numpy() + 0.01 * rng.standard_normal((model.particle_count, 3))
        before.particle_q.assign(x.astype(np.float32))
        solver = wn.SolverCorotated(model)
        solver.step(before, after, None, None, 1e-4)
        viewer = ViewerFile(str(tmp_path / "run.json"))
        viewer.set_model(model)
        viewer.begin_frame(0.0)
        viewer.log_state(after)
        viewer.end_frame()
        viewer.close()
        again = ViewerFile(str(tmp_path / "other.json"), auto_save=False)
        again.load_recording(str(tmp_path / "run.json"))
        loaded = newton.Model(device=device)
        again.load_model(loaded)
        state = loaded.state()
        again.load_state(state, 0)
        with pytest.warns(UserWarning, match="from a file.* one by one"):
            restored = wn.SolverCorotated(loaded)
        restored.write_attributes(state)
        for name in ("rotation", "stress", "von_mises"):
            found, had = (getattr(s.warp_corot, name).numpy() for s in (state, after))
            np.testing.assert_allclose(found, had, atol=1e-5 * np.abs(had).max())
        ends = [model.state(), loaded.state()]
        solver.step(after, ends[0], None, None, 1e-4)
        restored.step(state, ends[1], None, None, 1e-4)
        np.testing.assert_allclose(ends[1].particle_qd.numpy(), ends[0].particle_qd.numpy(), atol=1e-5)


class TestBadInput:
    def expect(self, message, model, **options):
        with pytest.raises(wc.InputError, match=message):
            wn.SolverCorotated(model, **options)

    def test_models(self, device):
        self.expect("model is None; it must be a newton.Model", None)
        self.expect("model is a ModelBuilder; it must be", builder())
        self.expect("no tetrahedra", builder().finalize(device=device))
        for mu, lam, message in ((-1.0, 1e4, "k_mu -1"), (1e4, -1e4, "must be positive"), (np.nan, 1e4, "k_mu nan")):
            self.expect(f"tetrahedron 0 has .*{message}", grid_model(device, mu=mu, lam=lam))
        self.expect("k_damp -1", grid_model(device, damp=-1.0))
        wn.SolverCorotated(grid_model(device, mu=1e4, lam=-5e3))
        self.expect("lambda -", grid_model(device, mu=1e4, lam=-5e3), lame="semi-implicit")

    def test_options(self, device):
        model = grid_model(device)
        for name, value in (
            ("lame", "newton"),
            ("damping", -1.0),
            ("lame", None),
            ("lame", ["documented"]),
            ("damping", None),
            ("damping", "1"),
            ("damping", np.nan),
            ("substeps", 0),
            ("substeps", 1.5),
            ("substeps", "4"),
            ("substeps", True),
            ("substeps", np.inf),
            ("substeps", np.nan),
            ("substeps", [2]),
            ("stable_dt", 0.0),
            ("stable_dt", "1"),
            ("rigid_solver", "mujoco"),
        ):
            self.expect(f"{name} is ", model, **{name: value})

    def test_a_step_beyond_stability(self, device):
        model = grid_model(device)
        solver = wn.SolverCorotated(model, substeps=1)
        after = model.state()
        kept = after.particle_qd.numpy()
        with pytest.raises(wc.InputError, match=r"largest stable step is about .* substeps=") as told:
            solver.step(model.state(), after, None, None, 1.2 * solver.stable_dt)
        np.testing.assert_array_equal(after.particle_qd.numpy(), kept)
        count = int(re.search(r"substeps=(\d+)", str(told.value))[1])
        run(wn.SolverCorotated(model, substeps=count), model, 10, 1.2 * solver.stable_dt)
        run(wn.SolverCorotated(model, substeps=None), model, 10, 1.2 * solver.stable_dt)
        for dt in (0.0, -1e-4, np.nan, np.inf, None, "1e-4"):
            with pytest.raises(wc.InputError, match="dt is"):
                solver.step(model.state(), after, None, None, dt)

    def test_states_that_are_not_finite(self, device):
        model = grid_model(device)
        solver = wn.SolverCorotated(model)
        before, after = model.state(), model.state()
        x = before.particle_q.numpy()
        x[3, 1] = np.nan
        before.particle_q.assign(x)
        with pytest.raises(wc.InputError, match="state_in is not finite"):
            checked_step(solver, before, after)
        np.testing.assert_array_equal(after.particle_q.numpy(), model.particle_q.numpy())
        solver.step(model.state(), after, None, None, 1e-4)
        solver.check()

    def test_results_that_are_not_finite(self, device):
        model = grid_model(device)
        solver = wn.SolverCorotated(model)
        before, after = model.state(), model.state()
        before.particle_f.fill_(wp.vec3(3e38, 0.0, 0.0))
        with pytest.raises(wc.UnstableError, match="result is not finite"):
            checked_step(solver, before, after)
        np.testing.assert_array_equal(after.particle_q.numpy(), model.particle_q.numpy())
        np.testing.assert_array_equal(after.particle_qd.numpy(), model.particle_qd.numpy())

    def test_contacts(self, device):
        made = builder()
        made.add_ground_plane()
        add_grid(made)
        model = made.finalize(device=device)
        self.refuses(model, "more soft contacts than contacts.soft_contact_max", soft_contact_max=4)

    def refuses(self, model, message, change=lambda contacts: None, **options):
        solver = wn.SolverCorotated(model)
        pipeline = newton.CollisionPipeline(model, **options)
        contacts = pipeline.contacts()
        before, after = model.state(), model.state()
        pipeline.collide(before, contacts)
        change(contacts)
        with pytest.raises(wc.InputError, match=message):
            checked_step(solver, before, after, contacts)
        np.testing.assert_array_equal(after.particle_q.numpy(), model.particle_q.numpy())

    def test_states_of_other_models(self, device):
        model, other = grid_model(device), grid_model(device, dims=(1, 1, 1))
        solver = wn.SolverCorotated(model)
        with pytest.raises(wc.InputError, match="state_out has 8 particles; the model has 36"):
            solver.step(model.state(), other.state(), None, None, 1e-4)
        with pytest.raises(wc.InputError, match=r"state_in is None; it must be a newton.State"):
            solver.step(None, model.state(), None, None, 1e-4)
        with pytest.raises(wc.InputError, match="state_out is a SimpleNamespace"):
            solver.step(model.state(), SimpleNamespace(particles=3), None, None, 1e-4)
        with pytest.raises(wc.InputError, match="control has 5 tet_activations"):
            solver.step(model.state(), model.state(), other.control(), None, 1e-4)

    def test_states_on_other_devices(self, device):
        """A machine may have one device only: the check uses the device of a state's arrays."""
        model = grid_model(device)
        solver = wn.SolverCorotated(model)

        class Elsewhere(list):
            device = "cuda:7"

        for name, given in (("state_in", 0), ("state_out", 1)):
            states = [model.state(), model.state()]
            states[given] = SimpleNamespace(particle_q=Elsewhere(range(model.particle_count)))
            with pytest.raises(wc.InputError, match=f"{name} is on cuda:7; the model is on {device}"):
                solver.step(*states, None, None, 1e-4)

    def test_changed_models(self, device):
        """Stable steps follow stiffness and mass; gravity alone changes nothing; a bad material is an error."""
        model = grid_model(device)
        solver = wn.SolverCorotated(model)
        stable = solver.stable_dt
        materials = model.tet_materials.numpy().copy()
        model.tet_materials.assign(4 * materials)
        model.set_gravity((0.0, 0.0, 1.0))
        solver.notify_model_changed(newton.ModelFlags.MODEL_PROPERTIES)
        assert solver.stable_dt == pytest.approx(stable / 2, rel=1e-3)
        inverse = model.particle_inv_mass.numpy()
        model.particle_inv_mass.assign(inverse / 4)
        solver.notify_model_changed(newton.ModelFlags.MODEL_PROPERTIES)
        assert solver.stable_dt == pytest.approx(stable, rel=1e-3)
        model.tet_materials.assign(-materials)
        with pytest.raises(wc.InputError, match="tetrahedron 0 has"):
            solver.notify_model_changed(newton.ModelFlags.MODEL_PROPERTIES)

    def test_hard_attachments(self, device):
        made = builder()
        body = made.add_body(mass=1.0, inertia=wp.mat33(np.eye(3)))
        add_grid(made)
        made.add_attachment_particle_body(0, body, stiffness=float("inf"))
        self.expect("attachment 0 has stiffness inf", made.finalize(device=device))

    def test_wrongly_wound_tetrahedra(self, device):
        """Newton's builder leaves them out and logs it; ``add_mesh`` repairs them."""
        grid = grid_model(device)
        points, tets = grid.particle_q.numpy(), grid.tet_indices.numpy().reshape(-1, 4).copy()
        tets[7] = tets[7][[0, 1, 3, 2]]
        made = builder()
        wn.add_mesh(made, wc.TetMesh(points, tets), wc.Isotropic(1e4, 0.3, 1000.0))
        model = made.finalize(device=device)
        assert model.tet_count == len(tets)
        assert model.particle_mass.numpy().sum() == pytest.approx(1000.0 * 0.3 * 0.2 * 0.2)

    def test_what_is_added(self):
        made, material = builder(), wc.Isotropic(1e4, 0.3, 1000.0)
        forest = wc.TetForest.box()
        mesh = wc.TetMesh(forest.points, forest.tets)
        with pytest.raises(wc.InputError, match="add_forest takes a TetForest"):
            wn.add_forest(made, mesh, material)
        with pytest.raises(wc.InputError, match="add_mesh takes a TetMesh"):
            wn.add_mesh(made, forest, material)
        with pytest.raises(wc.InputError, match="builder is"):
            wn.add_mesh(None, mesh, material)
        with pytest.raises(wc.InputError, match="rot is"):
            wn.add_mesh(made, mesh, material, rot=(0, 0, 0))
        with pytest.raises(wc.InputError, match="k_damp is -1"):
            wn.add_mesh(made, mesh, material, k_damp=-1.0)
        assert made.particle_count == made.tet_count == 0


def test_a_forest_from_elsewhere_goes_one_by_one(device, rng):
    made = builder()
    wn.add_forest(made, adaptive_forest(3), wc.Isotropic(1e4, 0.3, 1000.0))
    model = made.finalize(device=device)
    x = model.particle_q.numpy() + 0.01 * rng.standard_normal((model.particle_count, 3))
    wanted = impulse(wn.SolverCorotated(model), model, x)
    # A name that was written to a file, or that of a larger forest with the same name.
    for name in (str(model.warp_corot.forest[0]), ForestName.of(adaptive_forest(3, 0.5))):
        model.warp_corot.forest[0] = name
        with pytest.warns(UserWarning, match="one by one"):
            solver = wn.SolverCorotated(model)
        assert solver.tetrahedra.single_count == model.tet_count
        np.testing.assert_allclose(impulse(solver, model, x), wanted, atol=1e-3 * np.abs(wanted).max())


def test_a_forest_lives_as_long_as_its_models(device):
    """The model keeps its forest alive, and no list keeps the forests of deleted models."""
    forest = adaptive_forest(2)
    watched, made = weakref.ref(forest), builder()
    for k in range(2):
        wn.add_forest(made, forest, wc.Isotropic(1e4, 0.3, 1000.0), pos=(k, 0.0, 0.0))
    whole = builder()
    whole.replicate(made, 3)
    model = whole.finalize(device=device)
    del forest, made, whole
    gc.collect()
    assert wn.SolverCorotated(model).tetrahedra.groups[0].copies == 6
    del model
    gc.collect()
    assert watched() is None


class TestImports:
    def test_only_newtons_public_interface(self):
        for path in [*PACKAGE.rglob("*.py"), *PACKAGE.parents[1].glob("kernels/newton/*.py")]:
            text = path.read_text(encoding="utf-8")
            assert "_src" not in text, path
            imported = re.search(r"^\s*(import|from) newton\b", text, re.M) is not None
            assert imported == (path.name == "library.py"), path

    def test_without_newton(self):
        code = (
            "import sys; sys.modules['newton'] = None\n"
            "import warp_corot.newton as wn\n"
            "try: wn.SolverCorotated\n"
            "except ImportError as error: print(error)\n"
        )
        told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
        assert 'pip install "warp-corot[newton]"' in told
        assert len(told.strip().splitlines()) == 1

    def test_newton_is_not_imported_for_nothing(self):
        code = "import sys, warp_corot, warp_corot.newton; warp_corot.SoftBody; print('newton' in sys.modules)"
        told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
        assert told.strip().endswith("False")
