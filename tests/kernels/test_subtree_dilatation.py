"""The dilatation that a subtree's leaves share, by CUDA's functions: all leaves at once, and two halves with one sum.

Their arithmetic is the same on both devices.
"""

import functools

import numpy as np
import pytest
import warp as wp
from cases import CUBE

import warp_corot as wc
from warp_corot.discretization.planning.fixed import ForcePlan
from warp_corot.discretization.shear_only import ShearOnly
from warp_corot.kernels.elements.dilatation import VOLUME, mean_of
from warp_corot.kernels.elements.elements import Subtrees, root_of
from warp_corot.kernels.math.matrices import column
from warp_corot.kernels.modules import unique_kernel
from warp_corot.kernels.subtrees.dilatation import (
    dilatation_sums_of,
    dilating_forces_of,
    pressure_forces_of,
    scatter_dilatation,
)
from warp_corot.kernels.subtrees.laws import turn_in, turn_out
from warp_corot.kernels.subtrees.memory import BLOCK, add_single, load_single

wp.set_module_options({"enable_backward": False})

#: Forests of one type of subtree, by that type.
FORESTS = {0: ((1, 1, 2), 3), 1: ((1, 1, 1), 4), 2: ((1, 1, 1), 5)}
slow = functools.partial(pytest.param, marks=pytest.mark.slow)


@functools.cache
def scatter_halves(shape, uniform):
    """As ``scatter_dilatation``, with the leaves in two parts."""
    first_sums, last_sums = (dilatation_sums_of(shape, uniform, VOLUME, part) for part in (range(4), range(4, 8)))
    first_forces, last_forces = (pressure_forces_of(shape, uniform, VOLUME, part) for part in (range(4), range(4, 8)))

    @unique_kernel(grid_stride=False)
    def scatter_halves(
        # In
        subtrees: Subtrees,
        lam: wp.array[wp.float32],
        u: wp.array[wp.vec4],
        # Out
        f: wp.array[wp.vec4],
    ):
        s = wp.tid()
        h, q, mirror = root_of(subtrees, s)
        q0 = column(q, 0)
        q1 = column(q, 1)
        q2 = column(q, 2) * mirror
        first = wp.where(wp.static(uniform), 0, subtrees.first[s])
        y = turn_in(load_single(subtrees, s, u), q0, q1, q2, 1.0 / h)
        sum, weight = first_sums(y, lam, first)
        last_sum, last_weight = last_sums(y, lam, first)
        pressure = mean_of(sum + last_sum, weight + last_weight)
        add_single(subtrees, s, turn_out(first_forces(y, h, pressure, lam, first), q0, q1, q2), f)
        add_single(subtrees, s, turn_out(last_forces(y, h, pressure, lam, first), q0, q1, q2), f)

    return scatter_halves


@functools.cache
def scatter_at_once(shape, uniform):
    """The law and the pressure in one pass, with the leaves in two parts."""
    sums = dilatation_sums_of(shape, uniform, VOLUME)
    first_forces, last_forces = (dilating_forces_of(shape, uniform, part) for part in (range(3), range(3, 8)))

    @unique_kernel(grid_stride=False)
    def scatter_at_once(
        # In
        subtrees: Subtrees,
        mu: wp.array[wp.float32],
        lam: wp.array[wp.float32],
        u: wp.array[wp.vec4],
        # Out
        f: wp.array[wp.vec4],
        left_out: wp.array[wp.int32],
    ):
        s = wp.tid()
        h, q, mirror = root_of(subtrees, s)
        q0 = column(q, 0)
        q1 = column(q, 1)
        q2 = column(q, 2) * mirror
        first = wp.where(wp.static(uniform), 0, subtrees.first[s])
        y = turn_in(load_single(subtrees, s, u), q0, q1, q2, 1.0 / h)
        sum, weight = sums(y, lam, first)
        pressure = mean_of(sum, weight)
        g, first_mask = first_forces(y, h, pressure, mu, lam, first)
        add_single(subtrees, s, turn_out(g, q0, q1, q2), f)
        g, last_mask = last_forces(y, h, pressure, mu, lam, first)
        add_single(subtrees, s, turn_out(g, q0, q1, q2), f)
        left_out[s] = first_mask | last_mask

    return scatter_at_once


@pytest.mark.parametrize(("shape", "uniform"), [(1, False), slow(0, True), slow(2, False)])
def test_forces_at_once(shape, uniform, device, rng):
    """No leaf is turned over; some are beyond a quarter of their volume."""
    body, displacements, subtrees, count = strained(shape, uniform, 0.2, device, rng)
    expected = wc.Corotated(dilatation="shared").bind(body).elastic_forces(displacements).numpy()
    found = wp.zeros_like(displacements)
    left_out = wp.zeros(count, dtype=wp.int32, device=device)
    inputs = [subtrees, body.discretization.mu, body.discretization.lam, displacements]
    wp.launch(scatter_at_once(shape, uniform), count, inputs, [found, left_out], device=device, block_dim=BLOCK)
    assert not left_out.numpy().any()
    assert np.abs(found.numpy() - expected)[:, :3].max() < 5e-6 * np.abs(expected).max()


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
    ("shape", "uniform", "halves"),
    [*map(slow, (1, 0, 2, 0, 2), (False, True, False, False, True), (True, True, True, False, False))],
)
def test_forces_of_pressure(shape, uniform, halves, device, rng):
    """Some leaves are beyond a quarter of their volume, and some turned over."""
    body, displacements, subtrees, count = strained(shape, uniform, 0.5, device, rng)
    both = wc.Corotated(dilatation="shared").bind(body).elastic_forces(displacements).numpy()
    shear = wc.Corotated(dilatation="element").bind(ShearOnly(body.discretization))
    expected = both - shear.elastic_forces(displacements).numpy()
    kernel = scatter_halves(shape, uniform) if halves else scatter_dilatation(shape, False, uniform, VOLUME)
    found = wp.zeros_like(displacements)
    inputs = [subtrees, body.discretization.lam, displacements]
    wp.launch(kernel, count, inputs, [found], device=device, block_dim=BLOCK)
    assert np.abs(found.numpy() - expected)[:, :3].max() < 5e-6 * np.abs(expected).max()
