"""Linear solves of implicit steps with the assembled matrix, and the choice between these and multigrid."""

import numpy as np
import pytest
import warp as wp
from cases import mixed_forest, random_displacement
from multigrids import MASS, ROUNDING, uniform
from organs import SOFT, ball_mesh, brick_mesh, ground
from scipy.sparse import bsr_array
from soft_blocks import DOWN, block
from tangents import on_device

import warp_corot as wc
from warp_corot.kernels.implicit import lagged
from warp_corot.kernels.implicit.assembled import Couplings
from warp_corot.kernels.implicit.lagged import CHOICE_COUNTS
from warp_corot.solvers.implicit import assembled
from warp_corot.solvers.implicit.assembled import AssembledSolve, suits
from warp_corot.solvers.implicit.block_system import VectorBlocks
from warp_corot.solvers.implicit.conjugate_gradients import ConjugateGradients
from warp_corot.solvers.implicit.preconditioners import WORTH
from warp_corot.solvers.implicit.tangent import TangentOperator

FORESTS = {"uniform": uniform, "mixed": lambda: mixed_forest(level=5), "ball": ball_mesh}
#: Displacements over edges; with those of 1.5 more than a third of the elements are turned over.
AMOUNTS = {"rest": 0.0, "strained": 0.2, "crushed": 1.5}


def operator_of(mesh, device, rng, poisson, amount):
    """The operator of two worlds with a tenth of the nodes held, at random displacements; and its free nodes."""
    body = wc.SoftBody(mesh, wc.Isotropic(5e3, poisson, 1000.0), worlds=2, device=device)
    held = rng.random(2 * len(mesh.points)) < 0.1
    body.fix(held)
    operator = TangentOperator(body, wc.Corotated().bind(body))
    assert suits(operator)
    operator.set_scales(MASS, 0.0, 1.0)
    u = np.concatenate([random_displacement(mesh, rng, amount) for _ in range(2)])
    operator.take(on_device(u, operator.field))
    return operator, ~held


def assembled_of(operator):
    """The assembled matrix of one operator."""
    blocks = VectorBlocks([len(operator.inverse_mass)])
    solve = AssembledSolve([operator], blocks, together=False, touches=False)
    solve.update()
    return solve


def product(apply, x, device):
    """y = A x [n, 3], float64."""
    padded, y = np.zeros((len(x), 4), np.float32), wp.zeros(len(x), dtype=wp.vec4, device=device)
    padded[:, :3] = x
    apply(wp.array(padded, dtype=wp.vec4, device=device), y)
    return y.numpy()[:, :3].astype(float)


def matrix_of(solve, worlds):
    """The assembled matrices of all worlds in the form that the device reads, float64."""
    rows, entries, count = solve._rows, solve._entries, solve._count
    blocks = rows.blocks.numpy()[:-1].swapaxes(1, 2)
    if solve.device.is_cuda:
        blocks = solve._planes.numpy().reshape(worlds, 3, 3, entries).transpose(0, 3, 2, 1).reshape(-1, 3, 3)
    starts, columns = rows.starts.numpy()[:-1], rows.columns.numpy()
    starts = np.concatenate([*(starts + world * entries for world in range(worlds)), [worlds * entries]])
    columns = np.concatenate([columns + world * count for world in range(worlds)])
    return bsr_array((blocks.astype(float), columns, starts))


@pytest.mark.parametrize("amount", AMOUNTS)
@pytest.mark.parametrize("poisson", [0.4, 0.47])
@pytest.mark.parametrize("name", FORESTS)
def test_the_matrix_is_the_operators(name, poisson, amount, device, rng):
    """From a Poisson's ratio of 0.45 on, elements share their dilatation."""
    operator, free = operator_of(FORESTS[name](), device, rng, poisson, AMOUNTS[amount])
    solve = assembled_of(operator)
    x = rng.standard_normal((len(free), 3)).astype(np.float32) * free[:, None]
    expected = product(operator.apply, x, device)
    found = (matrix_of(solve, 2) @ x.astype(float).ravel()).reshape(-1, 3)
    error = np.abs(found - expected).max() / np.abs(expected).max()
    print(f"{error:.1e} of the largest value")
    assert error < 50 * ROUNDING


