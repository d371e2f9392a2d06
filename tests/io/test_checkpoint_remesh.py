"""A resumed run whose mesh changes equals the uninterrupted run."""

import numpy as np
import pytest
import warp as wp
from remesh_cases import assert_conforming, leaf_list

import warp_corot as wc
from warp_corot.io.checkpoint.archive import load_checkpoint
from warp_corot.kernels.remesh.criteria import ElementState

END = 0.2


@wp.func
def beside(element: ElementState, parameters: wp.array[wp.float32]):
    """Nearness of the first corner to a plane x = parameters[0]."""
    return 0.02 / (1.0e-6 + wp.abs(element.corner[0] - parameters[0]))


def nearness(x, device):
    values = {"refine_above": 1.0, "simplify_below": 0.5, "min_level": 3, "max_level": 8, "every": 5}
    return wc.OnlineRemesh(criterion=beside, parameters=wp.array([x], dtype=wp.float32, device=device), **values)


def box(device, **material):
    values = {"young": 3e4, "poisson": 0.4, "density": 1000.0} | material
    body = wc.SoftBody(wc.TetForest.box((4, 1, 1), 0.05, 5), wc.Isotropic(**values), device=device)
    body.fix(body.mesh.points[:, 0] < 1e-9)
    return body


def loaded_and_moved(device):
    """A body with varying material and loads, one end on keyframes that differ from node to node."""
    body = box(device, young=lambda x: 2e4 + 4e5 * x[:, 0], density=lambda x: 900.0 + 2e3 * x[:, 1])
    end = body.mesh.points[:, 0] > END - 1e-9
    keys = np.zeros((2, int(end.sum()), 3))
    keys[1, :, 0] = 0.02 * (1.0 + body.mesh.points[end, 1] / 0.05)
    body.prescribe(end, times=[0.0, 0.05], displacements=keys)
    body.load([7], [0.0, 0.01, 0.0])
    return body


def ball(device):
    """A ball cut out of a domain, with void beside it and labels within."""
    core, whole = (wc.Domain.sphere(radius, device=device) for radius in (0.03, 0.05))
    mesh = wc.TetForest.from_domain(core.named("core") | whole.named("shell"), 0.05, max_level=4)
    body = wc.SoftBody(mesh, wc.Isotropic(1e4, 0.4, 1000.0), device=device)
    body.fix(mesh.points[:, 1] < -0.03)
    body.velocities = 12.0 * (mesh.points[:, 1:2] + 0.03) * np.array([0.3, 1.0, 0.2]) * (mesh.points[:, 1:2] > -0.03)
    return body


CASES = [
    (box, wc.OnlineRemesh(refine_above=1.02, simplify_below=1.005, max_level=8), wc.SymplecticEuler(damping=2.0)),
    (loaded_and_moved, None, wc.SymplecticEuler(damping=2.0)),
    (ball, wc.OnlineRemesh(refine_above=1.02, simplify_below=1.01, max_level=6), wc.SymplecticEuler(dt=1e-4)),
]


def start(make, remesh, integrator, device):
    return wc.Simulation(make(device), integrator=integrator, remesh=remesh or nearness(0.1, device))


def move(sim, x):
    parameters = sim.remeshing.changing[0].options.parameters
    if parameters is not None:
        parameters.assign([x])


def values(array):
    return array.numpy() if isinstance(array, wp.array) else array


def assert_same(a, b):
    """The same leaves and the same nodal data bit for bit, with any numbers."""
    assert sorted(leaf_list(a.mesh)) == sorted(leaf_list(b.mesh))
    order = [np.lexsort(body.mesh.lattice[: body.node_count].T) for body in (a, b)]
    for name in ("positions", "displacements", "velocities", "reactions", "constrained", "masses"):
        one, other = (values(getattr(body, name))[rows] for body, rows in zip((a, b), order, strict=True))
        np.testing.assert_array_equal(one, other, err_msg=name)


def assert_alike(a, b):
    """The same on the CPU. On CUDA sums come in any order, so that now and then a leaf is bisected a little later."""
    if a.device.is_cpu:
        assert_same(a, b)
        return
    assert a.element_count == pytest.approx(b.element_count, rel=0.05)
    places = [{tuple(point): n for n, point in enumerate(body.mesh.lattice[: body.node_count])} for body in (a, b)]
    both = places[0].keys() & places[1].keys()
    assert len(both) > 0.9 * a.node_count
    one, other = (
        body.displacements.numpy()[[place[point] for point in both]] for body, place in zip((a, b), places, strict=True)
    )
    assert np.abs(one - other).max() < 2e-2 * np.abs(one).max() + 1e-12


@pytest.mark.filterwarnings("ignore::warp_corot.StabilityWarning")
@pytest.mark.parametrize("case", CASES, ids=lambda case: case[0].__name__)
def test_a_resumed_run_is_the_uninterrupted_one(device, tmp_path, case):
    whole, parted = start(*case, device), start(*case, device)
    for sim in (whole, parted):
        sim.advance_steps(43)
    parted.save(tmp_path / "state.npz")
    again = None if case[1] else nearness(0.1, device)
    resumed = load_checkpoint(tmp_path / "state.npz", remesh=again)
    assert (resumed.steps, resumed.dt, resumed.time) == (43, parted.dt, parted.time)
    assert_same(parted.body, resumed.body)
    counts = set()
    for x in (0.15, 0.02):
        for sim in (whole, parted, resumed):  # saving changes nothing either
            move(sim, x)
            sim.advance_steps(37)
        assert_conforming(resumed.body.mesh)
        assert_alike(whole.body, resumed.body)
        assert_alike(whole.body, parted.body)
        if whole.device.is_cpu:
            assert (resumed.dt, resumed.time) == (whole.dt, whole.time)
        counts.add(whole.body.element_count)
    assert len(counts) == 2
    for sim in (whole, resumed):
        sim.reset()
    assert_alike(whole.body, resumed.body)
    assert resumed.total_time == pytest.approx(whole.total_time, rel=1e-12 if whole.device.is_cpu else 1e-2)
    for sim in (whole, resumed):
        sim.advance_steps(17)
    assert_alike(whole.body, resumed.body)


