"""Bodies whose surface lies inside their tetrahedra, as organs' do."""

import functools

import numpy as np

import warp_corot as wc
from warp_corot.mesh.surfaces.bound import nearest_faces

BALL = 0.02  # radius [m]
SOFT = wc.Isotropic(young=2e4, poisson=0.4, density=1000.0)


@functools.cache
def ball_mesh():
    return wc.TetForest.from_domain(wc.Domain.sphere(BALL), target_elements=400)


@functools.cache
def brick_mesh(elements=400):
    lower, upper = (-0.013, -0.011, -0.007), (0.013, 0.011, 0.007)
    return wc.TetForest.from_domain(wc.Domain.box(lower, upper), target_elements=elements)


@functools.cache
def fork_mesh():
    """Two prongs along z on a handle along x."""
    handle = wc.Domain.capsule((-0.012, 0, 0), (0.012, 0, 0), 0.006)
    prongs = [wc.Domain.capsule((x, 0, 0), (x, 0, 0.05), 0.005) for x in (-0.012, 0.012)]
    return wc.TetForest.from_domain(handle | prongs[0] | prongs[1], target_elements=500)


def crossing(fork):
    """The largest depth to which the drawn prongs of a fork lie in one another [m]."""
    surface = fork.mesh.surface()
    rest, now = surface.points, surface.moved(fork.displacements.numpy())
    deepest = 0.0
    for side in (-1.0, 1.0):
        corners = rest[surface.triangles]
        other = surface.triangles[((side * corners[..., 0] < 0.0) & (corners[..., 2] > 0.015)).all(axis=1)]
        points = now[(side * rest[:, 0] > 0.0) & (rest[:, 2] > 0.02)]
        a, b, c = np.moveaxis(now[other[nearest_faces(now, other, points, 1.0)]], 1, 0)
        normal = np.cross(b - a, c - a)
        heights = np.einsum("nc,nc->n", normal, points - a) / np.linalg.norm(normal, axis=1)
        deepest = max(deepest, -heights.min())
    return deepest


def ground(height=-BALL):
    return wc.Ground(normal=(0, 0, 1), offset=height)
