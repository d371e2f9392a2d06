"""Threads that step a body on the CPU: the same bits for the same number, and nothing that hangs."""

import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
import warp as wp
from scipy.sparse import identity
from scipy.spatial import cKDTree

import warp_corot as wc
from warp_corot.errors import InputError
from warp_corot.inputs import cpu_threads
from warp_corot.inputs.cpu_threads import LEAST_ELEMENTS, Region, core_count, launch, team_for, team_of
from warp_corot.solvers.implicit.assembled import dissected

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="bodies take one thread there")


@wp.kernel(enable_backward=False)
def shift(begin: int, x: wp.array(dtype=float), y: wp.array(dtype=float)):
    i = wp.tid()
    y[i] = x[(begin + i + 1) % x.shape[0]]


def rotations(team, x, y):
    """Two phases that each read what other parts wrote in the one before."""
    bounds = team.bounds(len(x))

    def phase(source, target):
        return lambda part: launch(
            shift,
            bounds[part][1] - bounds[part][0],
            [bounds[part][0], source],
            [target[slice(*bounds[part])]],
            device="cpu",
        )

    return Region(team, [phase(x, y), phase(y, x)])


def falling(threads, *, poisson=0.3, integrator=None, **options):
    """A beam of 9,216 elements, held at one end, after some steps."""
    mesh = wc.TetForest.box(cells=(2, 2, 6), cell_size=0.03, level=6)
    material = wc.Isotropic(young=5e3, poisson=poisson, density=1000.0)
    body = wc.SoftBody(mesh, material, device="cpu", threads=threads)
    body.fix("z == zmin")
    sim = wc.Simulation(body, integrator=integrator, gravity=(0.0, -9.8, 0.0), **options)
    sim.advance(0.02 if integrator is None else 3 * integrator.dt)
    return body, sim


# --- teams ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("parts", [1, 2, 5])
def test_no_part_begins_a_phase_before_all_have_ended_the_last(parts):
    x = wp.array(np.arange(1000), dtype=float, device="cpu")
    region = rotations(team_of(parts), x, wp.zeros_like(x))
    with wp.ScopedCapture(device="cpu") as capture:
        for _ in range(10):
            region.launch()
    for _ in range(5):
        wp.capture_launch(capture.graph)
    np.testing.assert_array_equal(x.numpy(), np.roll(np.arange(1000), -100))


def test_parts_begin_at_multiples_of_a_step_and_cover_everything():
    for count in (0, 5, 64, 1001):
        bounds = team_of(3).bounds(count, 8)
        assert [begin for begin, _ in bounds[1:]] == [end for _, end in bounds[:-1]]
        assert (bounds[0][0], bounds[-1][1]) == (0, count)
        assert all(begin % 8 == 0 or begin == count for begin, _ in bounds)


def test_idle_threads_take_no_time_and_wake_up():
    x = wp.array(np.arange(100), dtype=float, device="cpu")
    region = rotations(team_of(2), x, wp.zeros_like(x))
    region.launch()
    time.sleep(0.1)
    before = time.process_time()
    time.sleep(0.2)
    assert time.process_time() - before < 0.1
    region.launch()
    np.testing.assert_array_equal(x.numpy(), np.roll(np.arange(100), -4))


def test_launches_that_cannot_be_made_leave_the_team_as_it_was():
    x = wp.array(np.arange(100), dtype=float, device="cpu")
    with pytest.raises(Exception, match="shift"):
        Region(team_of(2), [lambda part: launch(shift, 10, [0], [x], device="cpu")])
    rotations(team_of(2), x, wp.zeros_like(x)).launch()
    np.testing.assert_array_equal(x.numpy(), np.roll(np.arange(100), -2))


def test_two_callers_at_once_do_not_wait_for_one_another():
    arrays = [wp.array(np.arange(n), dtype=float, device="cpu") for n in (1000, 77)]
    regions = [rotations(team_of(3), x, wp.zeros_like(x)) for x in arrays]

    def call(region):
        for _ in range(200):
            region.launch()

    callers = [threading.Thread(target=call, args=(region,)) for region in regions]
    for each in callers:
        each.start()
    for each in callers:
        each.join()
    for x in arrays:
        np.testing.assert_array_equal(x.numpy(), np.roll(np.arange(len(x)), -400))


def test_a_process_bound_to_one_core_takes_one_thread(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {3}, raising=False)
    assert team_for(None, 10**9).parts == 1