def test_an_initial_state_on_another_mesh_is_kept(device, tmp_path):
    sim = wc.Simulation(box(device), remesh=nearness(0.1, device))
    sim.advance_steps(20)
    sim.body.set_initial_state()
    leaves, moved = leaf_list(sim.body.mesh), sim.body.displacements.numpy()
    move(sim, 0.0)
    sim.advance_steps(20)
    sim.save(tmp_path / "a.npz")
    resumed = load_checkpoint(tmp_path / "a.npz", remesh=nearness(0.0, device))
    assert leaf_list(resumed.body.mesh) != leaves
    resumed.reset()
    assert leaf_list(resumed.body.mesh) == leaves
    np.testing.assert_array_equal(resumed.body.displacements.numpy(), moved)


def test_a_body_beside_one_that_is_remeshed(tmp_path):
    sim = wc.Simulation([box("cpu"), box("cpu", young=2e4)], remesh=[None, CASES[0][1]])
    sim.advance_steps(40)
    sim.save(tmp_path / "a.npz")
    resumed = wc.Simulation.load(tmp_path / "a.npz")
    for each in (sim, resumed):
        each.advance_steps(25)
    np.testing.assert_array_equal(sim.body.positions.numpy(), resumed.body.positions.numpy())
    assert_same(sim.bodies[1], resumed.bodies[1])
    assert resumed.remeshing.changing[0] is None


def test_a_users_own_criterion_must_be_passed_again(tmp_path):
    sim = wc.Simulation(box("cpu"), remesh=nearness(0.1, "cpu"))
    sim.advance_steps(5)
    sim.save(tmp_path / "a.npz")
    with pytest.raises(wc.InputError, match="the criterion 'beside' is your own function"):
        wc.Simulation.load(tmp_path / "a.npz")
    given = nearness(0.15, "cpu")
    resumed = load_checkpoint(tmp_path / "a.npz", remesh=given)
    assert resumed.remeshing.changing[0].options.parameters is given.parameters
    for wrong in ([], [None], "all", 3):
        with pytest.raises(wc.InputError, match="remesh is"):
            load_checkpoint(tmp_path / "a.npz", remesh=wrong)


def test_another_device_goes_on_too(device, tmp_path):
    sim = wc.Simulation(box(device), remesh=CASES[0][1])
    sim.advance_steps(40)
    sim.save(tmp_path / "a.npz")
    resumed = wc.Simulation.load(tmp_path / "a.npz", device="cpu")
    assert sorted(leaf_list(sim.body.mesh)) == sorted(leaf_list(resumed.body.mesh))
    np.testing.assert_array_equal(sim.body.positions.numpy(), resumed.body.positions.numpy())
    resumed.advance_steps(25)
    assert_conforming(resumed.body.mesh)
    assert resumed.body.mesh.volumes.sum() == pytest.approx(sim.body.mesh.volumes.sum(), rel=1e-12)


def test_a_fixed_mesh_may_begin_to_change(tmp_path):
    sim = wc.Simulation(box("cpu"))
    sim.advance_steps(60)
    sim.save(tmp_path / "a.npz")
    resumed = load_checkpoint(tmp_path / "a.npz", remesh=CASES[0][1])
    np.testing.assert_array_equal(resumed.body.positions.numpy(), sim.body.positions.numpy())
    resumed.advance_steps(10)
    assert resumed.body.element_count != sim.body.element_count


def test_a_part_left_out_is_found(tmp_path, rng):
    sim = wc.Simulation(box("cpu"), remesh=CASES[0][1])
    sim.advance_steps(20)
    sim.save(tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as archive:
        parts = dict(archive)
    kept = [name for name in parts if name.startswith("bodies.0.remesh.")]
    for missing in rng.choice(kept, 8, replace=False):
        np.savez(tmp_path / "b.npz", **{name: part for name, part in parts.items() if name != missing})
        with pytest.raises(wc.InputError, match="not a complete checkpoint"):
            wc.Simulation.load(tmp_path / "b.npz")


def test_the_packages_own_criteria_are_found_by_their_names(tmp_path):
    from warp_corot.kernels.remesh.criteria import nearness as near_box

    parameters = wp.array([0.1, 0.025, 0.025, 0.01, 0.02, 0.02, 0.02, 0.002], dtype=wp.float32, device="cpu")
    remesh = wc.OnlineRemesh(
        criterion=near_box, parameters=parameters, refine_above=1.0, simplify_below=0.5, max_level=8
    )
    sim = wc.Simulation(box("cpu"), remesh=remesh)
    sim.advance_steps(25)
    sim.save(tmp_path / "a.npz")
    resumed = wc.Simulation.load(tmp_path / "a.npz")
    assert_same(sim.body, resumed.body)
    count = sim.body.element_count
    for each in (sim, resumed):
        each.remeshing.changing[0].options.parameters.assign([0.02, *parameters.numpy()[1:]])
        each.advance_steps(25)
    assert sim.body.element_count != count
    assert_same(sim.body, resumed.body)
