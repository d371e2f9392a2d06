"""Shared helpers for many copies of a body: scenes in which they differ, and comparison of states.

On the CPU each gives bit for bit the result that it gives alone: a world's elements have the same order as a single
body's. On CUDA forces are summed in any order; ``TOLERANCE`` of the largest value is the effect after some ten steps.
"""

import numpy as np
from cases import jittered, mixed_forest, random_displacement

import warp_corot as wc

CUBE, WORLDS, DT = 0.064, 3, 2e-4
TOLERANCE = 1e-4

MESHES = {
    "uniform": lambda: wc.TetForest.box((1, 1, 1), CUBE, 3),  # six subtrees: worlds share the lanes of a vector
    "adaptive": lambda: mixed_forest(passes=2),
    "general": lambda: jittered(cells=(1, 1, 1), level=2),
}


def simulated(bodies, model=None, **options):
    integrator = wc.SymplecticEuler(dt=DT, damping=2.0)
    return wc.Simulation(bodies, model=model, integrator=integrator, gravity=(0.3, -9.8, 0.1), **options)


def beam(device, *, worlds=WORLDS, young=5e3, mesh=None):
    """Copies of a small block, held at z = 0."""
    mesh = mesh or wc.TetForest.box((1, 1, 1), CUBE, 3)
    body = wc.SoftBody(mesh, wc.Isotropic(young, 0.4, 1000.0), worlds=worlds, device=device)
    body.fix(mesh.points[:, 2] < 1e-9)
    return body


def states(body, worlds=WORLDS):
    """Displacements, velocities and reactions, [worlds, 3, N, 3]."""
    arrays = [getattr(body, name).numpy() for name in ("displacements", "velocities", "reactions")]
    return np.stack([a.reshape(worlds, -1, 3) for a in arrays], axis=1)


def assert_same(device, actual, expected):
    """Equal bit for bit on the CPU, to rounding in each kind of value on CUDA; of one or more ``states``."""
    assert np.isfinite(expected).all()
    if device == "cpu":
        np.testing.assert_array_equal(actual, expected)
    scale = np.abs(expected).max(axis=(-2, -1), keepdims=True)
    assert (np.abs(actual - expected) <= TOLERANCE * scale).all()


class Scene:
    """Three worlds that differ in everything: what each holds, moves, carries, weighs, and how it starts."""

    def __init__(self, mesh, rng):
        n, t = len(mesh.points), len(mesh.tets)
        self.mesh = mesh
        self.young = rng.uniform(2e3, 2e4, (WORLDS, t))
        self.poisson = rng.uniform(0.2, 0.45, (WORLDS, 1))
        self.density = rng.uniform(500.0, 2000.0, (WORLDS, 1))
        nodes = rng.permutation(n)
        self.fixed, self.moved, self.keyed = nodes[: n // 6], nodes[n // 6 : n // 5], nodes[n // 5 : n // 4 + 3]
        self.forces = rng.normal(0.0, 0.01, (WORLDS, n, 3))
        self.start = np.stack([random_displacement(mesh, rng, 0.1) for _ in range(WORLDS)])
        self.velocities = rng.normal(0.0, 0.05, (WORLDS, n, 3))
        self.keys = CUBE * rng.uniform(-0.05, 0.05, (2, len(self.keyed), 3))

    def constrain(self, body, world, in_body):
        """The supports, motion and loads of one world; ``in_body`` is its index among the body's worlds."""
        if world != 1:
            body.fix(self.fixed, worlds=in_body)
        if world != 2:
            body.prescribe(self.moved, velocity=[0.01 * world, 0.02, 0.0], worlds=in_body)
            keys = (1 + world) * self.keys
            body.prescribe(self.keyed, times=[0.001, 0.004], displacements=keys, worlds=in_body)
        body.load(np.arange(len(self.mesh.points)), self.forces[world], worlds=in_body)

    def together(self, device):
        body = wc.SoftBody(
            self.mesh, wc.Isotropic(self.young, self.poisson, self.density), worlds=WORLDS, device=device
        )
        body.displacements, body.velocities = self.start, self.velocities
        for world in range(WORLDS):
            self.constrain(body, world, world)
        return body

    def alone(self, world, device):
        own = (self.young[world], self.poisson[world, 0], self.density[world, 0])
        body = wc.SoftBody(self.mesh, wc.Isotropic(*own), device=device)
        body.displacements, body.velocities = self.start[world], self.velocities[world]
        self.constrain(body, world, None)
        return body
