"""The largest stable steps of the Newton solver: closed forms, linearised forces, and the motion at these steps."""

import warnings

import numpy as np
import pytest
import warp as wp
from newton_scenes import add_grid, builder, grid_model, newton, run, stepped, wc, wn

M = 0.02


def held_builder(gravity=(0.0, 0.0, 0.0)):
    """A builder with fixed tetrahedra, so that only added things move."""
    made = builder(gravity=gravity)
    add_grid(made, dims=(1, 1, 1), pos=(0.0, 0.0, -3.0))
    made.particle_mass[:] = [0.0] * made.particle_count
    return made


def particles(made, points, mass=M):
    """Add particles of one mass, or of a list of masses; returns their indices."""
    first = made.particle_count
    for x, m in zip(points, np.broadcast_to(mass, len(points)), strict=True):
        made.add_particle(wp.vec3(*map(float, x)), wp.vec3(), float(m))
    return list(range(first, made.particle_count))


def cloth(made, dims=(5, 4), cell=0.1, mass=M, tri_ke=1e3, tri_ka=1e3, tri_kd=0.0, edge_ke=0.0, edge_kd=0.0, **options):
    made.add_cloth_grid(
        pos=wp.vec3(),
        rot=wp.quat_from_axis_angle(wp.normalize(wp.vec3(1.0, 2.0, 3.0)), 0.7),
        vel=wp.vec3(),
        dim_x=dims[0],
        dim_y=dims[1],
        cell_x=cell,
        cell_y=cell,
        mass=mass,
        **{"tri_ke": tri_ke, "tri_ka": tri_ka, "tri_kd": tri_kd, "edge_ke": edge_ke, "edge_kd": edge_kd, **options},
    )


def ragged_cloth(made, rng, **options):
    """A cloth of triangles of many shapes that is not flat."""
    from scipy.spatial import Delaunay

    points = rng.uniform(0.0, 1.0, (20, 2))
    tris = Delaunay(points).simplices
    points = np.c_[points, 0.2 * np.sin(5 * points[:, 0])]
    made.add_cloth_mesh(
        pos=wp.vec3(), rot=wp.quat_identity(), scale=1.0, vel=wp.vec3(), vertices=points.tolist(),
        indices=tris.ravel().tolist(), density=1.0, **options,
    )  # fmt: skip


def spring_net(made, rng):
    """Particles of several masses, each fixed or with springs to some others."""
    mass = rng.uniform(0.01, 0.05, 20)
    mass[:2] = 0.0
    ids = particles(made, rng.uniform(0.0, 0.5, (20, 3)), mass)
    for i in ids:
        for j in ids[: i - ids[0]]:
            if rng.random() < 0.3:
                made.add_spring(i, j, ke=rng.uniform(50, 500), kd=rng.uniform(0.0, 0.5), control=0.0)


def expected(w2, c=0.0):
    """The step at which w^2 dt^2 + 2 c dt = 4."""
    return 4.0 / (c + np.sqrt(c * c + 4.0 * w2))


