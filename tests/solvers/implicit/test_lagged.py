"""A preconditioner that is kept from step to step, and products with kept gradients."""

import numpy as np
import pytest
import warp as wp
from tangents import on_device

import warp_corot as wc
from warp_corot.elasticity.corotated.tangents import RotatedTangent


def swinging(device, **options):
    mesh = wc.TetForest.box(cells=(1, 1, 3), cell_size=0.064, level=3)
    body = wc.SoftBody(mesh, wc.Isotropic(5e4, 0.4, 1000.0), device=device)
    body.fix(mesh.points[:, 2] < 1e-9)
    integrator = wc.BackwardEuler(dt=0.01, **options)
    return wc.Simulation(body, integrator=integrator, gravity=(0.0, -9.81, 0.0))


def setups(sim):
    return int(sim.kept["setup.0.counts"].numpy()[0])


def test_it_is_set_up_less_often_than_steps_are_made(device):
    """The motion is that with the block diagonal, if both are solved well."""
    sim, other = (swinging(device, preconditioner=name, linear_tolerance=1e-6) for name in ("multigrid", "diagonal"))
    for each in (sim, other):
        each.advance_steps(40)
    assert 1 <= setups(sim) <= 12
    u = sim.body.displacements.numpy()
    assert np.abs(u - other.body.displacements.numpy()).max() < 1e-4 * np.abs(u).max()


def test_it_is_set_up_again_where_other_nodes_are_held(device):
    """Nodes that are let go are solved for, and those that are held stay where they are."""
    sim = swinging(device, preconditioner="multigrid")
    body = sim.body
    sim.advance_steps(8)
    before, end = setups(sim), body.mesh.points[:, 2] > 0.19
    place = body.displacements.numpy()[end]
    body.fix(end)
    sim.advance_steps(1)
    assert setups(sim) == before + 1
    assert np.array_equal(body.displacements.numpy()[end], place)
    body.release(end)
    sim.advance_steps(4)
    assert setups(sim) >= before + 2
    assert np.abs(body.displacements.numpy()[end] - place).max() > 1e-3
    assert sim.solves.unfinished == 0


@pytest.mark.parametrize("general", [False, True])
def test_products_of_crushed_elements_are_those_of_their_rotations(general, device, rng):
    """Elements for which the lanes find no good rotation get a robust one."""
    mesh = wc.TetForest.box(cells=(1, 1, 1), cell_size=0.1, level=4)
    if general:
        mesh = wc.TetMesh(mesh.points, mesh.tets)
    body = wc.SoftBody(mesh, wc.Isotropic(1e4, 0.3, 1000.0), device=device)
    field = wc.Corotated().bind(body)
    u = (mesh.points * [0.0, 0.0, -1.6] + 1e-3 * rng.standard_normal(mesh.points.shape)).astype(np.float32)
    p = rng.standard_normal(mesh.points.shape).astype(np.float32)
    y, expected = (on_device(np.zeros_like(p), field) for _ in range(2))
    for tangent, product in ((field.tangent(), y), (RotatedTangent(field), expected)):
        tangent.prepare(on_device(u, field))
        tangent.take(on_device(u, field))
        tangent.add_product(on_device(p, field), product)
    wp.synchronize_device(field.device)
    assert np.abs(y.numpy() - expected.numpy()).max() < 1e-4 * np.abs(expected.numpy()).max()
