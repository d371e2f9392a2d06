"""Many copies of a body: each behaves as it would alone, independently of the others."""

import numpy as np
import pytest
import warp as wp
from cases import random_displacement
from worlds import DT, MESHES, WORLDS, Scene, assert_same, beam, simulated, states

import warp_corot as wc

FOREST_MODELS = [
    wc.Corotated(rotation_level=0),
    wc.Corotated(rotation_level=1),
    wc.Corotated(subtrees=False),
]
ALL_MODELS = [
    wc.Corotated(),
    wc.Corotated(rotation="svd"),
    wc.Corotated(iterations=4),
    wc.Linear(),
    wc.StVenantKirchhoff(),
    wc.NeoHookean(),
    wc.EdgeStVK(),
    wc.EdgeStVK(springs="quadratic"),
    wc.MassSpring(),
]
#: Uniform forests are covered by adaptive ones, except for the grouping of subtrees.
CASES = [
    *(("uniform", model) for model in (FOREST_MODELS[0], ALL_MODELS[0], ALL_MODELS[3])),
    *(("adaptive", model) for model in FOREST_MODELS + ALL_MODELS),
    *(("general", model) for model in ALL_MODELS),
]


# --- alone or together ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("mesh", "model"), CASES, ids=repr)
def test_every_world_equals_a_single_body(mesh, model, device, rng):
    scene = Scene(MESHES[mesh](), rng)
    sim = simulated(scene.together(device), model)
    sim.advance_steps(25)
    stresses = sim.von_mises().reshape(WORLDS, -1)
    energy = np.zeros(3)
    for world in range(WORLDS):
        single = simulated(scene.alone(world, device), model)
        single.advance_steps(25)
        assert_same(device, states(sim.body)[world], states(single.body, 1)[0])
        assert_same(device, stresses[world][:, None], single.von_mises()[:, None])
        np.testing.assert_allclose(sim.body.masses.reshape(WORLDS, -1)[world], single.body.masses, rtol=1e-14)
        energy += single.energy()
    np.testing.assert_allclose(sim.energy(), energy, rtol=1e-4)


@pytest.mark.parametrize("model", [wc.Corotated(), wc.Corotated(rotation_level=0), wc.MassSpring()], ids=repr)
def test_a_number_for_each_world_equals_a_number_for_a_body(model, device):
    """Shared rotations with one material use another kernel than with several: equal except for rounding."""
    young = [2e3, 5e3, 9e3]
    sim = simulated(beam(device, young=np.reshape(young, (3, 1))), model)
    sim.advance_steps(100)
    for world, own in enumerate(young):
        single = simulated(beam(device, worlds=1, young=own), model)
        single.advance_steps(100)
        u = single.body.displacements.numpy()
        off = np.abs(sim.body.world(world).displacements.numpy() - u).max()
        assert off < 1e-5 * np.abs(u).max()


def test_subtrees_turned_inside_out_in_one_world_leave_the_others(device, rng):
    """The fast kernels leave these subtrees out, and they are computed one by one."""
    for model in (wc.Corotated(), wc.Corotated(rotation_level=0)):
        mesh = MESHES["uniform"]()
        start = np.stack([random_displacement(mesh, rng, amount) for amount in (0.1, 1.0, 0.1)])
        bodies = [wc.SoftBody(mesh, wc.Isotropic(5e3, 0.3, 1e3), worlds=w, device=device) for w in (3, 1, 1, 1)]
        for body, u in zip(bodies, [start, *start], strict=True):
            body.displacements = u
        sims = [simulated(body, model) for body in bodies]
        forces = [sim.forces().numpy().reshape(-1, len(mesh.points), 3) for sim in sims]
        assert_same(device, forces[0], np.concatenate(forces[1:]))


MATERIALS = {
    "one number": lambda w, t: 0.7,
    "of each element": lambda w, t: np.linspace(0.5, 1.5, t),
    "of each world": lambda w, t: np.linspace(0.5, 1.5, w)[:, None],
    "of one row for all": lambda w, t: np.linspace(0.5, 1.5, t)[None],
    "of each element in each world": lambda w, t: np.linspace(0.5, 1.5, w * t).reshape(w, t),
}


@pytest.mark.parametrize("model", [wc.Corotated(dilatation="element"), wc.MassSpring()], ids=repr)
@pytest.mark.parametrize("form", MATERIALS)
def test_material_of_worlds_and_elements(form, model, device, rng):
    """All forms broadcast as in NumPy; masses are a quarter of each element's at each of its nodes."""
    mesh = MESHES["adaptive"]()
    t, n = len(mesh.tets), len(mesh.points)
    share = MATERIALS[form](WORLDS, t)
    values = [1e4 * share, 0.3 * share, 1e3 * (2.0 - share)]
    everywhere = np.stack([np.broadcast_to(value, (WORLDS, t)) for value in values])
    body = wc.SoftBody(mesh, wc.Isotropic(*values), worlds=WORLDS, device=device)
    u = random_displacement(mesh, rng, 0.1)
    body.displacements = u
    forces = simulated(body, model).forces().numpy().reshape(WORLDS, n, 3)
    for world in range(WORLDS):
        mass = np.zeros(n)
        np.add.at(mass, mesh.tets, 0.25 * (mesh.volumes * everywhere[2, world])[:, None])
        np.testing.assert_allclose(body.masses.reshape(WORLDS, n)[world], mass, rtol=1e-12)
        single = wc.SoftBody(mesh, wc.Isotropic(*everywhere[:, world]), device=device)
        single.displacements = u
        assert_same(device, forces[world], simulated(single, model).forces().numpy())