class TestClosedForms:
    def stable(self, made, device, **options):
        with warnings.catch_warnings():
            warnings.simplefilter("error", UserWarning)
            return wn.SolverCorotated(made.finalize(device=device), **options).stable_dt

    def test_nothing_stiff(self, device):
        made = held_builder()
        a, b = particles(made, [[0, 0, 0], [1, 0, 0]])
        made.add_spring(a, b, ke=0.0, kd=0.0, control=0.0)
        assert self.stable(made, device) == np.inf

    @pytest.mark.parametrize("kd", [0.0, 3.0])
    def test_two_masses_on_a_spring(self, device, kd):
        made = held_builder()
        a, b = particles(made, [[0, 0, 0], [0.3, 0.1, 0]], [M, 3 * M])
        made.add_spring(a, b, ke=500.0, kd=kd, control=0.0)
        inverse = (1 + 1 / 3) / M
        assert self.stable(made, device) == pytest.approx(expected(500 * inverse, kd * inverse), rel=1e-4)

    @pytest.mark.parametrize(("rest", "springs"), [(1.0, 2.0), (0.5, 3.0), (1.5, 2.0)])
    def test_springs_in_tension(self, device, rest, springs):
        """A mass in the middle of a cross: 2k along one bar, and 2k (1 - L/l) across the other, which is in tension."""
        made = held_builder()
        a = particles(made, [[0, 0, 0]])[0]
        for b in particles(made, [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]], 0.0):
            made.add_spring(a, b, ke=200.0, kd=0.0, control=0.0)
        made.spring_rest_length[:] = [rest] * 4
        assert self.stable(made, device) == pytest.approx(expected(springs * 200 / M), rel=1e-4)

    @pytest.mark.parametrize(("ka", "kd"), [(700.0, 0.0), (700.0, 5.0), (0.0, 5.0)])
    def test_a_triangle(self, device, ka, kd):
        """Its one free corner moves perpendicular to the fixed side: W = A (k_mu + k_lambda) (u/a)^2 / 2, A = a^2 /
        2."""
        made = held_builder()
        i, j, k = particles(made, [[0, 0, 0], [0.2, 0, 0], [0, 0.2, 0]], [0.0, 0.0, M])
        made.add_triangle(i, j, k, tri_ke=400.0, tri_ka=ka, tri_kd=kd, tri_drag=0.0, tri_lift=0.0)
        dampers = 2 if ka else 1
        wanted = expected((400.0 + ka) / (2 * M), dampers * kd / (2 * M))
        assert self.stable(made, device) == pytest.approx(wanted, rel=1e-4)

    @pytest.mark.parametrize("kd", [0.0, 0.01])
    def test_a_hinge(self, device, kd):
        """Newton's force on the one free corner: e^2 (k theta + k_d e du/dt), theta = u / h."""
        made = held_builder()
        e, h = 0.3, 0.2
        ids = particles(made, [[0.1, -h, 0], [0.1, 0.4, 0], [0, 0, 0], [e, 0, 0]], [M, 0.0, 0.0, 0.0])
        made.add_edge(*ids, edge_ke=2.0, edge_kd=kd)
        wanted = expected(2.0 * e * e / (h * M), kd * e**3 / M)
        assert self.stable(made, device) == pytest.approx(wanted, rel=1e-4)

    @pytest.mark.parametrize("kd", [0.5, 20.0, 200.0])
    def test_a_stiff_spring_and_a_damper_apart(self, device, kd):
        """Neither shortens the other's step."""
        made = held_builder()
        a, b, c, d = particles(made, [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], [M, 0.0, M, 0.0])
        made.add_spring(a, b, ke=5000.0, kd=0.0, control=0.0)
        made.add_spring(c, d, ke=1.0, kd=kd, control=0.0)
        wanted = min(expected(5000.0 / M), expected(1.0 / M, kd / M))
        assert self.stable(made, device) == pytest.approx(wanted, rel=0.015)

    def test_several_things_apart(self, device):
        """The smallest step counts."""
        steps = []
        for which in ([0], [1], [2], [0, 1, 2]):
            made = builder()
            if 0 in which:
                add_grid(made, dims=(2, 1, 1))
            else:
                made = held_builder()
            if 1 in which:
                cloth(made, dims=(3, 3))
            if 2 in which:
                a, b = particles(made, [[2, 0, 0], [3, 0, 0]])
                made.add_spring(a, b, ke=900.0, kd=0.0, control=0.0)
            steps.append(self.stable(made, device))
        assert steps[3] == pytest.approx(min(steps[:3]), rel=1e-3)
        assert max(steps[:3]) > 1.5 * min(steps[:3])


