"""The force plan derived on the device equals that of the current mesh, with padding that does nothing."""

import numpy as np
import pytest
import warp as wp
from remesh_cases import CUBE, RemeshPass, apply_marks, random_marks
from shortened import crossed

import warp_corot as wc
from warp_corot.discretization.changing.plan import DevicePlan, launch_size
from warp_corot.discretization.changing.pools import DeviceForest
from warp_corot.discretization.elements import device_elements
from warp_corot.discretization.plan import Sharing
from warp_corot.discretization.planner import ForcePlan, units_of
from warp_corot.kernels.remesh.pools import SINKS
from warp_corot.kernels.tables.shapes import FRAME_SHIFT

MESHES = {
    "uniform": lambda: wc.TetForest.box((2, 1, 1), CUBE, 7),
    "coarse": lambda: wc.TetForest.box((1, 1, 1), CUBE, 2),
    "sphere": lambda: wc.TetForest.from_domain(wc.Domain.sphere(0.05), 0.04, max_level=6, surface_error=1e-3),
}


def made(mesh, device, room=4, **options):
    forest = MESHES[mesh]()
    return DeviceForest(forest, room * len(forest.tets), device=device, **options)


def shapes(elements, chosen):
    """The meaning of codes for any order of the table of frames: level and handedness, and the frame itself."""
    code = elements.code.numpy()[chosen]
    low = code & ((1 << FRAME_SHIFT) - 1)
    return np.column_stack([low, elements.frames.numpy()[code >> FRAME_SHIFT].reshape(len(code), 9)])


def assert_same_shapes(found, expected, chosen, other):
    np.testing.assert_allclose(shapes(found, chosen), shapes(expected, other), atol=1e-7)


def assert_same_elements(found, expected, chosen, other):
    assert np.array_equal(found.nodes.numpy()[chosen], expected.nodes.numpy()[other])
    assert_same_shapes(found, expected, chosen, other)


def by_unit(batch):
    """Nodes of a batch's subtrees or leaves, a row for each."""
    nodes = batch.subtrees.nodes.numpy()
    return nodes if batch.grouped or batch.flagged.device.is_cpu else nodes.T


class Comparison:
    """A derived plan, and that of the exported mesh."""

    def __init__(self, plan, forest, rotation_level, grouped):
        mesh = forest.to_forest()
        self.plan, self.forest = plan, forest
        self.leaves = len(mesh.tets)
        self.expected = ForcePlan.of_forest(mesh, rotation_level, forest.device, grouped=grouped)
        self.mesh_elements = device_elements(mesh, forest.device)
        self.mesh_units = None
        if rotation_level is not None:
            self.mesh_units = units_of(mesh, self.mesh_elements, rotation_level, 1)

    def check(self):
        plan, expected = self.plan, self.expected
        everything = slice(self.leaves)
        assert_same_elements(plan.elements, self.mesh_elements, everything, everything)
        self.assert_padding(plan.elements, self.leaves)
        batches = {(b.sharing, b.shape, b.grouped): b for b in expected.batches}
        found = {(b.sharing, b.shape, b.grouped): b for b in plan.batches}
        assert list(batches) == [key for key in found if key in batches]
        for key, batch in found.items():
            self.check_batch(batch, batches.get(key))
        self.check_flat()
        self.check_units()

    def check_batch(self, batch, expected):
        count = 0 if expected is None else expected.count
        assert batch.count >= count
        assert batch.count % 64 == 0
        here = slice(count)
        nodes, rows = by_unit(batch), count // 8 if batch.grouped else count
        if expected is not None:
            assert np.array_equal(batch.subtrees.first.numpy()[here], expected.subtrees.first.numpy())
            assert np.array_equal(nodes[:rows], by_unit(expected))
            assert_same_shapes(batch.subtrees, expected.subtrees, here, here)
            if batch.sharing is Sharing.ABOVE:
                own, other = batch.unit.numpy()[here], expected.unit.numpy()
                assert_same_elements(self.plan.units.elements, self.expected.units.elements, own, other)
        named = (37 if batch.shape == 2 else 35) if batch.grouped else 10
        self.assert_sinks(nodes[rows:, :named])
        assert (nodes[rows:, named:] == -1).all()
        self.assert_exact(batch.subtrees, count)
        assert not batch.subtrees.first.numpy()[count:].any()
        if batch.sharing is Sharing.ABOVE:
            assert not batch.unit.numpy()[count:].any()

    def check_flat(self):
        flat, expected = self.plan.flat, self.expected.flat
        count, here = len(expected), slice(len(expected))
        assert np.array_equal(flat.leaves.numpy()[here], expected.leaves.numpy())
        padding = flat.leaves.numpy()[count:]
        assert (padding >= self.leaves).all()
        self.assert_sinks(self.plan.elements.nodes.numpy()[padding])
        if flat.general is not None and count:
            for name in ("nodes", "rest_inverse", "volume"):
                own, other = (getattr(each.general, name).numpy()[here] for each in (flat, expected))
                assert np.array_equal(own, other)
            assert np.array_equal(flat.general.numbers.numpy(), flat.leaves.numpy())
            self.assert_sinks(flat.general.nodes.numpy()[count:])
        for name, own in self.plan.values.items():
            carried = self.forest.carriage.values(name)[self.forest.leaf_elements]
            assert np.array_equal(own.numpy()[: self.leaves], carried)
            assert not own.numpy()[self.leaves :].any()

    def check_units(self):
        if self.mesh_units is None:
            assert self.plan.units is None
            return
        units, expected = self.plan.all_units, self.mesh_units
        unit = units.unit.numpy()
        assert_same_elements(units.elements, expected.elements, unit[: self.leaves], expected.unit.numpy())
        assert (np.diff(unit[: self.leaves]) >= 0).all()
        # The first one is padding, for leaves that are padding.
        assert np.array_equal(np.unique(unit[: self.leaves]), np.arange(1, expected.count + 1))
        assert units.count > expected.count
        assert not unit[self.leaves :].any()
        self.assert_padding(units.elements, expected.count + 1)
        self.assert_sinks(units.elements.nodes.numpy()[:1])

    def assert_sinks(self, nodes):
        assert (nodes >= self.forest.node_capacity).all()
        assert (nodes < self.forest.node_capacity + int(SINKS)).all()

    def assert_exact(self, elements, count):
        """Frames are axis-aligned, so that elements at rest have F = I to the last digit."""
        code = elements.code.numpy()[count:]
        assert np.isin(elements.frames.numpy()[code >> FRAME_SHIFT], (-1.0, 0.0, 1.0)).all()

    def assert_padding(self, elements, count):
        nodes = elements.nodes.numpy()[count:]
        self.assert_sinks(nodes)
        assert (nodes == nodes[:, :1]).all()
        self.assert_exact(elements, count)


