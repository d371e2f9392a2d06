"""A rigid ball pressed into an elastic half-space, beside Hertz's closed form."""

import numpy as np
import pytest

import warp_corot as wc

YOUNG, POISSON = 1e4, 0.3
RADIUS, CONTACT = 0.02, 0.004  # of the ball and of the circle that it touches [m]
DEPTH = CONTACT**2 / RADIUS
#: 4/3 E* sqrt(R) depth^1.5 [N].
FORCE = 4.0 / 3.0 * YOUNG / (1.0 - POISSON**2) * np.sqrt(RADIUS) * DEPTH**1.5
HALF = 0.032  # of the block that stands for the half-space [m]


def refined_block(finest):
    """Finest within one and a half radii of contact, and coarser in proportion farther away."""
    mesh = wc.TetForest.box(cells=(4, 4, 2), cell_size=0.5 * HALF, level=3, origin=(-HALF, -HALF, -HALF))
    for level in range(4, finest + 1):
        far = np.linalg.norm(mesh.points[mesh.tets].mean(axis=1), axis=1)
        size = 0.5 * HALF * 0.5 ** (level // 3)
        mesh = mesh.refine(np.flatnonzero((mesh.levels < level) & (far < max(1.5 * CONTACT, 3.0 * size))))
    return mesh


def boussinesq(points):
    """Displacements of a half-space z < 0 under a force at the origin: right far away, whatever is pressed how."""
    x, y, z = points[:, 0], points[:, 1], -points[:, 2]
    shear = 0.5 * YOUNG / (1.0 + POISSON)
    r = np.sqrt(x**2 + y**2 + z**2)
    down = 2.0 * (1.0 - POISSON) / r + z**2 / r**3
    outward = z / r**3 - (1.0 - 2.0 * POISSON) / (r * (r + z))
    return FORCE / (4.0 * np.pi * shear) * np.column_stack([outward * x, outward * y, -down])


@pytest.mark.parametrize("finest", [12, pytest.param(15, marks=pytest.mark.slow)])
def test_a_ball_sinks_in_as_hertz_says(device, finest):
    mesh = refined_block(finest)
    body = wc.SoftBody(mesh, wc.Isotropic(YOUNG, POISSON, 1000.0), device=device)
    x = mesh.points
    edge = np.flatnonzero((np.abs(x[:, :2]).max(axis=1) > HALF - 1e-6) | (x[:, 2] < -HALF + 1e-6))
    body.prescribe(edge, times=[0.0, 0.1], displacements=np.stack([0 * x[edge], boussinesq(x[edge])]))
    ball = wc.Tool(wc.Sphere(RADIUS))
    ball.follow([0.0, 0.1], [(0.0, 0.0, RADIUS), (0.0, 0.0, RADIUS - DEPTH)])
    sim = wc.Simulation(
        body,
        obstacles=[ball],
        gravity=(0.0, 0.0, 0.0),
        integrator=wc.SymplecticEuler(damping=150.0),
        contact=wc.Contact(friction=0.0),
    )
    sim.advance(0.3)
    assert ball.wrench.numpy()[0, 2] == pytest.approx(FORCE, rel=0.03)
    moved = body.positions.numpy().astype(float) - (0.0, 0.0, RADIUS - DEPTH)
    assert np.linalg.norm(moved, axis=1).min() > RADIUS - 1e-6