def linear_limit(model):
    """The step at which dt^2 M^-1 K + 2 dt M^-1 C has the eigenvalue 4, by differences of the solver's own steps."""
    solver = wn.SolverCorotated(model, stable_dt=1.0)
    states = model.state(), model.state()
    x, dt = model.particle_q.numpy().astype(float), 1e-3

    def acceleration(moved, velocity):
        before, after = states
        before.particle_q.assign(moved.astype(np.float32))
        before.particle_qd.assign(velocity.astype(np.float32))
        solver.step(before, after, None, None, dt)
        return (after.particle_qd.numpy().astype(float) - velocity).ravel() / dt

    still, free = np.zeros_like(x), np.flatnonzero(np.repeat(model.particle_inv_mass.numpy() > 0, 3))
    stiffness, damping = np.zeros((2, len(free), len(free)))
    for column, k in enumerate(free):
        unit = np.zeros_like(x)
        unit.flat[k] = 1.0
        a, b = (acceleration((x + h * unit).astype(np.float32), still) for h in (2e-4, -2e-4))
        stiffness[:, column] = (b - a)[free] / 4e-4
        damping[:, column] = (acceleration(x, -unit) - acceleration(x, unit))[free] / 2
    step = expected(*(max(np.linalg.eigvals(a).real.max(), 0.0) for a in (stiffness, damping)))
    for _ in range(50):
        step *= np.sqrt(4.0 / np.linalg.eigvals(step * step * stiffness + 2 * step * damping).real.max())
    return step


class TestOwnForces:
    """Forces of small motions equal those in the solver's steps, Newton's included."""

    @pytest.mark.parametrize("stretch", [1.0, 1.2])
    @pytest.mark.parametrize(
        "options",
        [
            {},
            {"tri_ka": 0.0},
            {"tri_ka": 5e3, "tri_kd": 0.5},
            {"tri_ke": 0.0, "tri_ka": 0.0, "edge_ke": 1.0, "edge_kd": 1e-3},
            {"tri_ke": 10.0, "tri_ka": 10.0, "tri_kd": 0.1, "edge_ke": 0.5, "edge_kd": 1e-3},
        ],
        ids=["stretching", "no area", "damped", "bending", "both"],
    )
    def test_of_cloth(self, device, options, stretch):
        made = held_builder()
        cloth(made, dims=(4, 3), **options)
        self.check(made, device, stretch)

    @pytest.mark.parametrize("kind", ["stretching", "bending"])
    def test_of_ragged_cloth(self, device, rng, kind):
        made = held_builder()
        tri, edge = (1e3, 0.0) if kind == "stretching" else (0.0, 1.0)
        ragged_cloth(made, rng, tri_ke=tri, tri_ka=tri, tri_kd=0.0, edge_ke=edge, edge_kd=0.0)
        self.check(made, device)

    def test_of_springs(self, device, rng):
        made = held_builder()
        spring_net(made, rng)
        self.check(made, device)

    def test_of_a_body_with_a_skin(self, device):
        made = builder(gravity=(0.0, 0.0, 0.0))
        add_grid(made, dims=(2, 1, 1), damp=20.0, tri_ke=3e3, tri_ka=2e3, tri_kd=1.0, edge_ke=0.5, fix_left=True)
        made.add_spring(3, 8, ke=2e4, kd=5.0, control=0.0)
        self.check(made, device)

    def check(self, made, device, stretch=1.0):
        model = made.finalize(device=device)
        model.particle_q.assign(stretch * model.particle_q.numpy())
        assert wn.SolverCorotated(model).stable_dt == pytest.approx(linear_limit(model), rel=0.015)


