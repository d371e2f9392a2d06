"""The parts of elastic balls around the place where they touch."""

import numpy as np

import warp_corot as wc
from warp_corot.experiments.half_spaces import (
    CONTACT,
    HALF,
    POISSON,
    YOUNG,
    border,
    boussinesq,
    refined_block,
)


def half_ball(device, finest, radius, force, nearer, turn):
    """The part of an elastic ball around the place of contact: a half-space whose surface is curved there. It
    approaches the other one by this distance [m], from below, or, if there is a rotation, rotated and from above."""
    mesh = refined_block(finest)
    x, edge = mesh.points.copy(), border(mesh.points)
    moved = boussinesq(x[edge], force) + np.array([0.0, 0.0, nearer])
    away = np.minimum(np.linalg.norm(x[:, :2], axis=1), 2.0 * CONTACT)
    x[:, 2] -= 0.5 * away**2 / radius * (1.0 + x[:, 2] / HALF)
    if turn:
        c, s = np.cos(turn), np.sin(turn)
        over = np.array([[c, -s, 0.0], [-s, -c, 0.0], [0.0, 0.0, -1.0]])
        x, moved = x @ over.T, moved @ over.T
    body = wc.SoftBody(wc.TetMesh(x, mesh.tets), wc.Isotropic(YOUNG, POISSON, 1000.0), device=device)
    body.prescribe(edge, times=[0.0, 0.1], displacements=np.stack([0.0 * moved, moved]))
    return body