@pytest.mark.parametrize("poisson", [0.4, 0.47])
def test_a_solve_satisfies_the_operator(poisson, device, rng):
    """To its tolerance, by a product of the operator itself; a world without a right side takes no iterations."""
    operator, free = operator_of(ball_mesh(), device, rng, poisson, 0.2)
    solve = assembled_of(operator)
    b = rng.standard_normal((len(free), 3)).astype(np.float32) * free[:, None]
    b[: len(b) // 2] = 0.0
    cg, x = ConjugateGradients(operator, len(b)), on_device(np.zeros_like(b), operator.field)
    cg.tolerance.fill_(1e-4)
    cg.begin(on_device(b, operator.field), x)
    solve.iterate(cg, x)
    report = cg.report()
    assert report.converged.all()
    assert report.iterations[0] == 0 < report.iterations[1]
    left = b - product(operator.apply, x.numpy()[:, :3], device)
    assert np.linalg.norm(left) < 1e-4 * np.linalg.norm(b)


def pressed(scene, device, **options):
    """Two worlds of a body on the ground, under a ball that presses it for 10 steps and then drags it: nodes that are
    held, a ball between nodes, or places on the body's own surface."""
    contact = wc.Contact(friction=0.3)
    bodies = []
    if scene == "soft surfaces":
        body = block(device, level=4, worlds=2, origin=(0.0, 0.0, 0.02))
        bodies.append(block(device, level=3, worlds=2))
        below, top = ground(0.0), 0.04
    elif scene == "own surface":
        body = wc.SoftBody(brick_mesh(), SOFT, worlds=2, device=device)
        below, top = ground(-0.007), 0.007
    else:
        body, below, top = block(device, level=4, worlds=2), ground(0.0), 0.02
    radius = 0.003 if scene == "between nodes" else 0.008
    tool = wc.Tool(wc.Sphere(radius))
    x, y = body.mesh.points[:, :2].mean(axis=0) + np.array([0.0011, 0.0007])
    path = [(x, y, top + radius), (x, y, top + radius - 0.003), (x + 0.004, y, top + radius - 0.003)]
    tool.follow([0.0, 0.1, 0.2], path)
    integrator = wc.BackwardEuler(dt=0.01, damping=2.0, **options)
    bodies.append(body)
    sim = wc.Simulation(bodies, obstacles=[below, tool], contact=contact, integrator=integrator, gravity=DOWN)
    return sim, tool


def test_stiff_nodes_are_scaled_in_their_own_body(device, rng):
    """The preconditioner of the second of two bodies gets a vector whose entries begin with that body's first node."""
    sim, _ = pressed("soft surfaces", device)
    sim.advance_steps(15)
    (solve_of_step,) = sim.recorded._stepper._solves
    system = solve_of_step._system
    system.contact.update(system.x)
    system.contact.update_springs()
    v = on_device(rng.standard_normal((system.worlds * system.node_count, 3)), system)
    before, blocks = v.numpy().copy(), system.blocks.of(v)
    system.contact.scale(1, blocks[1], is_after=False)
    changed = np.flatnonzero((v.numpy() != before).any(axis=1))
    contact, at = system.contact, sim.contact.surface.places_of(1)
    is_stiff = np.trace(contact._stiffness.numpy()[at], axis1=1, axis2=2) > 0.0
    assert is_stiff.any()
    np.testing.assert_array_equal(changed, np.sort(contact._carriers.entry.numpy()[at][is_stiff]))
    # What the tool holds moves less.
    assert (np.linalg.norm(v.numpy()[changed], axis=1) < np.linalg.norm(before[changed], axis=1)).all()


@pytest.mark.parametrize("scene", ["held", "between nodes", "own surface", "soft surfaces"])
def test_contact_is_in_the_matrix(scene, device, rng):
    """A and the sum of c c^T are what the operator does, and solves satisfy it. Where soft surfaces may meet, it is one
    matrix for all bodies and worlds."""
    sim, _ = pressed(scene, device)
    sim.advance_steps(15)
    (solve_of_step,) = sim.recorded._stepper._solves
    system, solve = solve_of_step._system, solve_of_step.choice.assembled
    count = system.worlds * system.node_count
    solve.update()
    system.contact.update(system.x)
    solve.take_contact(system.contact)
    couplings, b = solve.couplings, on_device(rng.standard_normal((count, 3)), system)
    x = b.numpy()[:, :3].astype(float)
    found = (matrix_of(solve, system.worlds) @ x.ravel()).reshape(-1, 3)
    used = int(couplings.count.numpy()[0])
    for nodes, parts in zip(couplings.nodes.numpy()[:used], couplings.parts.numpy()[:used, :, :3], strict=True):
        c = parts[nodes >= 0].astype(float)
        found[nodes[nodes >= 0]] += (c * x[nodes[nodes >= 0]]).sum() * c
    expected = product(system.apply, x, device)
    assert (used > 0) == (scene != "held")
    error = np.abs(found - expected).max() / np.abs(expected).max()
    print(f"{used} products, {error:.1e} of the largest value")
    assert error < 50 * ROUNDING
    change = wp.zeros_like(b)
    system.solver.begin(b, change)
    solve.iterate(system.solver, change)
    left = x - product(system.apply, change.numpy()[:, :3], device)
    assert system.solver.report().converged.all()
    assert np.linalg.norm(left) < 1e-4 * np.linalg.norm(x)


@pytest.mark.parametrize("scene", ["held", "between nodes", "own surface"])
def test_a_pressed_body_ends_where_multigrid_ends(scene, device):
    """On the ground, under a ball. Once the ball drags it, steps with other tolerances part as well."""
    ends = []
    for preconditioner in (None, "multigrid"):
        sim, tool = pressed(scene, device, preconditioner=preconditioner)
        sim.advance_steps(10)
        ends.append((sim.body.displacements.numpy(), tool.wrench.numpy()[0, :3]))
    (u, force), (there, expected) = ends
    assert np.abs(u - there).max() < 1e-3 * np.abs(there).max()
    assert np.abs(force - expected).max() < 1e-3 * np.abs(expected).max()


def test_a_body_at_rest_takes_no_iterations(device):
    body = wc.SoftBody(mixed_forest(level=5), wc.Isotropic(5e3, 0.47, 1000.0), device=device)
    sim = wc.Simulation(body, integrator=wc.BackwardEuler(dt=0.01), gravity=(0.0, 0.0, 0.0))
    sim.advance_steps(4)
    assert (sim.solves.steps, sim.solves.linear_iterations, sim.solves.unfinished) == (4, 0, 0)
    assert not body.displacements.numpy().any()


@wp.kernel
def add_pairs(pairs: wp.array[wp.vec2i], k: float, u: wp.array[wp.vec4], f: wp.array[wp.vec4]):
    """f += K u of springs [N/m] between two nodes each."""
    pair = pairs[wp.tid()]
    force = k * (u[pair[0]] - u[pair[1]])
    wp.atomic_add(f, pair[0], force)
    wp.atomic_sub(f, pair[1], force)


@wp.kernel
def add_pair_blocks(pairs: wp.array[wp.vec2i], k: float, blocks: wp.array[wp.mat33]):
    pair = pairs[wp.tid()]
    for side in range(2):
        wp.atomic_add(blocks, pair[side], k * wp.identity(3, dtype=wp.float32))


class Pairs:
    """Stiff springs between nodes of a body, which the assembled matrix lacks."""

    def __init__(self, body, pairs, stiffness):
        self.body, self.stiffness = body, stiffness
        self._pairs = wp.array(pairs, dtype=wp.vec2i, device=body.device)

    def add_forces(self):
        self._launch(add_pairs, -self.stiffness, self.body.state.displacements, self.body.state.forces)

    def add_stiffness(self, body, p, y):
        self._launch(add_pairs, self.stiffness, p, y)

    def add_diagonal(self, body, blocks):
        self._launch(add_pair_blocks, self.stiffness, blocks)

    def _launch(self, kernel, stiffness, *arrays):
        wp.launch(kernel, len(self._pairs), [self._pairs, stiffness, *arrays], device=self.body.device)


def swinging(device, young=5e3, length=8, steps=10, forces=None, **options):
    """A beam that is let go under its weight."""
    mesh = wc.TetForest.box((1, 1, length), 0.02, 3)
    body = wc.SoftBody(mesh, wc.Isotropic(young, 0.4, 1000.0), device=device)
    body.fix("z == zmin")
    sim = wc.Simulation(body, integrator=wc.BackwardEuler(dt=0.02, **options), gravity=(0.0, -9.81, 0.0))
    if forces is not None:
        sim.add_forces(forces(body))
    sim.advance_steps(steps)
    return sim


def is_assembled(sim):
    return bool(sim.kept["setup.0.assembled"].numpy()[0])


def test_forces_that_couple_nodes_are_solved_for_with_multigrid(device):
    """The two ends of a beam on springs; it moves less than without them, and as with multigrid alone."""

    def springs(body):
        ends = np.argsort(body.mesh.points[:, 2], kind="stable")
        return Pairs(body, [ends[[0, -1]], ends[[1, -2]]], 50.0)

    plain = swinging(device).body.displacements.numpy()
    u, expected = (
        swinging(device, forces=springs, preconditioner=name).body.displacements.numpy() for name in (None, "multigrid")
    )
    assert np.abs(u - plain).max() > 0.1 * np.abs(plain).max()
    np.testing.assert_allclose(u, expected, rtol=0, atol=0 if device == "cpu" else 1e-3 * np.abs(u).max())


@pytest.mark.parametrize(("young", "length", "ends_assembled"), [(2e3, 8, True), (1e8, 24, False)])
def test_the_choice_and_resumed_runs(young, length, ends_assembled, device, tmp_path):
    """A stiff body comes to use multigrid, a soft one does not; a resumed run goes on with the same choice."""
    sim = swinging(device, young, length)
    assert is_assembled(sim) == ends_assembled
    assert sim.solves.unfinished == 0
    expected = swinging(device, young, length, preconditioner="multigrid").body.displacements.numpy()
    assert np.abs(sim.body.displacements.numpy() - expected).max() < 2e-3 * np.abs(expected).max()
    sim.save(tmp_path / "state.npz")
    later = wc.Simulation.load(tmp_path / "state.npz")
    for each in (sim, later):
        each.advance_steps(8)
    u, resumed = (each.body.displacements.numpy() for each in (sim, later))
    np.testing.assert_allclose(resumed, u, rtol=0, atol=0 if device == "cpu" else 1e-3 * np.abs(u).max())
    if device == "cpu":
        np.testing.assert_array_equal(later.kept["setup.0.choice"].numpy(), sim.kept["setup.0.choice"].numpy())


def test_a_resumed_run_keeps_its_choice_although_a_new_one_would_begin_otherwise(device, monkeypatch, tmp_path):
    sim = swinging(device)
    sim.save(tmp_path / "state.npz")
    monkeypatch.setattr("warp_corot.solvers.implicit.preconditioners.STIFF", 0.0)
    later = wc.Simulation.load(tmp_path / "state.npz")
    later.step()
    assert is_assembled(later)
    assert not is_assembled(swinging(device, steps=1))


def test_a_beam_that_takes_too_many_iterations_is_solved_for_with_multigrid(device, monkeypatch):
    """Its first step is unfinished, and no other one, if its stiffness is not known before."""
    monkeypatch.setattr("warp_corot.solvers.implicit.preconditioners.STIFF", np.inf)
    sim = swinging(device, 1e8, 24, linear_iterations=300)
    assert not is_assembled(sim)
    assert sim.solves.unfinished == 1
    monkeypatch.undo()
    assert swinging(device, 1e8, 24, linear_iterations=300).solves.unfinished == 0


def test_contacts_for_which_there_is_no_room_are_solved_for_with_multigrid(device, monkeypatch):
    monkeypatch.setattr(assembled, "LEAST_ROOM", 4)
    monkeypatch.setattr(assembled, "ROOM", 0)
    sim, _ = pressed("own surface", device)
    sim.advance_steps(10)
    assert not is_assembled(sim)
    assert sim.solves.unfinished <= 1


@pytest.mark.parametrize(("assembled", "multigrid"), [(40, 8), (400, 4), (400, 30), (3000, 12)])
def test_the_choice_costs_little_in_a_long_run(assembled, multigrid):
    """Over 20,000 steps with the same iterations in each, at most a twentieth more than the better way."""
    cost, total, steps = 32, 0, 20_000
    counts, choice, taken, status = (wp.zeros(n, dtype=wp.int32, device="cpu") for n in (CHOICE_COUNTS, 1, 1, 1))
    choice.fill_(1)
    couplings = Couplings()
    couplings.count, couplings.nodes = (wp.zeros(n, dtype=wp.int32, device="cpu") for n in (1, (1, 1)))
    for _ in range(steps):
        total += assembled if choice.numpy()[0] else cost * multigrid
        taken.fill_(assembled if choice.numpy()[0] else multigrid)
        wp.launch(lagged.choose, 1, [taken, status, 1, WORTH, cost, couplings], [counts, choice], device="cpu")
    assert total < 1.05 * steps * min(assembled, cost * multigrid)
