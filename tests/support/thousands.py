"""Meshes of thousands of elements of every kind, with materials and deformations, for tests of kernels."""

import functools

import numpy as np
import oracle
from cases import jittered, mixed_forest, random_displacement

import warp_corot as wc

TOLERANCE = 1e-5  # of the largest force, energy or stiffness: rounding, see test_forces
MATERIAL = {"young": 1e4, "poisson": 0.4, "density": 1000.0}
LEVELS = (9, 10, 11)  # a subtree's leaves of types 0, 1, 2; ancestors 3, 4 and 5 levels up are of all three
MESHES = {
    **{f"type {level % 3}": functools.partial(wc.TetForest.box, (1, 1, 1), 0.1, level) for level in LEVELS},
    "mixed levels": functools.partial(mixed_forest, cells=(2, 1, 1), level=7, passes=3, share=0.05),
    "general": lambda: some_left_over(jittered(cells=(2, 1, 1), level=8)),
}
FORESTS = [name for name in MESHES if name != "general"]


def some_left_over(mesh):
    """A number of elements that eight lanes do not divide."""
    return wc.TetMesh(mesh.points, mesh.tets[:-3])


@functools.cache
def meshed(name):
    mesh = MESHES[name]()
    assert len(mesh.tets) > 3000
    return mesh


def materials(count, uniform, rng):
    """A body's material, and mu and lambda."""
    given = dict(MATERIAL)
    if not uniform:
        given |= {"young": rng.uniform(5e3, 2e4, count), "poisson": rng.uniform(0.0, 0.45, count)}
    return given, oracle.lame(given["young"], given["poisson"])


def turned(mesh, rng, amount):
    """Strains of some three times ``amount``, with a large rotation."""
    strained = mesh.points + random_displacement(mesh, rng, amount)
    return (strained @ oracle.polar(rng.standard_normal((3, 3))).T - mesh.points).astype(np.float32)


def shared_rotations(forest, x, level):
    """The rotation of each leaf's ancestor at ``level``, or its own if it lies above [T, 3, 3]."""
    ancestors, unit = np.unique(forest.ancestors(level), return_inverse=True)
    units = oracle.Mesh(forest.points, forest.tree.tets[ancestors])
    return oracle.polar(units.deformation_gradients(x))[unit.ravel()]
