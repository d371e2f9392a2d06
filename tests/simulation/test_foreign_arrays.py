"""Another program's arrays as loads and positions: used in place, in every form, and invalid ones."""

import numpy as np
import pytest
import warp as wp
from foreign import DT, FORMS, SIDE, bar, read, vec3, vec3_among_others, vec4, write

import warp_corot as wc


@pytest.fixture(params=FORMS, ids=lambda form: form.__name__)
def form(request):
    return request.param


def some_forces(sim, rng):
    return rng.uniform(-0.05, 0.05, (sim.body.node_count, 3)).astype(np.float32)


@pytest.mark.parametrize("steps", [1, 70], ids=["a step", "runs of steps"])
def test_every_form_of_array_gives_the_same_bits(form, steps, device, rng):
    """Compared with loads and positions of the body itself."""
    ordinary, sim = bar(device, gravity=(0.0, -9.81, 0.0)), bar(device, gravity=(0.0, -9.81, 0.0))
    n = sim.body.node_count
    loads, positions = form(n, device), form(n, device)
    before = loads.numpy().copy()
    sim.body.use_loads(loads)
    sim.body.use_positions(positions)
    np.testing.assert_array_equal(read(positions), ordinary.body.positions.numpy())
    for _ in range(3):
        forces = some_forces(sim, rng)
        write(loads, forces)
        ordinary.body.loads.assign(forces)
        for each in (sim, ordinary):
            each.step() if steps == 1 else each.advance_steps(steps)
        np.testing.assert_array_equal(read(positions), ordinary.body.positions.numpy())
        np.testing.assert_array_equal(read(loads), forces)
    assert np.abs(read(positions) - sim.body.mesh.points).max() > 1e-8
    # A fourth number is ignored.
    np.testing.assert_array_equal(loads.numpy()[..., 3:], before[..., 3:])
    np.testing.assert_array_equal(positions.numpy()[..., 3:], before[..., 3:])


def test_forces_become_momentum(form, device, rng):
    sim = bar(device, fixed=False, damping=0.0)
    loads = form(sim.body.node_count, device)
    sim.body.use_loads(loads)
    expected = np.zeros(3)
    for steps in (1, 20, 50):
        forces = some_forces(sim, rng)
        write(loads, forces)
        sim.advance_steps(steps)
        expected += steps * DT * forces.astype(float).sum(axis=0)
    momentum = sim.body.masses @ sim.body.velocities.numpy()
    np.testing.assert_allclose(momentum, expected, atol=2e-5 * DT * 70)


def test_steps_continue_from_written_positions(form, device):
    """A free body placed elsewhere without strain stays there; a stretched one contracts."""
    sim = bar(device, fixed=False)
    x = sim.body.mesh.points
    positions = form(sim.body.node_count, device)
    sim.body.use_positions(positions)
    write(positions, x + SIDE)
    sim.step()
    np.testing.assert_allclose(read(positions), x + SIDE, atol=1e-6)
    write(positions, 1.1 * x)
    sim.step()
    np.testing.assert_allclose(read(positions), 1.1 * x, atol=1e-4)
    assert sim.energy().elastic > 0
    sim.advance_steps(20)
    assert np.ptp(read(positions), axis=0).max() < 1.099 * np.ptp(x, axis=0).max()


def test_worlds_have_their_own_part(device, rng):
    """[worlds, N] is [worlds * N]; and each world behaves as it does alone."""
    shape = (3, len(bar("cpu").body.mesh.points))
    sim = bar(device, worlds=3)
    loads, positions = (wp.zeros(shape, dtype=wp.vec3, device=device) for _ in range(2))
    sim.body.use_loads(loads)
    sim.body.use_positions(positions)
    forces = some_forces(sim, rng)
    write(loads, forces)
    sim.advance_steps(40)
    for world, own in enumerate(forces.reshape(*shape, 3)):
        alone = bar(device)
        alone.body.loads.assign(own)
        alone.advance_steps(40)
        np.testing.assert_array_equal(positions.numpy()[world], alone.body.positions.numpy())
    sim.reset([1])
    np.testing.assert_array_equal(positions.numpy()[1], sim.body.mesh.points.astype(np.float32))
    assert np.abs(positions.numpy()[2] - sim.body.mesh.points).max() > 1e-6
    four_numbers = wp.zeros((*shape, 4), dtype=wp.float32, device=device)
    sim.body.use_positions(four_numbers)
    np.testing.assert_array_equal(read(four_numbers), sim.body.positions.numpy())


