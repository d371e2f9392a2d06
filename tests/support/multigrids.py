"""Multigrid in tests: operators, their cycles, and matrices of these."""

import numpy as np
import warp as wp
from cases import MATERIAL, MODELS
from tangents import on_device

import warp_corot as wc
from warp_corot.solvers.implicit.multigrid import Multigrid
from warp_corot.solvers.implicit.tangent import TangentOperator

ROUNDING = float(np.finfo(np.float32).eps)
MASS = 2.0e3  # a of A = a M + K [1/s^2]


def uniform(level=5):
    return wc.TetForest.box((1, 1, 1), 0.064, level)


def lowest_tenth(mesh):
    return mesh.points[:, 1] <= np.quantile(mesh.points[:, 1], 0.1)


def operator_of(
    mesh, device, *, model="corotated", fixed=None, poisson=0.3, young=MATERIAL["young"], worlds=1, mass=0.0
):
    material = wc.Isotropic(young, poisson, MATERIAL["density"])
    body = wc.SoftBody(mesh, material, worlds=worlds, device=device)
    body.fix(lowest_tenth(mesh) if fixed is None else fixed)
    operator = TangentOperator(body, MODELS[model]().bind(body))
    operator.set_scales(mass, 0.0, 1.0)
    return operator


def multigrid_of(operator, model="corotated", u=None, **options):
    multigrid = Multigrid(operator.body, is_turned=model != "linear", **options)
    given = np.zeros((len(operator.inverse_mass), 3)) if u is None else u
    operator.take(on_device(given.astype(np.float32), operator.field))
    multigrid.update(operator)
    return multigrid


def dense(level, world=0):
    """The matrix of a level, float64 [3 n, 3 n]."""
    pattern, n = level.pattern, level.count
    matrix = np.zeros((n, 3, n, 3))
    rows, columns = pattern.pairs.numpy().T
    entries = slice(world * pattern.entries, (world + 1) * pattern.entries)
    matrix[rows, :, columns] = level.blocks.numpy()[entries].swapaxes(1, 2)
    return matrix.reshape(3 * n, 3 * n)


def as_matrix(apply, nodes, device):
    """The dense matrix of something that is applied to vectors, float64 [3 nodes, 3 nodes]."""
    columns = []
    y = wp.zeros(nodes, dtype=wp.vec4, device=device)
    for column in range(3 * nodes):
        x = np.zeros((nodes, 4), np.float32)
        x[column // 3, column % 3] = 1.0
        apply(wp.array(x, dtype=wp.vec4, device=device), y)
        columns.append(y.numpy()[:, :3].astype(float).ravel())
    return np.array(columns).T


def mesh_nodes(multigrid):
    """The number of each rank's node."""
    return multigrid.discretization.levels().nodes.numpy()