def check(plan, forest, rotation_level, grouped=None):
    """With the current launches, and then with the full capacity: nothing is left over from before."""
    Comparison(plan, forest, rotation_level, grouped).check()
    counts = plan.class_counts.numpy()
    plan.refresh(np.full_like(counts, plan.counts.most - 1))
    Comparison(plan, forest, rotation_level, grouped).check()
    plan.refresh(counts)


def is_short(mesh, rotation_level):
    """A uniform mesh has all levels; the others have three."""
    return mesh == "uniform" or rotation_level in (None, 1, 4)


@pytest.mark.parametrize("grouped", [True, False])
@pytest.mark.parametrize(("mesh", "rotation_level"), crossed(MESHES, [None, 0, 1, 2, 3, 4, 5, 6, 7, 9], is_short))
def test_the_plan_is_that_of_the_present_mesh(mesh, grouped, rotation_level, device, rng):
    values = {name: rng.random(len(MESHES[mesh]().tets)) for name in ("mu", "lam")}
    forest = made(mesh, device, values=values)
    plan = DevicePlan(forest, rotation_level, grouped=grouped)
    remesh = RemeshPass(forest)
    check(plan, forest, rotation_level, grouped)
    counts = []
    for refine, simplify in ((0.1, 0.1), (0.2, 0.2), (0.0, 0.9), (0.0, 1.0)):
        remesh.apply(random_marks(forest, rng, refine, simplify))
        plan.launch()
        plan.refresh(plan.class_counts.numpy())
        check(plan, forest, rotation_level, grouped)
        counts.append(forest.leaf_count)
    assert counts[0] < counts[1] > counts[3]


def test_a_pass_that_changes_nothing_leaves_the_plan_alone(device):
    forest = made("uniform", device)
    plan = DevicePlan(forest, 3)
    RemeshPass(forest).apply(np.zeros(forest.leaf_count, int))
    plan.launch()
    assert not plan.counts.goes.numpy()[0]
    assert not plan.refresh(plan.class_counts.numpy())
    check(plan, forest, 3)


