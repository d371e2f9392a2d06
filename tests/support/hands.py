"""A block under a person's hands."""

import numpy as np

import warp_corot as wc
from warp_corot.viewing.session import Session

EDGE = 0.1


def block(device="cpu", level=6, held=True, **options):
    """A block of gel, 0.1 by 0.1 by 0.2 m, without weight."""
    mesh = wc.TetForest.box(cells=(1, 1, 2), cell_size=EDGE, level=level)
    body = wc.SoftBody(mesh, wc.Isotropic(young=5e3, poisson=0.4, density=1000.0), device=device)
    if held:
        body.fix("z == zmin")
    explicit = wc.SymplecticEuler(options.pop("dt", None), options.pop("damping", 20.0))
    integrator = options.pop("integrator", explicit)
    return wc.Simulation(body, integrator=integrator, gravity=(0, 0, 0), **options)


def session(device="cpu", **options):
    return Session(block(device, **options))


TOP = np.array([0.05, 0.05, 0.2])
