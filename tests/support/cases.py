"""Meshes, models and states that the tests of laws share."""

from dataclasses import replace
from functools import partial

import numpy as np
import oracle

import warp_corot as wc

CUBE = 0.064  # edge of a root cube [m]
MATERIAL = {"young": 500.0, "poisson": 0.49, "density": 10.0}  # the paper's

# the solver's model for each of the oracle's, in which every element has a dilatation of its own
MODELS = {
    "linear": partial(wc.Linear, dilatation="element"),
    "corotated": partial(wc.Corotated, dilatation="element"),
    "stvk": partial(wc.StVenantKirchhoff, dilatation="element"),
    "neo_hookean": partial(wc.NeoHookean, dilatation="element"),
    "edge_stvk": wc.EdgeStVK,
    "edge_stvk_quadratic": lambda: wc.EdgeStVK(springs="quadratic"),
    "mass_spring": wc.MassSpring,
}


def mixed_forest(seed=1, cells=(1, 1, 1), level=3, passes=2, share=0.1):
    """A forest with leaves of several levels side by side, some of them far apart in level."""
    rng = np.random.default_rng(seed)
    forest = wc.TetForest.box(cells=cells, cell_size=CUBE, level=level)
    for _ in range(passes):
        forest = forest.refine(rng.random(len(forest.tets)) < share)
    assert len(set(forest.levels)) > min(passes, 2)
    return forest


def jittered(seed=2, cells=(2, 1, 1), level=4, amount=0.15):
    """A general mesh: a forest's nodes moved by up to a fraction of the shortest edge; half is wrongly wound."""
    rng = np.random.default_rng(seed)
    forest = wc.TetForest.box(cells=cells, cell_size=CUBE, level=level)
    shortest = oracle.edge_lengths(oracle.Mesh(forest.points, forest.tets), forest.points)[1].min()
    points = forest.points + amount * shortest * rng.uniform(-1, 1, forest.points.shape)
    return wc.TetMesh(points, rng.permutation(forest.tets))


MESHES = {f"level {level}": (lambda level=level: wc.TetForest.box((1, 1, 1), CUBE, level)) for level in range(8)}
MESHES |= {"mixed levels": mixed_forest, "general": jittered}


def oracle_mesh(mesh):
    return oracle.Mesh(mesh.points, mesh.tets)


def edge_scale(mesh):
    """Shortest rest edge at every node [N, 1] (m), so that random displacements strain all levels alike."""
    reference = oracle_mesh(mesh)
    _, lengths = oracle.edge_lengths(reference, reference.points)
    shortest = np.full(len(mesh.points), np.inf)
    np.minimum.at(shortest, mesh.tets, np.broadcast_to(lengths.min(1, keepdims=True), mesh.tets.shape))
    return np.where(np.isfinite(shortest), shortest, 1.0)[:, None]


def random_displacement(mesh, rng, amount):
    """Random nodal displacements of ``amount`` of the shortest edge, in float32 like the solver's."""
    return (amount * edge_scale(mesh) * rng.uniform(-1, 1, mesh.points.shape)).astype(np.float32)


def simulation(
    mesh, model, device, *, dt=1e-4, damping=0.0, gravity=(0, 0, 0), material=None, fixed=None, threads=None
):
    """One body of the paper's material under a model (a name of MODELS, or a model).

    Every element has a dilatation of its own.
    """
    material = wc.Isotropic(**(MATERIAL if material is None else material))
    body = wc.SoftBody(mesh, material, device=device, threads=threads)
    if fixed is not None:
        body.fix(fixed)
    model = MODELS[model]() if isinstance(model, str) else replace(model, dilatation="element")
    sim = wc.Simulation(body, model=model, integrator=wc.SymplecticEuler(dt=dt, damping=damping), gravity=gravity)
    return sim, body


def place(body, u, v=None):
    """Set displacements (float32 [N, 3]) exactly and, if given, velocities."""
    body.displacements = u
    if v is not None:
        body.velocities = v


def positions(mesh, body):
    """Deformed positions in float64, free of the rounding of float32 positions."""
    return mesh.points + body.displacements.numpy().astype(float)
