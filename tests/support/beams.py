"""Beams that tests of stepping share."""

import numpy as np

import warp_corot as wc


def beam(device="cpu", *, young=5e3, level=3, worlds=1, poisson=0.44):
    mesh = wc.TetForest.box(cells=(1, 1, 3), cell_size=0.064, level=level)
    body = wc.SoftBody(mesh, wc.Isotropic(young, poisson, 1000.0), worlds=worlds, device=device)
    body.fix(mesh.points[:, 2] < 1e-9)
    return body


def stretched(body, by=0.8):
    points = np.tile(body.mesh.points, (body.worlds, 1))
    body.displacements = points * [0.0, 0.0, by]
    return body
