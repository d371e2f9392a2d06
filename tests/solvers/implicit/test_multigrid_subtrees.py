"""The finest level of multigrid over subtrees, without its matrix: the same as with the matrix."""

import numpy as np
import pytest
import warp as wp
from cases import MATERIAL, random_displacement
from tangents import on_device

import warp_corot as wc
from warp_corot.solvers.implicit.multigrid import Multigrid
from warp_corot.solvers.implicit.multigrid.subtrees import SubtreeLevel
from warp_corot.solvers.implicit.preconditioners import preconditioner_of
from warp_corot.solvers.implicit.tangent import TangentOperator

WORLDS = 2
MASS, DAMPING, STIFFENING = 2.0e3, 20.0, 0.02  # a [1/s^2] and b [1/s] of A = a M + b D + K, D as stiff as 0.02 s of K

short = ("level", "dilatation", "poisson"), [(6, "element", 0.3)]
long = (
    ("level", "dilatation", "poisson"),
    [(6, "shared", 0.47), (7, "element", 0.3), (7, "shared", 0.49), (10, "shared", 0.45)],
)


def compared(level, dilatation, poisson, device, rng, *, varies=False):
    """Multigrid with the finest matrix and over subtrees, both up to date with the operator of two strained worlds."""
    mesh = wc.TetForest.box((1, 1, 1), 0.064, level)
    young = MATERIAL["young"] * (rng.uniform(0.5, 2.0, len(mesh.tets)) if varies else 1.0)
    material = wc.Isotropic(young, poisson, MATERIAL["density"])
    body = wc.SoftBody(mesh, material, worlds=WORLDS, device=device)
    body.fix(rng.random(WORLDS * len(mesh.points)) < 0.1)
    operator = TangentOperator(body, wc.Corotated(dilatation=dilatation).bind(body))
    operator.set_scales(MASS, DAMPING, 1.0)
    u = np.concatenate([random_displacement(mesh, rng, 0.2) for _ in range(WORLDS)])
    operator.take(on_device(u.astype(np.float32), operator.field))
    blocks = np.zeros((len(u), 3, 3), np.float32)
    blocks[:: len(mesh.points) // 7] = 1e3 * np.diag([1.0, 0.0, 2.0])
    others = wp.array(blocks, dtype=wp.mat33, device=device)
    operator.other_blocks = lambda: others
    options = {"stiffening": STIFFENING, "few_nodes": 30, "members": operator.field.find_members}
    both = [Multigrid(body, assembled=assembled, **options) for assembled in (True, False)]
    for multigrid in both:
        multigrid.update(operator)
    return both


def cycle_of(multigrid, given):
    z = wp.zeros_like(given)
    multigrid.apply(given, z)
    return z.numpy().copy()


def check(level, dilatation, poisson, device, rng):
    with_matrix, over_subtrees = compared(level, dilatation, poisson, device, rng, varies=level == 7)
    finest = over_subtrees.levels[0]
    assert isinstance(finest, SubtreeLevel)
    expected = with_matrix.levels[0].inverses.numpy()
    np.testing.assert_allclose(finest.inverses.numpy(), expected, rtol=0, atol=1e-5 * np.abs(expected).max())
    # Of a residual: held nodes, where it is zero, included.
    free = with_matrix._free.numpy()
    x = np.zeros((len(free), 4), np.float32)
    x[:, :3] = rng.standard_normal((len(free), 3)) * (free != 0)[:, None]
    found = []
    for multigrid in (with_matrix, over_subtrees):
        multigrid.levels[0].r.zero_()
        multigrid.levels[0].z.assign(x)
        multigrid.levels[0].find_residual()
        found.append(multigrid.levels[0].other.numpy().copy())
    np.testing.assert_allclose(found[1], found[0], rtol=0, atol=2e-6 * np.abs(found[0]).max())
    # Levels that both have, whose matrices are products.
    same = {each.count: each for each in with_matrix.levels[1:]}
    shared = [each for each in over_subtrees.levels[1:] if each.count in same]
    assert shared
    for each in shared:
        expected = same[each.count].blocks.numpy()
        np.testing.assert_allclose(each.blocks.numpy(), expected, rtol=0, atol=2e-6 * np.abs(expected).max())
    return with_matrix, over_subtrees


@pytest.mark.slow
@pytest.mark.parametrize(*short)
def test_the_level_is_the_same_as_with_its_matrix(level, dilatation, poisson, device, rng):
    """Diagonal, residual and coarser matrices: two worlds, held nodes anywhere, mass, damping, and other forces."""
    with_matrix, over_subtrees = check(level, dilatation, poisson, device, rng)
    if level % 3 == 0:
        nodes = WORLDS * with_matrix.discretization.sizes.world_nodes
        given = on_device(rng.standard_normal((nodes, 3)).astype(np.float32), with_matrix)
        expected, found = (cycle_of(multigrid, given) for multigrid in (with_matrix, over_subtrees))
        np.testing.assert_allclose(found, expected, rtol=0, atol=5e-6 * np.abs(expected).max())


@pytest.mark.slow
@pytest.mark.parametrize(*long)
def test_other_levels_are_the_same(level, dilatation, poisson, device, rng):
    check(level, dilatation, poisson, device, rng)


def test_meshes_whose_subtrees_do_not_have_all_midpoints_keep_the_matrix(device):
    """At level 8, which is one less than a multiple of three, one of a subtree's nodes is no midpoint of its root's
    edges. Leaves of several levels and leaves outside subtrees keep the matrix, too."""
    graded = wc.TetForest.from_domain(wc.Domain.sphere(0.1, device="cpu"), 0.12, max_level=9, surface_error=0.002)
    for mesh in (wc.TetForest.box((1, 1, 1), 0.064, 8), graded):
        body = wc.SoftBody(mesh, wc.Isotropic(5e3, 0.3, 1000.0), device=device)
        assert not isinstance(Multigrid(body, assembled=False).levels[0], SubtreeLevel)


def test_large_bodies_on_cuda_go_over_subtrees(device, monkeypatch):
    monkeypatch.setattr("warp_corot.solvers.implicit.preconditioners.FEWEST_OVER_SUBTREES", 1)
    body = wc.SoftBody(wc.TetForest.box((1, 1, 1), 0.064, 6), wc.Isotropic(5e3, 0.3, 1000.0), device=device)
    operator = TangentOperator(body, wc.Corotated().bind(body))
    finest = preconditioner_of("multigrid", operator).levels[0]
    assert isinstance(finest, SubtreeLevel) == operator.device.is_cuda