def test_properties_mean_the_array(form, device):
    """``loads``, ``load`` and ``positions`` of the body, and the stored data."""
    sim = bar(device)
    body, n = sim.body, sim.body.node_count
    loads, positions = form(n, device), form(n, device)
    write(loads, np.ones((n, 3)))
    body.use_loads(loads)
    body.use_positions(positions)
    assert body.loads.ptr == loads.ptr
    assert body.positions.ptr == positions.ptr
    body.load([2], [0.0, 7.0, 0.0])
    np.testing.assert_array_equal(read(loads)[[1, 2]], [[1, 1, 1], [0, 7, 0]])
    body.positions = 1.5 * body.mesh.points
    np.testing.assert_allclose(read(positions), 1.5 * body.mesh.points, atol=3e-8)


def test_a_file_keeps_the_values(device, folder):
    sim = bar(device)
    loads = vec3(sim.body.node_count, device)
    write(loads, np.full((sim.body.node_count, 3), 0.01))
    sim.body.use_loads(loads)
    sim.step()
    sim.save("state.npz")
    again = wc.Simulation.load("state.npz")
    np.testing.assert_array_equal(again.body.loads.numpy(), read(loads))
    for each in (sim, again):
        each.step()
    np.testing.assert_array_equal(again.body.positions.numpy(), sim.body.positions.numpy())


def test_the_bodys_own_again(device):
    """They are restored: loads with their former values, positions with the current ones."""
    ordinary, sim = bar(device), bar(device)
    n = sim.body.node_count
    for each in (ordinary, sim):
        each.body.load([n - 1], [0.0, 0.5, 0.0])
    theirs, positions = vec3(n, device), vec3_among_others(n, device)
    sim.body.use_loads(theirs)
    sim.body.use_positions(positions)
    sim.advance_steps(5)
    np.testing.assert_array_equal(read(positions), sim.body.mesh.points.astype(np.float32))
    sim.body.use_loads(None)
    sim.body.use_positions(None)
    for each in (ordinary, sim):
        each.advance_steps(5)
    np.testing.assert_array_equal(sim.body.positions.numpy(), ordinary.body.positions.numpy())
    assert np.abs(sim.body.displacements.numpy()).max() > 0
    np.testing.assert_array_equal(read(positions), sim.body.mesh.points.astype(np.float32))
    unloaded = bar(device)
    unloaded.body.use_loads(theirs)
    theirs.fill_(wp.vec3(1.0, 0.0, 0.0))
    unloaded.body.use_loads(None)
    unloaded.step()
    assert np.abs(unloaded.body.velocities.numpy()).max() == 0


def test_what_was_written_before_is_not_lost(device):
    """Positions written to the body's own array before it is replaced, and another array after one."""
    sim = bar(device, fixed=False)
    n, x = sim.body.node_count, sim.body.mesh.points
    sim.body.positions.assign((x + SIDE).astype(np.float32))
    first, second = vec3(n, device), vec4(n, device)
    sim.body.use_positions(first)
    np.testing.assert_allclose(read(first), x + SIDE, atol=1e-7)
    sim.step()
    sim.body.use_positions(second)
    sim.body.velocities = np.tile([100.0, 0.0, 0.0], (n, 1))
    sim.step()
    moved = x + SIDE + [100.0 * DT / (1.0 + 5.0 * DT), 0.0, 0.0]
    np.testing.assert_allclose(read(second), moved, atol=1e-6)
    sim.body.use_positions(None)
    sim.body.positions.assign((x - SIDE).astype(np.float32))
    sim.body.use_positions(first)
    np.testing.assert_allclose(read(first), x - SIDE, atol=1e-7)


def test_another_array_takes_effect_in_recorded_steps(device):
    sim = bar(device, fixed=False, damping=0.0)
    n = sim.body.node_count
    push, pull = vec3(n, device), vec3(n, device)
    push.fill_(wp.vec3(0.01, 0.0, 0.0))
    pull.fill_(wp.vec3(-0.01, 0.0, 0.0))
    for loads in (push, pull, push, pull):
        sim.body.use_loads(loads)
        sim.step()
    momentum = sim.body.masses @ sim.body.velocities.numpy()
    np.testing.assert_allclose(momentum, 0, atol=1e-5 * n * 0.01 * DT)
    sim.body.use_loads(push)
    sim.advance_steps(4)
    momentum = sim.body.masses @ sim.body.velocities.numpy()
    np.testing.assert_allclose(momentum, [4 * DT * n * 0.01, 0, 0], atol=1e-4 * n * 0.01 * DT)