def test_the_stable_step_is_that_of_the_stiffest_world(device):
    young = np.array([[1e3], [9e3], [4e3]])
    together = wc.Simulation(beam(device, young=young))
    stiffest = wc.Simulation(beam(device, worlds=1, young=9e3))
    assert together.stable_dt == pytest.approx(stiffest.stable_dt, rel=0.02)


# --- what is done to chosen worlds ---------------------------------------------------------------------------------


def test_loads_of_all_shapes(device):
    body = beam(device)
    n, nodes = body.world_node_count, np.array([4, 1, 7])
    each = np.arange(9.0).reshape(3, 3) + 1
    expected = np.zeros((WORLDS, n, 3))

    def check(force, worlds, values):
        body.load(nodes, force, worlds=worlds)
        chosen = np.arange(WORLDS) if worlds is None else worlds
        expected[np.ix_(chosen, nodes)] = values
        np.testing.assert_array_equal(body.loads.numpy().reshape(WORLDS, n, 3), expected)

    check([1, 2, 3], None, [1, 2, 3])
    check(each, None, each)
    by_world = np.array([[[1.0, 0, 0]], [[0, 2.0, 0]], [[0, 0, 3.0]]])
    check(by_world, None, by_world)
    check(by_world + each, None, by_world + each)
    check((by_world - each).reshape(-1, 3), None, by_world - each)
    check(by_world[:2] + each, [2, 0], by_world[:2] + each)  # in the order of the worlds given
    check(2 * each[None], [1], 2 * each)
    check(by_world[:0], [], by_world[:0])
    mask = np.zeros((WORLDS, n), bool)
    mask[0, 3] = mask[2, 5] = True
    body.load(mask, [[1, 1, 1], [2, 2, 2]])
    expected[0, 3], expected[2, 5] = 1, 2
    np.testing.assert_array_equal(body.loads.numpy().reshape(WORLDS, n, 3), expected)


def test_held_nodes_of_chosen_worlds(device):
    body = wc.SoftBody(MESHES["uniform"](), wc.Isotropic(5e3, 0.4, 1e3), worlds=WORLDS, device=device)
    n = body.world_node_count
    held = np.zeros((WORLDS, n), bool)

    def check():
        np.testing.assert_array_equal(body.constrained.reshape(WORLDS, n), held)
        inverse = body.conditions.inverse_mass.numpy().reshape(WORLDS, n)
        np.testing.assert_array_equal(inverse == 0, held)

    body.fix([0, -1])
    held[:, [0, -1]] = True
    check()
    body.release([0], worlds=1)
    held[1, 0] = False
    check()
    body.fix(np.arange(n) < 3, worlds=np.array([True, False, True]))
    held[[0, 2], :3] = True
    check()
    mask = np.zeros((WORLDS, n), bool)
    mask[1, 5] = mask[2, 6] = True
    body.fix(mask)
    body.fix(mask.ravel())
    held |= mask
    check()
    body.prescribe([8, 9], velocity=[[[1, 0, 0], [2, 0, 0]], [[3, 0, 0], [4, 0, 0]]], worlds=[2, 1])
    held[1:, [8, 9]] = True
    check()
    speeds = body.velocities.numpy().reshape(WORLDS, n, 3)[:, [8, 9], 0]
    np.testing.assert_array_equal(speeds, [[0, 0], [3, 4], [1, 2]])
    body.release(held)
    held[:] = False
    check()


def test_masks_and_shapes_of_all_worlds_also_of_one_world(device):
    """Code for any number of worlds works for one."""
    body = beam(device, worlds=1)
    n = body.world_node_count
    body.fix(np.arange(n)[None] == 5)
    assert body.constrained[5]
    body.load([1, 2], np.ones((1, 1, 3)))
    body.load([1, 2], [[[1, 2, 3], [4, 5, 6]]])
    np.testing.assert_array_equal(body.loads.numpy()[[1, 2]], [[1, 2, 3], [4, 5, 6]])
    body.positions = body.mesh.points[None] + 1.0
    np.testing.assert_allclose(body.displacements.numpy(), 1.0, rtol=1e-6)


# --- views ---------------------------------------------------------------------------------------------------------


