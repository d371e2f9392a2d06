"""The dilatation that a subtree's leaves share, by CUDA's functions: by itself, and with the law in two parts.

Their arithmetic is the same on both devices.
"""

import functools

import numpy as np
import pytest
import warp as wp
from cases import CUBE

import warp_corot as wc
from warp_corot.discretization.deviatoric import deviatoric
from warp_corot.discretization.planning.fixed import ForcePlan
from warp_corot.elasticity.structs import isotropic_material
from warp_corot.kernels.elements.constitutive import IsotropicMaterial
from warp_corot.kernels.elements.dilatation import VOLUME, mean_of
from warp_corot.kernels.elements.elements import Subtrees, root_of
from warp_corot.kernels.modules import unique_kernel
from warp_corot.kernels.subtrees.dilatation import dilatation_sums_of, dilating_leaves, scatter_dilatation
from warp_corot.kernels.subtrees.forces import maubach_frame, subtree_forces, turn_in, turn_out
from warp_corot.kernels.subtrees.memory import BLOCK, add_single, load_single

wp.set_module_options({"enable_backward": False})

#: Forests of one type of subtree, by that type.
FORESTS = {0: ((1, 1, 2), 3), 1: ((1, 1, 1), 4), 2: ((1, 1, 1), 5)}
slow = functools.partial(pytest.param, marks=pytest.mark.slow)


@functools.cache
def scatter_at_once(shape, uniform):
    """The law and the pressure in one pass, with the leaves in two parts."""
    sums, law = dilatation_sums_of(shape, uniform, VOLUME), dilating_leaves(shape)
    first_forces, last_forces = (subtree_forces(shape, uniform, law, part) for part in (range(3), range(3, 8)))

    @unique_kernel(grid_stride=False)
    def scatter_at_once(
        # In
        subtrees: Subtrees,
        material: IsotropicMaterial,
        u: wp.array[wp.vec4],
        # Out
        f: wp.array[wp.vec4],
        degenerate: wp.array[wp.int32],
    ):
        s = wp.tid()
        h, q, mirror = root_of(subtrees, s)
        q0, q1, q2 = maubach_frame(q, mirror)
        first = wp.where(wp.static(uniform), 0, subtrees.first[s])
        y = turn_in(load_single(subtrees, s, u), q0, q1, q2, 1.0 / h)
        sum, weight = sums(y, material.lam, first)
        pressure = mean_of(sum, weight)
        g, first_mask = first_forces(y, h, material, pressure, first)
        add_single(subtrees, s, turn_out(g, q0, q1, q2), f)
        g, last_mask = last_forces(y, h, material, pressure, first)
        add_single(subtrees, s, turn_out(g, q0, q1, q2), f)
        degenerate[s] = first_mask | last_mask

    return scatter_at_once


@pytest.mark.parametrize(("shape", "uniform"), [(1, False), slow(0, True), slow(2, False)])
def test_forces_at_once(shape, uniform, device, rng):
    """No leaf is turned over; some are beyond a quarter of their volume."""
    body, displacements, subtrees, count = strained(shape, uniform, 0.2, device, rng)
    expected = wc.Corotated(dilatation="shared").bind(body).elastic_forces(displacements).numpy()
    found = wp.zeros_like(displacements)
    degenerate = wp.zeros(count, dtype=wp.int32, device=device)
    inputs = [subtrees, material_of(body), displacements]
    wp.launch(scatter_at_once(shape, uniform), count, inputs, [found, degenerate], device=device, block_dim=BLOCK)
    assert not degenerate.numpy().any()
    assert np.abs(found.numpy() - expected)[:, :3].max() < 5e-6 * np.abs(expected).max()


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
    wp.launch(kernel, count, inputs, [found], device=device, block_dim=BLOCK)
    assert np.abs(found.numpy() - expected)[:, :3].max() < 5e-6 * np.abs(expected).max()
