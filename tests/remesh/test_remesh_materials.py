"""Materials with directions and active fibres on meshes that follow the motion."""

import numpy as np
import pytest
import warp as wp
from fibres import muscle, random_axes, wood
from remeshed import near, twin

import warp_corot as wc

MODELS = [wc.Corotated(), wc.Corotated(rotation="svd")]
#: Pascals at times: what the fibres of half of a bar follow.
TIMES, STRESS = np.array([0.0, 0.01, 0.05]), np.array([0.0, 2e3, -1e3])


def turning(points):
    """Fibres that rotate with the depth."""
    angle = 12.0 * points[:, 0]
    return np.stack([np.cos(angle), np.sin(angle), np.full(len(points), 0.3)], axis=1)


def turning_axes(points):
    first = turning(points)
    second = np.cross(first, [0.0, 0.0, 1.0])
    return np.stack([first, second, np.cross(first, second)], axis=1)


MATERIALS = {
    "uniform": lambda: muscle([1.0, 0.5, 0.2]),
    "directions": lambda: muscle(turning),
    "stiffness": lambda: muscle([0, 1, 1], young_along=lambda x: 3e4 + 4e5 * x[:, 0]),
    "all": lambda: wood(
        turning_axes,
        young=lambda x: [3e4, 8e3, 4e3] * (1.0 + 10.0 * x[:, :1]),
        density=lambda x: 900.0 + 2e3 * x[:, 1],
    ),
}


def bar(material, device, level=6):
    body = wc.SoftBody(wc.TetForest.box((4, 1, 1), 0.05, level), material, device=device)
    body.fix(body.mesh.points[:, 0] < 1e-9)
    return body


def ball(device):
    """A ball cut out of a domain: elements on its border are partly filled."""
    domain = wc.Domain.sphere(0.04, device=device)
    return wc.TetForest.from_domain(domain, 0.03, max_level=6)


def depth(body):
    return body.mesh.points[body.mesh.tets].mean(axis=1)[:, 0]


def active_twin(body, model, sim):
    """A body of fixed topology in the same state, with the same active stress."""
    fixed = twin(body, model, sim)
    if body.discretization.has_activation:
        fixed.body.activate(body.activation.numpy())
    for each in body.conditions.activations:
        keys = wc.Activation(each.times.numpy() - sim.time, each.values.numpy())
        fixed.body.activate(keys, each.host_numbers)
    return fixed


def assert_goes_on(sim, model):
    """A few steps give the same as on a mesh that was made that way."""
    body, fixed = sim.body, active_twin(sim.body, model, sim)
    for each in (sim, fixed):
        each.advance_steps(3)
    moved = np.abs(fixed.body.displacements.numpy()).max()
    assert np.abs(body.displacements.numpy() - fixed.body.displacements.numpy()).max() < 2e-5 * moved
    assert sim.energy().elastic == pytest.approx(fixed.energy().elastic, rel=1e-3)
    stress = fixed.von_mises()
    np.testing.assert_allclose(sim.von_mises(), stress, rtol=1e-2, atol=2e-3 * stress.max())


@pytest.mark.parametrize(
    ("kind", "model"),
    [
        *((kind, MODELS[0]) for kind in MATERIALS),
        *(pytest.param(kind, MODELS[1], marks=() if kind == "all" else pytest.mark.slow) for kind in MATERIALS),
    ],
    ids=repr,
)
def test_steps_go_on_as_on_a_mesh_made_that_way(kind, model, device):
    body = bar(MATERIALS[kind](), device)
    body.load(body.mesh.points[:, 0] > 0.2 - 1e-9, [0.0, 0.0, 0.1])
    mass = body.masses.sum()
    remesh = near(0.1, device)
    sim = wc.Simulation(body, model=model, integrator=wc.SymplecticEuler(damping=1.0), remesh=remesh)
    counts = set()
    for n, x in enumerate((0.05, 0.15, 0.0)):
        if n == 1:
            body.activate(500.0, depth(body) < 0.05)
            body.activate(wc.Activation(TIMES + sim.time, STRESS), depth(body) > 0.1)
        remesh.parameters.assign([x, 0.02])
        sim.advance_steps(20)
        counts.add(body.element_count)
        assert type(body.material) is type(MATERIALS[kind]())
        assert body.masses.sum() == pytest.approx(mass, rel=1e-12)
        assert_goes_on(sim, model)
        sim.advance_steps(2)
    assert len(counts) == 3