def test_one_force_for_all_nodes_may_be_one_vector(device):
    """Zero strides, like a broadcast array of another framework. Not for positions, which are written."""
    sim = bar(device, fixed=False, damping=0.0)
    n = sim.body.node_count
    one = wp.array([[0.0, 0.02, 0.0]], dtype=wp.vec3, device=device)
    for_all = wp.array(ptr=one.ptr, dtype=wp.vec3, shape=(n,), strides=(0,), device=device)
    sim.body.use_loads(for_all)
    sim.step()
    momentum = sim.body.masses @ sim.body.velocities.numpy()
    np.testing.assert_allclose(momentum, [0, n * 0.02 * DT, 0], atol=1e-5 * n * 0.02 * DT)
    with pytest.raises(wc.InputError, match="0 bytes from node to node"):
        sim.body.use_positions(for_all)


def test_arrays_that_do_not_fit_are_refused_in_one_line(device):
    sim = bar(device, worlds=2)
    n = sim.body.node_count
    strided = wp.zeros((2, n // 2, 6), dtype=wp.float32, device=device)[:, :, :3]
    wrong = [
        (np.zeros((n, 3), np.float32), "ndarray"),
        ([[0.0, 0.0, 0.0]] * n, "list"),
        (vec3(n + 1, device), rf"vec3f? \[{n + 1}\]"),
        (vec3(n // 2, device), rf"\[{n // 2}\]"),
        (wp.zeros(n, dtype=wp.vec3d, device=device), "vec3d"),
        (wp.zeros(n, dtype=wp.vec2, device=device), "vec2"),
        (wp.zeros((n, 3), dtype=wp.float64, device=device), "float64"),
        (wp.zeros((n, 2), dtype=wp.float32, device=device), rf"\[{n}, 2\]"),
        (wp.zeros((3, n), dtype=wp.float32, device=device).transpose(), "strides"),
        (wp.zeros(3 * n, dtype=wp.float32, device=device), rf"\[{3 * n}\]"),
        (wp.zeros((n // 2, 2), dtype=wp.vec3, device=device), rf"\[{n // 2}, 2\]"),
        (strided, "strides"),
    ]
    if wp.get_device(device).is_cuda:
        wrong.append((vec3(n, "cpu"), "on cpu"))
    own = sim.body.conditions.loads, sim.body.state.positions
    for use, name in ((sim.body.use_loads, "loads"), (sim.body.use_positions, "positions")):
        for array, said in wrong:
            with pytest.raises(wc.InputError, match=f"^{name} .*{said}") as refusal:
                use(array)
            assert "\n" not in str(refusal.value)
            if isinstance(array, wp.array):
                assert f"[{n}] on {device}" in str(refusal.value)
    assert own == (sim.body.conditions.loads, sim.body.state.positions)


def test_one_array_cannot_be_both(form, device):
    body = bar(device).body
    array = form(body.node_count, device)
    body.use_loads(array)
    with pytest.raises(wc.InputError, match="positions is the array that loads are read from"):
        body.use_positions(array)
    body.use_loads(None)
    body.use_positions(array)
    with pytest.raises(wc.InputError, match="loads is the array that positions are written to"):
        body.use_loads(array)


def test_a_body_with_another_programs_array_is_not_remeshed(form, device):
    for name in ("loads", "positions"):
        body = bar(device).body
        getattr(body, f"use_{name}")(form(body.node_count, device))
        with pytest.raises(wc.InputError, match=rf"^{name} is another program's.*use_{name}\(None\)"):
            wc.Simulation(body, remesh=wc.OnlineRemesh())
        getattr(body, f"use_{name}")(None)
        wc.Simulation(body, remesh=wc.OnlineRemesh()).step()


def test_a_body_that_is_remeshed_takes_none(device):
    mesh = wc.TetForest.box(cells=(1, 1, 2), cell_size=0.1, level=3)
    body = wc.SoftBody(mesh, wc.Isotropic(2e4, 0.4, 1000.0), device=device)
    body.fix(mesh.points[:, 2] < 1e-9)
    wc.Simulation(body, remesh=wc.OnlineRemesh())
    for use in (body.use_loads, body.use_positions):
        with pytest.raises(wc.InputError, match="the body is remeshed"):
            use(vec3(body.node_count, device))
