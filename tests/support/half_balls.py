"""The parts of elastic balls and half-spaces around the place where they are touched."""

import numpy as np

import warp_corot as wc

YOUNG, POISSON = 1e4, 0.3
RADIUS, CONTACT = 0.02, 0.004  # of the ball and of the circle that it touches [m]
DEPTH = CONTACT**2 / RADIUS
#: 4/3 E* sqrt(R) depth^1.5 [N].
FORCE = 4.0 / 3.0 * YOUNG / (1.0 - POISSON**2) * np.sqrt(RADIUS) * DEPTH**1.5
HALF = 0.032  # of the block that stands for the half-space [m]


def boussinesq(points):
    """Displacements of a half-space z < 0 under a force at the origin; far away they are right for any pressure
    distribution with that force."""
    x, y, z = points[:, 0], points[:, 1], -points[:, 2]
    shear = 0.5 * YOUNG / (1.0 + POISSON)
    r = np.sqrt(x**2 + y**2 + z**2)
    down = 2.0 * (1.0 - POISSON) / r + z**2 / r**3
    outward = z / r**3 - (1.0 - 2.0 * POISSON) / (r * (r + z))
    return FORCE / (4.0 * np.pi * shear) * np.column_stack([outward * x, outward * y, -down])


def refined_block(finest):
    """Finest within one and a half radii of contact, and coarser in proportion farther away."""
    mesh = wc.TetForest.box(cells=(4, 4, 2), cell_size=0.5 * HALF, level=3, origin=(-HALF, -HALF, -HALF))
    for level in range(4, finest + 1):
        far = np.linalg.norm(mesh.points[mesh.tets].mean(axis=1), axis=1)
        size = 0.5 * HALF * 0.5 ** (level // 3)
        mesh = mesh.refine(np.flatnonzero((mesh.levels < level) & (far < max(1.5 * CONTACT, 3.0 * size))))
    return mesh


def border(x):
    """The nodes of a block that are not on its upper side."""
    return np.flatnonzero((np.abs(x[:, :2]).max(axis=1) > HALF - 1e-6) | (x[:, 2] < -HALF + 1e-6))


def half_ball(device, finest, radius, force, nearer, turn):
    """The part of an elastic ball around the place of contact: a half-space whose surface is curved there. It
    approaches the other one by this distance [m], from below, or, if there is a rotation, rotated and from above."""
    mesh = refined_block(finest)
    x, edge = mesh.points.copy(), border(mesh.points)
    moved = boussinesq(x[edge]) * force / FORCE + (0.0, 0.0, nearer)
    away = np.minimum(np.linalg.norm(x[:, :2], axis=1), 2.0 * CONTACT)
    x[:, 2] -= 0.5 * away**2 / radius * (1.0 + x[:, 2] / HALF)
    if turn:
        c, s = np.cos(turn), np.sin(turn)
        over = np.array([[c, -s, 0.0], [-s, -c, 0.0], [0.0, 0.0, -1.0]])
        x, moved = x @ over.T, moved @ over.T
    body = wc.SoftBody(wc.TetMesh(x, mesh.tets), wc.Isotropic(YOUNG, POISSON, 1000.0), device=device)
    body.prescribe(edge, times=[0.0, 0.1], displacements=np.stack([0.0 * moved, moved]))
    return body