@pytest.mark.parametrize("model", [MODELS[0], pytest.param(MODELS[1], marks=pytest.mark.slow)], ids=repr)
@pytest.mark.parametrize("has_fibres", [False, True], ids=["isotropic", "fibres"])
def test_partly_filled_elements(has_fibres, model, device, rng):
    mesh = ball(device)
    count = len(mesh.tets)
    stiffer = rng.uniform(0.5, 2.0, count)
    if has_fibres:
        material = wood(random_axes(rng, count), young=stiffer[:, None] * [3e4, 8e3, 4e3])
    else:
        material = wc.Isotropic(young=2e4 * stiffer, poisson=0.4, density=1000.0)
    body = wc.SoftBody(mesh, material, device=device)
    body.fix(mesh.points[:, 2] < -0.03)
    if has_fibres:
        body.activate(rng.uniform(-500.0, 500.0, count))
    remesh = near(0.0, device, min_level=1, max_level=8)
    sim = wc.Simulation(body, model=model, integrator=wc.SymplecticEuler(damping=1.0), remesh=remesh)
    counts = {count}
    for x in (-0.02, 0.02):
        remesh.parameters.assign([x, 0.01])
        sim.advance_steps(25)
        counts.add(body.element_count)
        assert_goes_on(sim, model)
        sim.advance_steps(2)
    assert len(counts) == 3


@pytest.mark.parametrize("model", [MODELS[0], pytest.param(MODELS[1], marks=pytest.mark.slow)], ids=repr)
def test_elements_that_are_crushed(model, device, rng):
    """Their material blends into the nearest isotropic one, that of the current elements."""
    body = bar(MATERIALS["all"](), device, level=4)
    sim = wc.Simulation(body, model=model, remesh=near(0.1, device, max_level=6))
    sim.advance_steps(5)
    edge = np.cbrt(body.mesh.volumes.min())
    body.displacements = edge * rng.uniform(-1.5, 1.5, (body.node_count, 3))
    forces = [each.forces().numpy() for each in (sim, active_twin(body, model, sim))]
    np.testing.assert_allclose(forces[0], forces[1], atol=1e-5 * np.abs(forces[1]).max())


def test_keyframes_of_single_elements_go_to_their_children(device, rng):
    mesh = wc.TetForest.box((2, 1, 1), 0.05, 3)
    body = wc.SoftBody(mesh, muscle([1, 1, 0]), device=device)
    body.fix([0])
    keys = rng.uniform(-100.0, 100.0, (3, len(mesh.tets)))
    body.activate(wc.Activation(TIMES, keys))
    remesh = near(0.05, device, max_level=8, simplify_below=0.0)
    sim = wc.Simulation(body, gravity=(0, 0, 0), remesh=remesh)
    sim.advance_steps(33)
    assert body.element_count > 5 * len(mesh.tets)
    came_from, _ = mesh.embed(body.mesh.points[body.mesh.tets].mean(axis=1))
    time = sim.time - sim.dt
    expected = np.array([np.interp(time, TIMES, column) for column in keys.T])[came_from]
    np.testing.assert_allclose(body.activation.numpy(), expected, atol=1e-3)


def halves(mesh):
    """Corners of both possible children of each leaf, on the lattice [T, 4, 3] each."""
    x, rows = mesh.lattice[mesh.tets].astype(int), np.arange(len(mesh.tets))
    end = 3 - mesh.levels % 3
    middle = (x[:, 0] + x[rows, end]) // 2
    first, second = x.copy(), x.copy()
    first[rows, end] = middle
    for k in (1, 2, 3):
        own = end == k
        second[own, :k] = x[own, 1 : k + 1]
        second[own, k] = middle[own]
    return first, second


def by_corners(corners):
    return {frozenset(map(tuple, each)): n for n, each in enumerate(corners.tolist())}


def test_what_a_parent_takes_from_its_children(device, rng):
    mesh = ball(device)
    count = len(mesh.tets)
    material = wood(random_axes(rng, count), young=rng.uniform(0.5, 2.0, (count, 1)) * [3e4, 8e3, 4e3])
    body = wc.SoftBody(mesh, material, device=device)
    body.fix([0])
    body.activate(rng.uniform(-100.0, 100.0, count))
    follows = rng.random(count) < 0.5
    body.activate(wc.Activation([0.0, 1.0], np.tile(rng.uniform(-100.0, 100.0), (2, 1))), follows)
    sim = wc.Simulation(body, gravity=(0, 0, 0), remesh=near(9.0, device, every=1, min_level=1))
    before = np.where(follows, np.nan, body.activation.numpy())
    before[follows] = body.conditions.activations[0].values.numpy()[0, 0]
    sim.step()
    present = body.mesh
    leaves = by_corners(mesh.lattice[mesh.tets])
    pairs = [[leaves.get(frozenset(map(tuple, each)), -1) for each in half.tolist()] for half in halves(present)]
    merged = np.flatnonzero(np.min(pairs, axis=0) >= 0)
    first, second = (np.array(half)[merged] for half in pairs)
    assert len(merged) > 30
    share = (mesh.fill[first] / (mesh.fill[first] + mesh.fill[second]))[:, None]
    assert np.ptp(share) > 0.1

    def mean(values):
        return share[:, 0] * values[first] + (1.0 - share[:, 0]) * values[second]

    found = body.material
    stiffness = material.stiffness()
    expected = share * stiffness[first] + (1.0 - share) * stiffness[second]
    np.testing.assert_allclose(found.stiffness()[merged], expected, rtol=2e-6)
    np.testing.assert_allclose(found.frames()[merged], material.frames()[first], atol=1e-6)
    alike = follows[first] == follows[second]
    assert 0.2 < alike.mean() < 0.8
    np.testing.assert_allclose(body.activation.numpy()[merged], np.where(alike, mean(before), before[first]), atol=1e-4)
    still_follows = np.isin(merged, body.conditions.activations[0].numbers.numpy())
    np.testing.assert_array_equal(still_follows, follows[first])