@pytest.mark.parametrize("threads", [2, 7, 5000])
def test_any_number_of_threads_makes_the_same_plan(threads, device, rng):
    forest = made("uniform", device)
    forest.threads = threads
    remesh, plan = RemeshPass(forest), DevicePlan(forest, 4)
    for _ in range(3):
        remesh.apply(random_marks(forest, rng, 0.05, 0.2))
        plan.derive()
        check(plan, forest, 4)


def test_the_plan_can_be_recorded_with_the_pass(device, rng):
    forest = made("uniform", device)
    remesh, plan = RemeshPass(forest), DevicePlan(forest, None)
    with wp.ScopedCapture(device=device) as capture:
        remesh.launch(marked=True)
        plan.launch()
    for _ in range(3):
        marks = random_marks(forest, rng, 0.05, 0.2)
        forest.pools.marks[: len(marks)].assign(marks.astype(np.int8))
        wp.capture_launch(capture.graph)
        plan.refresh(plan.class_counts.numpy())
        check(plan, forest, None)


# --- forces ---------------------------------------------------------------------------------------------------------


def remeshed(mesh, material, model, device, rng):
    """The force field of a simulation whose mesh has changed three times, and the forest on the device."""
    body = wc.SoftBody(mesh, material, device=device)
    options = wc.OnlineRemesh(capacity=4 * len(mesh.tets), min_level=0, max_level=48)
    sim = wc.Simulation(body, model=model, remesh=options)
    changing = sim.remeshing.changing[0]
    for _ in range(3):
        apply_marks(changing.passes, random_marks(changing.forest, rng, 0.02, 0.2))
    changing.renew()
    assert sim.fields[0].plan is body.discretization.kept
    return sim.fields[0], changing.forest


def forces_and_energy(field, u):
    device_u = wp.array(u.astype(np.float32), dtype=wp.vec4, device=field.device)
    f = wp.zeros_like(device_u)
    field.add_forces(device_u, f)
    return f.numpy()[:, :3], field.elastic_energy(device_u)


@pytest.mark.parametrize("model", [wc.Corotated(), wc.Corotated(rotation_level=5), wc.NeoHookean()], ids=repr)
def test_forces_are_those_of_a_body_on_the_present_mesh(model, device, rng):
    """Including inverted elements; nodes of padding have no force."""
    source = MESHES["uniform"]()
    young = 1e4 * (1 + rng.random(len(source.tets)))
    material = wc.Isotropic(young, 0.4, 1000.0)
    field, forest = remeshed(source, material, model, device, rng)
    mesh = forest.to_forest()
    assert len(mesh.tets) != len(source.tets)
    mu, lam = (forest.carriage.values(name)[forest.leaf_elements].astype(float) for name in ("mu", "lam"))
    material = wc.Isotropic(mu * (3 * lam + 2 * mu) / (lam + mu), 0.5 * lam / (lam + mu), 1000.0)
    body = wc.SoftBody(mesh, material, device=device)
    edge = CUBE * 0.5 ** (mesh.levels.max() / 3)
    u = np.zeros((forest.node_capacity + int(SINKS), 4))
    u[: body.node_count, :3] = 0.05 * edge * rng.standard_normal(mesh.points.shape)
    if isinstance(model, wc.Corotated):
        u[rng.choice(body.node_count, 5), :3] += 0.5 * edge
    found, energy = forces_and_energy(field, u)
    expected, expected_energy = forces_and_energy(model.bind(body), u[: body.node_count])
    np.testing.assert_allclose(found[: body.node_count], expected, atol=2e-6 * np.abs(expected).max())
    assert energy == pytest.approx(expected_energy, rel=1e-6)
    # Subtrees of type 2 have roots of a half for columns.
    assert np.abs(found[body.node_count :]).max() <= 1e-6 * np.abs(expected).max()
    stress = field.von_mises(wp.array(u.astype(np.float32), dtype=wp.vec4, device=device))
    assert np.isfinite(stress).all()


# --- sizes of launches ------------------------------------------------------------------------------------------------


def test_launch_sizes_are_close_and_seldom_others(rng):
    size = changes = 0
    for count in np.abs(np.cumsum(rng.integers(-300, 310, 3000))):
        found = launch_size(int(count), size, 64)
        changes += found != size
        size = found
        assert size >= count
        assert size % 64 == 0
        assert size <= max(1.25 * count, count + 64)
    assert changes < 600
    assert launch_size(0, 640) == 0
    for count in (1, 63, 64, 1000, 10**6 + 1):
        fresh = launch_size(count, 0)
        assert count <= fresh <= max(1.0625 * count, count)
    assert launch_size(10**6, 0, 1, 10**6 + 5) <= 10**6 + 5