def test_views_of_a_world_are_live(device, rng):
    body = beam(device)
    n = body.world_node_count
    sim = simulated(body)
    sim.advance_steps(5)
    view = body.world(1)
    assert (view.nodes, view.elements) == (slice(n, 2 * n), slice(48, 96))
    for name in ("positions", "displacements", "velocities", "reactions", "loads"):
        every = getattr(body, name).numpy().reshape(WORLDS, n, 3)
        np.testing.assert_array_equal(getattr(view, name).numpy(), every[1], err_msg=name)
    before = states(body)
    moved = body.mesh.points + 0.01 * rng.random((n, 3))
    view.positions.assign(moved.astype(np.float32))
    view.velocities.assign(np.full((n, 3), 0.5, np.float32))
    view.loads.assign(np.full((n, 3), 0.25, np.float32))
    after = states(body)
    np.testing.assert_array_equal(after[[0, 2]], before[[0, 2]])
    np.testing.assert_allclose(after[1, 0], moved - body.mesh.points, atol=1e-8)
    np.testing.assert_array_equal(after[1, 1], 0.5)
    np.testing.assert_array_equal(body.loads.numpy().reshape(WORLDS, n, 3)[:, :, 0], [[0.0] * n, [0.25] * n, [0.0] * n])
    sim.step()
    held = body.constrained[:n]
    np.testing.assert_allclose(view.positions.numpy()[held], moved[held] + 0.5 * DT, atol=1e-7)


# --- mistakes ------------------------------------------------------------------------------------------------------


def int32(n):
    return wp.zeros(n, dtype=wp.int32, device="cpu")


MISTAKES = {
    "no world": (lambda b: beam("cpu", worlds=0), "worlds is 0; it must be a whole number, at least 1"),
    "half a world": (lambda b: beam("cpu", worlds=1.5), "worlds is 1.5"),
    "a word": (lambda b: beam("cpu", worlds="many"), "worlds is 'many'"),
    "more than can be numbered": (lambda b: beam("cpu", worlds=2**30), "elements; there can be 2147483647 at most"),
    "no such world": (lambda b: b.world(3), "world is 3; it must be a whole number from 0 to 2"),
    "world before the first": (lambda b: b.world(-1), "world is -1"),
    "true for a world": (lambda b: b.world(True), "world is True"),
    "a word for a world": (lambda b: b.world("a"), "world is 'a'"),
    "NaN for a world": (lambda b: b.world(np.nan), "world is nan"),
    "materials of other worlds": (lambda b: beam("cpu", young=np.ones((2, 1))), r"\(2, 1\); there are 3 worlds of 48"),
    "materials of other elements": (lambda b: beam("cpu", young=np.ones((3, 7))), r"young has shape \(3, 7\)"),
    "a material of three dimensions": (lambda b: beam("cpu", young=np.ones((3, 1, 1))), r"shape \(3, 1, 1\)"),
    "bad in one world": (lambda b: beam("cpu", young=np.array([[1.0], [0.0], [2.0]])), "young in world 1 is 0 Pa"),
    "bad element in one world": (
        lambda b: beam("cpu", young=np.where(np.arange(144) == 50, -1.0, 1.0).reshape(3, 48)),
        "young of element 2 in world 1 is -1 Pa",
    ),
    "fixed in no such world": (lambda b: b.fix([0], worlds=3), "world 3 is out of range: there are 3"),
    "world mask too short": (lambda b: b.fix([0], worlds=[True, False]), r"world mask has shape \(2,\)"),
    "mask turned over": (lambda b: b.fix(np.ones((b.world_node_count, 3), bool)), "node mask has shape"),
    "mask of all worlds in one": (
        lambda b: b.fix(np.ones((3, b.world_node_count), bool), worlds=1),
        "chooses the worlds itself",
    ),
    "node of another world": (lambda b: b.fix([b.world_node_count]), "is out of range"),
    "loads of other worlds": (lambda b: b.load([0, 1], np.ones((2, 2, 3))), r"or \[3, 2, 3\]"),
    "a word for a load": (lambda b: b.load([0], "down"), "force is 'down'"),
    "velocities of other worlds": (lambda b: b.prescribe([0], velocity=np.ones((2, 1, 3))), "velocity has shape"),
    "loads through a mask of all worlds": (
        lambda b: b.load(np.ones((3, b.world_node_count), bool), np.ones((3, 1, 3))),
        "force has shape",
    ),
    "keyframes of other nodes": (
        lambda b: b.prescribe([0, 1], times=[0, 1], displacements=np.zeros((2, 5, 3))),
        "displacements has shape",
    ),
    "state of another number": (lambda b: setattr(b, "velocities", np.zeros((2, 27, 3))), "velocities has shape"),
    "reset of no such world": (lambda b: simulated(b).reset([3]), "world 3 is out of range"),
    "reset by name": (lambda b: simulated(b).reset("all"), "world indices have dtype"),
    "reset by a short array": (lambda b: simulated(b).reset(int32(2)), r"int32 \[2\] on cpu; it must be int32 \[3\]"),
    "reset by floats": (lambda b: simulated(b).reset(wp.zeros(3, dtype=float, device="cpu")), r"worlds is float32 \[3"),
    "bodies of other numbers": (lambda b: simulated([b, beam("cpu", worlds=2)]), "bodies have 3 and 2 worlds"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistakes_with_worlds_are_named(mistake):
    act, message = MISTAKES[mistake]
    with pytest.raises(wc.InputError, match=message):
        act(beam("cpu"))
