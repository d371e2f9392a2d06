"""Random blades through twelve bodies, and what must hold after each."""

from __future__ import annotations

import functools
import warnings
from dataclasses import replace

import numpy as np
import trimesh
from bodies import ball, ring
from cut_cases import assert_closed, assert_cut_sound, face_table, hung
from remesh_cases import support_impulse

import warp_corot as wc

CELL = 0.04
#: How fast the ends of blades go at most [m/s], and the time after a path [s].
SPEED, RESTS = 2.0, 0.01


def tissue(**changes):
    return wc.Isotropic(**({"young": 3e4, "poisson": 0.4, "density": 1000.0, "toughness": 3.0} | changes))


def box(cells, level, device, **material):
    return held(wc.SoftBody(wc.TetForest.box(cells, CELL, level), tissue(**material), device=device))


def held(body, share=0.1):
    body.fix(f"x < xmin + {share} * (xmax - xmin)")
    return body


@functools.cache
def ball_mesh():
    return wc.TetForest.from_domain(ball(0.05), cell_size=0.03, max_level=4, device="cpu")


@functools.cache
def ring_mesh():
    return wc.TetForest.from_domain(ring(0.045, 0.016), cell_size=0.03, max_level=4, device="cpu")


@functools.cache
def file_mesh():
    """Of a surface of triangles, as in a file: a bent lobe."""
    shape = trimesh.creation.icosphere(subdivisions=3)
    x = shape.vertices * [0.06, 0.035, 0.025]
    x[:, 1] += 8.0 * x[:, 0] ** 2
    domain = wc.Domain.from_surface((x, shape.faces), device="cpu")
    return wc.TetForest.from_domain(domain, cell_size=0.03, max_level=4, device="cpu")


@functools.cache
def labelled_mesh():
    grid = np.stack(np.meshgrid(*(np.arange(n) - (n - 1) / 2 for n in (20, 14, 12)), indexing="ij"), axis=-1)
    labels = np.where((grid / [9.5, 6.5, 5.5]) ** 2 @ np.ones(3) < 1.0, 1, 0).astype(np.int16)
    labels[(labels == 1) & (grid[..., 0] > 1.0)] = 2
    domain = wc.Domain.from_labels(labels, (0.005,) * 3, labels={"one": 1, "two": 2}, device="cpu")
    return wc.TetForest.from_domain(domain, cell_size=0.03, max_level=4, device="cpu")


def adaptive(rng, device):
    mesh = wc.TetForest.box((2, 1, 1), CELL, 3)
    for _ in range(3):
        mesh = mesh.refine(np.flatnonzero(rng.random(len(mesh.tets)) < 0.15))
    return held(wc.SoftBody(mesh, tissue(), device=device)), {}


def labelled(rng, device):
    mesh = labelled_mesh()
    young = np.where(mesh.labels == 1, 2e4, 6e4)
    return held(wc.SoftBody(mesh, tissue(young=young), device=device)), {}


def remeshed(rng, device):
    options = wc.OnlineRemesh(refine_above=1.15, simplify_below=1.05, min_level=3, max_level=8, every=7)
    return box((2, 1, 1), 4, device), {"remesh": options}


def strained(rng, device):
    body = box((2, 1, 1), 4, device)
    x = body.mesh.points
    body.positions = x * [1.3, 0.9, 0.9]
    end = np.flatnonzero(x[:, 0] > x[:, 0].max() - 1e-9)
    pulled = body.displacements.numpy()[end]
    body.prescribe(end, times=[0.0, 1.0], displacements=[pulled, pulled])
    return body, {}


def stuck(rng, device):
    """A ball on a table, whose lips touch; it is held so that its weight alone presses no element inside out."""
    body = held(wc.SoftBody(ball_mesh(), tissue(), device=device), 0.3)
    contact = wc.Contact(friction=0.3, self_contact=True)
    return body, {"obstacles": [wc.Ground(normal=(0, 1, 0), offset=-0.052)], "contact": contact}


#: A body and options of its simulation.
BODIES = {
    "coarse": lambda rng, device: (box((3, 1, 1), 3, device), {}),
    "fine": lambda rng, device: (box((1, 1, 1), 6, device), {}),
    "thin": lambda rng, device: (box((4, 1, 4), 1, device), {}),
    "wire": lambda rng, device: (box((8, 1, 1), 2, device), {}),
    "adaptive": adaptive,
    "labelled": labelled,
    "remeshed": remeshed,
    "strained": strained,
    "touching": stuck,
    "ring": lambda rng, device: (held(wc.SoftBody(ring_mesh(), tissue(poisson=0.47), device=device)), {}),
    "file": lambda rng, device: (held(wc.SoftBody(file_mesh(), tissue(), device=device)), {"model": wc.NeoHookean()}),
    "implicit": lambda rng, device: (box((2, 1, 1), 4, device), {"integrator": wc.BackwardEuler(dt=0.004)}),
}