class TestSteps:
    """Slightly below the largest stable step a small motion stays small, slightly above it does not."""

    def tetrahedra(damp):
        made = builder(gravity=(0.0, 0.0, 0.0))
        add_grid(made, damp=damp)
        return made

    def of_cloth(**options):
        made = held_builder()
        cloth(made, fix_left=True, **options)
        return made

    def of_springs():
        made = held_builder()
        spring_net(made, np.random.default_rng(1))
        return made

    def with_skin():
        made = builder(gravity=(0.0, 0.0, 0.0))
        add_grid(made, tri_ke=2e4, tri_ka=2e4, tri_kd=1.0, edge_ke=0.1, fix_left=True)
        return made

    SCENES = {  # noqa: RUF012 - it is not changed
        "tetrahedra": lambda tetrahedra=tetrahedra: tetrahedra(0.0),
        "damped tetrahedra": lambda tetrahedra=tetrahedra: tetrahedra(300.0),
        "cloth": of_cloth,
        "damped cloth": lambda of_cloth=of_cloth: of_cloth(tri_kd=0.5, edge_ke=0.1, edge_kd=1e-3),
        "bending": lambda of_cloth=of_cloth: of_cloth(tri_ke=0.0, tri_ka=0.0, edge_ke=1.0),
        "springs": of_springs,
        "skin": with_skin,
    }

    @pytest.mark.parametrize("scene", SCENES)
    def test_what_they_are_said_to_be(self, device, scene):
        model = self.SCENES[scene]().finalize(device=device)
        stable = wn.SolverCorotated(model).stable_dt
        start = np.random.default_rng(0).standard_normal((model.particle_count, 3))
        start *= 1e-6 / stable * (model.particle_inv_mass.numpy() > 0)[:, None]
        moved = []
        for factor, steps in ((0.96, 2000), (1.12, 400)):
            solver = wn.SolverCorotated(model, stable_dt=1.0)
            v = start
            model.particle_qd.assign(v.astype(np.float32))
            try:
                v = run(solver, model, steps, factor * stable).particle_qd.numpy()
            except wc.UnstableError:
                v = np.array(np.inf)
            moved.append(np.abs(v).max() / np.abs(start).max())
        assert moved[0] < 3.0
        assert moved[1] > 30.0

    def test_of_hanging_cloth(self, device):
        """It swings under gravity at substeps=None: no faster than in free fall, no longer than under its weight."""
        made = held_builder(gravity=(0.0, 0.0, -9.81))
        cloth(made, tri_ke=2e3, tri_ka=2e3, tri_kd=0.05, edge_ke=0.01, fix_left=True)
        model = made.finalize(device=device)
        solver = wn.SolverCorotated(model, substeps=None)
        state = run(solver, model, 60, 1 / 60)
        x, v = (a.numpy()[8:] for a in (state.particle_q, state.particle_qd))
        held = model.particle_inv_mass.numpy()[8:] == 0
        away = np.linalg.norm(x[:, None] - x[held], axis=2).min(axis=1)
        assert 0.45 < away.max() < 0.65
        assert np.abs(v).max() < np.sqrt(2 * 9.81 * 1.0)


