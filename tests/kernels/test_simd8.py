"""Forces in the lanes of a CPU's vector registers: digits at any strain, range, and omitted leaves.

Every such kernel is also compared with float64 in ``test_miscompile``; states here are those that lanes depend on.
"""

import numpy as np
import oracle
import pytest
from cases import oracle_mesh, place, random_displacement, simulation
from thousands import MATERIAL, MESHES, meshed, shared_rotations

import warp_corot as wc

MU, LAM = oracle.lame(MATERIAL["young"], MATERIAL["poisson"])
#: Of the largest force. Displacements are exact here; an operation rounds by 6e-8, and some ten add up at random.
DIGITS = 1e-6
LAWS = {
    "linear": wc.Linear(),
    "corotated": wc.Corotated(),
    "stvk": wc.StVenantKirchhoff(),
    "neo_hookean": wc.NeoHookean(),
}
CPU = "cpu"


def error(sim, expected):
    return np.abs(sim.forces().numpy() - expected).max() / np.abs(expected).max()


@pytest.mark.parametrize("size", [1e-1, 1e-3, 1e-6])
@pytest.mark.parametrize("name", MESHES)
@pytest.mark.parametrize("law", LAWS)
def test_small_strains_keep_their_digits(law, name, size, rng):
    mesh = meshed(name)
    sim, body = simulation(mesh, LAWS[law], CPU, dt=1e-5, material=MATERIAL)
    u = random_displacement(mesh, rng, 0.1 * size)
    place(body, u)
    _, expected = oracle.evaluate(law, oracle_mesh(mesh), mesh.points + u.astype(float), MU, LAM)
    assert error(sim, expected) < DIGITS


@pytest.mark.parametrize("levels_up", [3, 4])
@pytest.mark.parametrize("name", ["type 0", "type 1", "type 2"])
def test_small_strains_keep_their_digits_with_shared_rotations(name, levels_up, rng):
    mesh = meshed(name)
    level = int(mesh.levels[0]) - levels_up
    sim, body = simulation(mesh, wc.Corotated(rotation_level=level), CPU, dt=1e-5, material=MATERIAL)
    u = random_displacement(mesh, rng, 1e-6)
    place(body, u)
    x = mesh.points + u.astype(float)
    R = shared_rotations(mesh, x, level)
    _, expected = oracle.evaluate("corotated", oracle_mesh(mesh), x, MU, LAM, R=R)
    assert error(sim, expected) < DIGITS


@pytest.mark.parametrize(
    "stretches",
    [(1.0, 1.0, 1.0), (1.8, 0.7, 0.7), (5.0, 0.5, 0.4), (0.6, 0.6, 0.6), (1.0, 1.0, 0.0), (1.2, 1.0, -0.2)],
    ids=str,
)
@pytest.mark.parametrize("name", ["type 0", "type 1", "type 2"])
def test_stretched_flattened_and_turned_over_leaves_are_not_left_out(name, stretches, rng):
    """All leaves are equal except a tenth, from the range of Newton's iteration to where it fails."""
    mesh = meshed(name)
    sim, body = simulation(mesh, wc.Corotated(), CPU, dt=1e-5, material=MATERIAL, threads=1)
    turn, axes = (oracle.polar(rng.standard_normal((3, 3))) for _ in range(2))
    F = turn @ axes @ np.diag(stretches) @ axes.T
    u = (mesh.points @ F.T - mesh.points + 0.03 * random_displacement(mesh, rng, 1.0)).astype(np.float32)
    place(body, u)
    x = mesh.points + u.astype(float)
    _, expected = oracle.evaluate("corotated", oracle_mesh(mesh), x, MU, LAM)
    # Forces are differences of stresses between elements here, and these are some ten times as large.
    assert error(sim, expected) < 10 * DIGITS
    assert not any(batch.flagged.numpy().any() for batch in sim.fields[0].plan.batches)


@pytest.mark.parametrize("name", ["type 0", "type 1", "type 2"])
def test_a_bit_names_the_leaf_that_is_left_out(name):
    """Leaves are inverted until they have no definite rotation, one by one."""
    mesh = meshed(name)
    sim, body = simulation(mesh, wc.Corotated(), CPU, dt=1e-5, material=MATERIAL, threads=1)
    (batch,) = sim.fields[0].plan.batches
    first = batch.subtrees.first.numpy()
    for s, leaf in ((0, 0), (9, 3), (len(first) - 1, 7)):
        t = int(first[s]) + leaf
        u = np.zeros_like(mesh.points)
        # Collapsed to a point, which stretches its neighbours to twice their size.
        corners = mesh.points[mesh.tets[t]]
        u[mesh.tets[t]] = 0.8 * (corners.mean(axis=0) - corners)
        place(body, u.astype(np.float32))
        sim.forces()
        flagged = batch.flagged.numpy()[: batch.count]
        assert flagged[s] == 1 << leaf
        assert np.count_nonzero(flagged) == 1


@pytest.mark.parametrize("law", [*LAWS.values(), wc.Corotated(rotation_level="auto")], ids=repr)
def test_a_lanes_result_does_not_depend_on_the_others(law, rng):
    """Three worlds with numbers of subtrees and elements that eight does not divide: each bit for bit as alone."""
    mesh = MESHES["mixed levels"]()
    u = [random_displacement(mesh, rng, size) for size in (0.2, 1e-4, 0.6)]
    body = wc.SoftBody(mesh, wc.Isotropic(**MATERIAL), device=CPU, worlds=3)
    sim = wc.Simulation(body, model=law, integrator=wc.SymplecticEuler(dt=1e-5), gravity=(0, 0, 0))
    place(body, np.concatenate(u))
    together = sim.forces().numpy().reshape(3, -1, 3)
    for world in range(3):
        sim, body = simulation(mesh, law, CPU, dt=1e-5, material=MATERIAL)
        place(body, u[world])
        np.testing.assert_array_equal(together[world], sim.forces().numpy())