def test_a_pass_keeps_what_is_written_to_activation(device):
    body = bar(muscle([1, 0, 0]), device)
    before = body.activation
    remesh = near(0.1, device)
    sim = wc.Simulation(body, remesh=remesh)
    with pytest.raises(wc.StaleViewError):
        before.numpy()
    count = body.element_count
    for x, stress in ((0.1, 70.0), (0.02, -30.0)):
        remesh.parameters.assign([x, 0.02])
        view = body.activation
        wp.copy(view, wp.array(np.where(depth(body) > 0.05, stress, 0.0), dtype=wp.float32, device=device))
        sim.advance_steps(10)
        assert body.element_count != count
        with pytest.raises(wc.StaleViewError):
            view.numpy()
        assert body.activation.shape == (body.element_count,)
        np.testing.assert_array_equal(body.activation.numpy(), np.where(depth(body) > 0.05, np.float32(stress), 0.0))
        count = body.element_count


def test_reset_goes_back_to_what_the_first_mesh_did_last(device):
    body = bar(muscle([1, 0, 0]), device)
    body.activate(wc.Activation(TIMES, STRESS), depth(body) > 0.1)
    sim = wc.Simulation(body, remesh=near(0.1, device))
    elements = body.conditions.activations[0].numbers.numpy()
    body.activate(40.0, [0, 1])
    sim.advance_steps(30)
    assert len(body.conditions.activations[0].numbers) != len(elements)
    body.activate(7.0)
    sim.advance_steps(10)
    assert not body.conditions.activations
    sim.reset()
    (activation,) = body.conditions.activations
    np.testing.assert_array_equal(activation.host_numbers, elements)
    np.testing.assert_array_equal(body.activation.numpy()[[0, 1]], 40.0)
    sim.advance_steps(3)
    now = np.interp(2 * sim.dt, TIMES, STRESS)
    np.testing.assert_allclose(body.activation.numpy()[elements], now, rtol=1e-5)


def test_keyframes_that_nobody_follows_are_forgotten(device):
    """However often new ones are set."""
    body = bar(muscle([1, 0, 0]), device, level=3)
    sim = wc.Simulation(body, remesh=near(0.1, device, every=2))
    for n in range(8):
        body.activate(wc.Activation(TIMES + sim.time, np.outer(STRESS, np.full(body.element_count, n))))
        sim.advance_steps(2)
    keys = sim.remeshing.changing[0].conditions.of_activation.keys
    assert len(keys) <= 2
    assert max(each.end for each in keys) <= 3 * body.element_count


def test_a_resumed_run_is_the_uninterrupted_one(device, tmp_path):
    if not wp.get_device(device).is_cpu:
        pytest.skip("forces are added up in any order")
    body = bar(wood(turning_axes), device)
    body.activate(100.0, depth(body) < 0.05)
    remesh = wc.OnlineRemesh(refine_above=1.02, simplify_below=1.005, max_level=8, every=5)
    sim = wc.Simulation(body, remesh=remesh)
    body.activate(wc.Activation(TIMES, 10.0 * STRESS), depth(body) > 0.1)
    sim.advance_steps(60)
    assert body.element_count != 1536
    body.activate(-50.0, [3])
    sim.save(tmp_path / "state.npz")
    resumed = wc.Simulation.load(tmp_path / "state.npz")
    for n in range(2):
        for each in (sim, resumed):
            each.advance_steps(30)
        assert body.element_count == resumed.body.element_count
        for name in ("displacements", "activation", "reactions"):
            np.testing.assert_array_equal(getattr(body, name).numpy(), getattr(resumed.body, name).numpy())
        np.testing.assert_array_equal(body.material.axes, resumed.body.material.axes)
        if n == 0:
            for each in (sim, resumed):
                each.reset()


@pytest.mark.parametrize("kind", ["muscle", "wood"])
def test_constants_of_a_stiffness(kind, rng):
    """They equal the constants from which it was made."""
    from warp_corot.materials.anisotropic import constants_of

    material = muscle([1, 0, 0], young_along=rng.uniform(2e4, 9e4, 20)) if kind == "muscle" else wood(np.eye(3))
    for found, given in zip(constants_of(material.stiffness()), material.constants(), strict=True):
        np.testing.assert_allclose(found, np.broadcast_to(given, found.shape), rtol=1e-12)