def test_processes_share_the_cores(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    for name in ("process_cpu_count", "cpu_count"):
        monkeypatch.setattr(os, name, lambda: 8, raising=False)
    monkeypatch.setattr(cpu_threads, "_processes", [1])
    whole = core_count()
    cpu_threads.share_cores(4)
    assert core_count() == max(whole // 4, 1)
    monkeypatch.setenv("PMI_SIZE", "8")
    assert core_count() == 1


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_process_has_threads_of_its_own():
    x = wp.array(np.arange(100), dtype=float, device="cpu")
    region = rotations(team_of(2), x, wp.zeros_like(x))
    region.launch()
    child = os.fork()
    if child == 0:
        region.launch()
        os._exit(0 if x.numpy()[0] == 4 else 1)
    deadline = time.monotonic() + 30.0
    while (ended := os.waitpid(child, os.WNOHANG))[0] == 0 and time.monotonic() < deadline:
        time.sleep(0.01)
    if ended[0] == 0:
        os.kill(child, signal.SIGKILL)
    assert ended == (child, 0)
    region.launch()
    assert x.numpy()[0] == 4


def test_ctrl_c_ends_a_run_on_two_threads():
    code = (
        "import warp_corot as wc\n"
        "body = wc.SoftBody(wc.TetForest.box(cells=(2, 2, 6), cell_size=0.03, level=6),"
        " wc.Isotropic(young=5e3, poisson=0.3, density=1000.0), device='cpu', threads=2)\n"
        "body.fix('z == zmin')\n"
        "sim = wc.Simulation(body)\n"
        "sim.advance(0.01)\n"
        "print('runs', flush=True)\n"
        "sim.advance(1e6)\n"
    )
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert any("runs" in line for line in process.stdout)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    finally:
        process.kill()
    assert "KeyboardInterrupt" in errors
    assert process.returncode != 0


# --- bodies ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("poisson", [0.3, 0.49])
def test_explicit_steps_do_not_depend_on_the_number_of_threads(poisson):
    (one, _), (three, _), (again, _) = (falling(threads, poisson=poisson) for threads in (1, 3, 3))
    assert (one.discretization.team.parts, three.discretization.team.parts) == (1, 3)
    x, y, z = (body.displacements.numpy() for body in (one, three, again))
    np.testing.assert_array_equal(y, z)
    # Sums in another order differ by the rounding of float32, which some hundred steps add up.
    np.testing.assert_allclose(y, x, rtol=0, atol=1e-4 * np.abs(x).max())


def test_the_work_of_moving_supports_is_the_same():
    work = []
    for threads in (1, 4):
        body, sim = falling(threads)
        body.prescribe("z == zmin", velocity=(0.1, 0.0, 0.0))
        sim.advance(0.02)
        work.append(sim.system.support_work.numpy()[0])
    assert work[0] == pytest.approx(work[1], rel=1e-4)
    assert work[0] != 0.0


def test_a_run_resumes_with_its_threads(tmp_path):
    _, sim = falling(3)
    sim.save(tmp_path / "run.npz")
    resumed = wc.Simulation.load(tmp_path / "run.npz")
    for each in (sim, resumed):
        each.advance(0.02)
    assert resumed.body.threads == 3
    np.testing.assert_array_equal(sim.body.displacements.numpy(), resumed.body.displacements.numpy())


def test_a_small_body_takes_one_thread():
    assert team_for(8, LEAST_ELEMENTS - 1).parts == 1
    assert team_for(8, 3 * LEAST_ELEMENTS).parts == 3
    assert team_for(None, 10**9).parts == core_count()


def test_more_than_two_threads_are_chosen_for_larger_bodies(monkeypatch):
    monkeypatch.setattr("warp_corot.inputs.cpu_threads.core_count", lambda: 16)
    assert [team_for(None, count * LEAST_ELEMENTS).parts for count in (1, 2, 5, 6, 32, 100)] == [1, 2, 2, 3, 16, 16]


def test_the_number_of_threads_is_checked():
    mesh = wc.TetForest.box(cells=(1, 1, 1), cell_size=0.1, level=0)
    with pytest.raises(InputError, match="threads is 0"):
        wc.SoftBody(mesh, wc.Isotropic(young=1e3, poisson=0.3, density=1e3), threads=0)


@pytest.mark.parametrize(("poisson", "lies", "tolerance"), [(0.49, False, 1e-4), (0.3, True, 0.01)])
def test_implicit_steps_do_not_depend_on_the_number_of_threads(poisson, lies, tolerance):
    """Rows are in another order, so that solves end elsewhere within their tolerance; and the first steps on a ground
    end before they are solved for, with other contacts at a few nodes."""
    options = {"obstacles": wc.Ground((0.0, 1.0, 0.0), -0.001)} if lies else {}
    integrator = wc.BackwardEuler(dt=0.003, linear_tolerance=1e-5)
    runs = [falling(n, poisson=poisson, integrator=integrator, **options) for n in (1, 4, 4)]
    x, y, z = (body.displacements.numpy() for body, _ in runs)
    np.testing.assert_array_equal(y, z)
    assert np.linalg.norm(y - x) < tolerance * np.linalg.norm(x)
    one, four, _ = (sim.stepper.totals.numpy()[2] for _, sim in runs)
    assert four < 1.2 * one


def pressed_together(threads):
    """A plate presses a block onto another one, whose rows are of other levels."""
    lower = wc.TetForest.box((2, 1, 2), 0.03, 8)
    upper = wc.TetForest.box((2, 1, 2), 0.028, 8, origin=(0.002, 0.0305, 0.002))
    material = wc.Isotropic(5e3, 0.44, 1000.0)
    bodies = [wc.SoftBody(mesh, material, device="cpu", threads=threads) for mesh in (lower, upper)]
    bodies[0].fix("y < ymin + 1e-6")
    plate = wc.Tool(wc.Box((0.1, 0.01, 0.1), position=(0.03, 0.0645, 0.03)))
    plate.follow([0.0, 0.1], [(0.03, 0.0645, 0.03), (0.03, 0.058, 0.03)])
    contact, steps = wc.Contact(friction=0.3), wc.BackwardEuler(dt=1 / 60)
    sim = wc.Simulation(bodies, integrator=steps, obstacles=[plate], contact=contact)
    sim.advance_steps(4)
    return sim, bodies[1].positions.numpy()


def test_bodies_that_touch_are_solved_for_by_several_threads():
    (one, alone), (two, shared) = pressed_together(1), pressed_together(2)
    assert one.solves.unfinished == two.solves.unfinished == 0
    assert two.solves.linear_iterations < 1.3 * one.solves.linear_iterations
    np.testing.assert_allclose(shared, alone, atol=2e-6)


@pytest.mark.parametrize("poisson", [0.3, 0.49])
@pytest.mark.parametrize("integrator", [None, wc.BackwardEuler(dt=0.01)])
def test_threads_take_whole_worlds_each_of_which_moves_as_it_would_alone(poisson, integrator):
    mesh = wc.TetForest.box(cells=(1, 1, 3), cell_size=0.03, level=5)
    mesh = mesh.refine(np.arange(5))
    material = wc.Isotropic(young=5e3, poisson=poisson, density=1000.0)
    found = []
    for worlds in (1, 11):
        body = wc.SoftBody(mesh, material, device="cpu", worlds=worlds, threads=3)
        assert body.discretization.team.parts == (1 if worlds == 1 else 3)
        body.fix("z == zmin")
        dt = wc.SymplecticEuler(dt=1e-4) if integrator is None else integrator
        sim = wc.Simulation(body, integrator=dt, gravity=(0.0, -9.8, 0.0))
        sim.advance(0.03)
        found.append(body.displacements.numpy().reshape(worlds, -1))
    np.testing.assert_array_equal(found[1], np.repeat(found[0], 11, axis=0))


@pytest.mark.parametrize("pairs", [False, True])
def test_explicit_contact_does_not_depend_on_the_number_of_threads(pairs):
    """Threads add contact forces up in any order, as integers."""

    def pressed(threads):
        meshes = [
            wc.TetForest.box(cells=(2, 1, 2), cell_size=0.03, level=8, origin=(0.0, y, 0.0)) for y in (0.0, 0.0305)
        ]
        material = wc.Isotropic(young=5e3, poisson=0.3, density=1000.0)
        bodies = [wc.SoftBody(mesh, material, device="cpu", threads=threads) for mesh in meshes[: 1 + pairs]]
        ball = wc.Tool(wc.Sphere(0.01, position=(0.03, 0.0402 + 0.0305 * pairs, 0.03)))
        ball.follow([0.0, 0.02], [(0.03, 0.0402 + 0.0305 * pairs, 0.03), (0.04, 0.035 + 0.0305 * pairs, 0.03)])
        obstacles = [wc.Ground((0.0, 1.0, 0.0), 0.0), ball]
        sim = wc.Simulation(bodies, obstacles=obstacles, gravity=(0.0, -9.8, 0.0), contact=wc.Contact(friction=0.3))
        sim.advance(0.02)
        assert np.abs(sim.contact.obstacles.wrenches.numpy()).max(axis=(1, 2)).min() > 0.0
        return np.concatenate([body.displacements.numpy() for body in bodies])

    one, three, again = (pressed(threads) for threads in (1, 3, 3))
    np.testing.assert_array_equal(three, again)
    np.testing.assert_allclose(three, one, rtol=0, atol=1e-3 * np.abs(one).max())


@pytest.mark.parametrize("parts", [2, 7])
def test_rows_of_one_level_are_not_coupled_between_parts(parts):
    n = 14
    points = np.stack(np.meshgrid(*[np.arange(n)] * 3, indexing="ij"), axis=-1).reshape(-1, 3).astype(float)
    near = cKDTree(points).sparse_distance_matrix(cKDTree(points), 1.8, output_type="coo_matrix").tocsr()
    near = (near + identity(n**3)).tocsr()
    rows = dissected(points, near.indptr, near.indices, parts)
    np.testing.assert_array_equal(np.sort(np.concatenate(rows)), np.arange(n**3))
    place = np.zeros(n**3, int)
    for k, nodes in enumerate(rows):
        place[nodes] = k
    coupled = near.tocoo()
    level, other = place[coupled.row], place[coupled.col]
    assert not ((level // parts == other // parts) & (level != other)).any()
    longest = sum(max(map(len, rows[k : k + parts])) for k in range(0, len(rows), parts))
    assert longest < (1.05 if parts == 2 else 1.5) * n**3 / parts