class TestContactOfParticles:
    def test_a_heap_gains_no_energy(self, device):
        """55 spheres in closest packing, slightly compressed: their repulsion is their only energy."""
        made = held_builder()
        ijk = np.stack(np.meshgrid(*3 * [np.arange(-2, 3)], indexing="ij"), axis=-1).reshape(-1, 3)
        ijk = ijk[(ijk.sum(axis=1) % 2 == 0) & (np.square(ijk).sum(axis=1) <= 8)]
        radius, ke = 0.05, 1e4
        for x in ijk * 0.98 * np.sqrt(2.0) * radius:
            made.add_particle(wp.vec3(*map(float, x)), wp.vec3(), M, radius=radius)
        model = made.finalize(device=device)
        model.particle_ke, model.particle_kd, model.particle_kf, model.particle_mu = ke, 0.0, 0.0, 0.0
        solver = wn.SolverCorotated(model, substeps=None, particle_contact=True)
        assert solver.stable_dt == np.inf
        arms = np.linalg.norm(ijk[:, None] - ijk, axis=2)
        pairs = int((np.isclose(arms, np.sqrt(2.0))).sum()) // 2
        energy = 0.5 * ke * pairs * (0.02 * 2 * radius) ** 2
        states = stepped(solver, model, 200, 0.7 * solver.contact_dt)
        kinetic = [0.5 * M * np.square(state.particle_qd.numpy().astype(float)).sum() for state in states]
        assert len(ijk) == 55
        # With w^2 dt^2 below 2, a mode that begins at rest has at most twice its energy in its fastest moment.
        assert max(kinetic) < 2.0 * energy
        assert kinetic[-1] > 0.5 * energy

    def test_is_newtons(self, device, rng):
        """With any grid for the neighbour search."""
        made = held_builder()
        points = rng.uniform(0.0, 1.0, (300, 3))
        for x, v in zip(points, rng.standard_normal((300, 3)), strict=True):
            made.add_particle(wp.vec3(*map(float, x)), wp.vec3(*map(float, v)), M, radius=0.05)
        model = made.finalize(device=device)
        ends = []
        for solver in (
            wn.SolverCorotated(model, particle_contact=True),
            newton.solvers.SolverSemiImplicit(model, enable_tri_contact=False),
        ):
            *_, state = stepped(solver, model, 20, 2e-5)
            ends.append(state.particle_qd.numpy()[8:])
        assert np.abs(ends[1] - model.particle_qd.numpy()[8:]).max() > 0.1
        np.testing.assert_allclose(ends[0], ends[1], atol=2e-5 * np.abs(ends[1]).max())

    def test_it_has_no_effect_without_contact(self, device):
        model = grid_model(device)
        apart, together = (wn.SolverCorotated(model, particle_contact=c).contact_dt for c in (False, True))
        assert together < apart
        model.particle_kd *= 10.0
        solver = wn.SolverCorotated(model, particle_contact=True)
        assert solver.contact_dt < together
        assert solver.stable_dt == pytest.approx(apart, rel=1e-5)


class TestChangedModels:
    @pytest.mark.parametrize("kind", ["springs", "triangles", "bending edges"])
    def test_stable_steps_follow_stiffness(self, device, rng, kind):
        made = held_builder()
        if kind == "springs":
            spring_net(made, rng)
            made.spring_damping[:] = [0.0] * len(made.spring_damping)
        else:
            cloth(made, **({} if kind == "triangles" else {"tri_ke": 0.0, "tri_ka": 0.0, "edge_ke": 1.0}))
        model = made.finalize(device=device)
        solver = wn.SolverCorotated(model)
        before = solver.stable_dt
        for array in (model.spring_stiffness, model.tri_materials, model.edge_bending_properties):
            if array is not None:
                array.assign(4.0 * array.numpy())
        solver.notify_model_changed(newton.ModelFlags.MODEL_PROPERTIES)
        assert solver.stable_dt == pytest.approx(before / 2, rel=1e-3)


def test_damping_acts_on_everything(device):
    """Also if Newton's solver moves the particles: v / (1 + dt c) in a step, and positions with that velocity."""
    made = builder(gravity=(0.0, 0.0, 0.0))
    add_grid(made, dims=(1, 1, 1), vel=(1.0, 0.0, 0.0))
    made.add_spring(0, 1, ke=10.0, kd=0.0, control=0.0)
    made.add_particle(wp.vec3(3.0, 0.0, 0.0), wp.vec3(1.0, 0.0, 0.0), 0.0)
    model = made.finalize(device=device)
    state = run(wn.SolverCorotated(model, damping=50.0), model, 10, 1e-3)
    x, v = state.particle_q.numpy() - model.particle_q.numpy(), state.particle_qd.numpy()
    share = 1.05 ** -np.arange(1.0, 11.0)
    np.testing.assert_allclose(v[:, 0], [share[-1]] * 8 + [1.0], rtol=1e-4)
    np.testing.assert_allclose(x[:, 0], [1e-3 * share.sum()] * 8 + [1e-2], rtol=1e-3)
