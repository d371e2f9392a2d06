"""Bodies whose surface lies inside their tetrahedra, as organs' do."""

import functools

import warp_corot as wc

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


def ground(height=-BALL):
    return wc.Ground(normal=(0, 0, 1), offset=height)