def momentum(body):
    """Mass and momentum in float64, and the sum of the momenta's sizes."""
    arrays, count = body.changing.forest.carriage.arrays, body.node_count
    mass = arrays.mass.numpy()[:count]
    p = mass[:, None] * arrays.v.numpy()[:count, :3].astype(float)
    return mass.sum(), p.sum(axis=0), np.abs(p).sum() + 1e-9


class RandomBlades:
    """One of the twelve bodies, and a bent blade that goes through it along one random path after another.

    Args:
        name: The body's.
        seed: Of everything that is random.
        device: The device.
    """

    def __init__(self, name, seed, device):
        self.rng = rng = np.random.default_rng([seed, list(BODIES).index(name)])
        self.body, options = BODIES[name](rng, device)
        self.low, self.high = self.body.mesh.points.min(axis=0), self.body.mesh.points.max(axis=0)
        self.centre, self.reach = 0.5 * (self.low + self.high), 0.5 * np.linalg.norm(self.high - self.low)
        edge = np.column_stack([0.1 * self.reach * rng.normal(size=(3, 2)), np.linspace(-1, 1, 3) * self.reach])
        refined = name in ("coarse", "thin") and rng.random() < 0.5
        self.blade = wc.Blade(edge, level=4 if refined else None, speed=SPEED, position=self.centre + 5 * self.reach)
        options = {"gravity": 2.0 * rng.normal(size=3), "integrator": wc.SymplecticEuler(damping=20.0)} | options
        # The longest motion of a path is known before the simulation divides it.
        self.path(0.0)
        self.sim = wc.Simulation(self.body, cuts=[self.blade], **options)
        self.volume, self.mass = self.body.mesh.volumes.sum(), momentum(self.body)[0]
        self.has_surface = self.body.mesh.fill is not None
        self.inside = self._inside()
        # Meshes of domains may have elements that hang on others.
        self.hung = hung(self.body.mesh.tets, face_table(self.body.mesh.tets))
        blades = self.sim.blades
        self._cut, blades.cut = blades.cut, self._watched

    def path(self, start):
        """A path that crosses the body from one side to another, turning."""
        places = self.rng.normal(size=(3, 3))
        places[1] *= 0.3
        places /= np.maximum(np.linalg.norm(places, axis=1, keepdims=True), 1.0)
        turns = self.rng.normal(size=4) + self.rng.normal(size=(3, 4)) * [[0.0], [0.2], [0.3]]
        positions = self.centre + 1.2 * self.reach * places
        trial = self.blade.released()
        trial.follow([0.0, 1.0, 2.0], positions, turns)
        self.moves = 2.0 * trial.fastest() / SPEED
        self.blade.follow(start + np.linspace(0.0, self.moves, 3), positions, turns)

    def run(self):
        """Let the blade go through one path, and check the body."""
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            self.sim.advance(self.moves + RESTS)
        self.check()

    def again(self):
        """Take the next path, on which the blade begins elsewhere."""
        self.path(self.sim.time)

    def check(self):
        mesh = assert_cut_sound(self.body.changing.forest, hung_before=self.hung)
        x = self.body.positions.numpy().astype(float)
        assert np.isfinite(x).all()
        assert len(np.unique(np.sort(mesh.tets, axis=1), axis=0)) == len(mesh.tets)
        edges = np.swapaxes(x[mesh.tets[:, 1:]] - x[mesh.tets[:, :1]], 1, 2)
        rest = np.swapaxes(mesh.points[mesh.tets[:, 1:]] - mesh.points[mesh.tets[:, :1]], 1, 2)
        growth = np.linalg.det(edges) / np.linalg.det(rest)
        assert growth.min() > 0.0, f"{(growth <= 0).sum()} inverted elements"
        np.testing.assert_allclose(mesh.volumes.sum(), self.volume, rtol=1e-9)
        np.testing.assert_allclose(momentum(self.body)[0], self.mass, rtol=1e-9)
        if self.has_surface:
            np.testing.assert_allclose(self._inside(), self.inside, rtol=1e-3)

    def _inside(self):
        """The volume that the surface has inside, without moves of its points to cuts; both are closed."""
        if not self.has_surface:
            return 0.0
        mesh = self.body.mesh
        assert_closed(mesh.surface().triangles)
        surface = replace(mesh, snap=None).surface()
        assert_closed(surface.triangles)
        a, b, c = np.moveaxis(surface.points[surface.triangles].astype(float), 1, 0)
        return np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0

    def _watched(self):
        """Cut, and check that mass and momentum stay what they are."""
        impulse = support_impulse(self.body.changing.forest)
        before = momentum(self.body)
        changed = self._cut()
        after = momentum(self.body)
        np.testing.assert_allclose(after[0], before[0], rtol=1e-12)
        impulse = support_impulse(self.body.changing.forest) - impulse
        np.testing.assert_allclose(after[1] - impulse, before[1], atol=1e-6 * before[2])
        return changed
