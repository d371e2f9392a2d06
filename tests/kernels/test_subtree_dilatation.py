"""The dilatation that a subtree's leaves share, by CUDA's functions, whose arithmetic is the same on both devices."""

import functools

import numpy as np
import pytest
import warp as wp
from cases import CUBE

import warp_corot as wc
from warp_corot.discretization.discretization import deviatoric
from warp_corot.discretization.planner import ForcePlan
from warp_corot.elasticity.model import isotropic_material
from warp_corot.kernels.elements.dilatation import VOLUME
from warp_corot.kernels.subtrees.cuda import scatter_dilatation
from warp_corot.kernels.subtrees.degenerate import NO_LIST
from warp_corot.kernels.subtrees.memory import BLOCK

wp.set_module_options({"enable_backward": False})

#: Forests of one type of subtree, by that type.
FORESTS = {0: ((1, 1, 2), 3), 1: ((1, 1, 1), 4), 2: ((1, 1, 1), 5)}
slow = functools.partial(pytest.param, marks=pytest.mark.slow)


def material_of(body):
    of = body.discretization
    return isotropic_material([of.mu, of.lam, of.material_stride])


def strained(shape, uniform, amount, device, rng):
    """A body with its displacements and its subtrees as CUDA's kernels read them, and how many there are."""
    cells, level = FORESTS[shape]
    mesh = wc.TetForest.box(cells, CUBE, level)
    poisson = 0.49 if uniform else rng.uniform(0.3, 0.49, len(mesh.tets))
    body = wc.SoftBody(mesh, wc.Isotropic(1e4, poisson, 1e3), device=device)
    u = np.zeros((len(mesh.points), 4), np.float32)
    u[:, :3] = amount * np.cbrt(np.min(mesh.volumes)) * rng.uniform(-1.0, 1.0, mesh.points.shape)
    plan = ForcePlan.of_forest(mesh, None, body.device, elements=body.discretization.elements, grouped=False)
    (batch,) = plan.batches
    assert batch.shape == shape
    subtrees = batch.subtrees
    if body.device.is_cpu:
        by_node = np.ascontiguousarray(subtrees.nodes.numpy().T)
        subtrees.nodes = subtrees.targets = wp.array(by_node, dtype=wp.int32, device=device)
    return body, wp.array(u, dtype=wp.vec4, device=device), subtrees, batch.count


@pytest.mark.parametrize(
    ("shape", "uniform"), [(1, False), *(slow(shape, uniform) for shape in (0, 2) for uniform in (False, True))]
)
def test_forces_of_pressure(shape, uniform, device, rng):
    """Some leaves are beyond a quarter of their volume, and some turned over."""
    body, displacements, subtrees, count = strained(shape, uniform, 0.5, device, rng)
    both = wc.Corotated(dilatation="shared").bind(body).elastic_forces(displacements).numpy()
    shear = wc.Corotated(dilatation="element").bind(deviatoric(body.discretization))
    expected = both - shear.elastic_forces(displacements).numpy()
    found = wp.zeros_like(displacements)
    kernel = scatter_dilatation(shape, False, uniform, VOLUME)
    inputs = [subtrees, material_of(body), displacements]
    flagged = wp.zeros(count, dtype=wp.uint8, device=device)
    wp.launch(kernel, count, inputs, [found, flagged, NO_LIST], device=device, block_dim=BLOCK)
    assert np.abs(found.numpy() - expected)[:, :3].max() < 5e-6 * np.abs(expected).max()
