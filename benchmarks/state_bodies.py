"""Bodies and the states in which forces are timed, each made by physics or by a given map.

Physics is the library's own corotated model from rest, at a fixed step well below the stable one. Meshes that
are too large to step use the state of a coarser mesh of the same body, interpolated in its elements.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import paper_beam as paper
import warp as wp
from measure import kind

import warp_corot as wc

#: A soft tissue whose elements have a dilatation each by default; Young's modulus [Pa], density [kg/m^3]. From a
#: Poisson's ratio of 0.45 on elements share it.
MATERIAL = {"young": 5e3, "poisson": 0.44, "density": 1000.0}
GRAVITY = (0.0, -9.81, 0.0)
#: Time of motion before bodies are measured [s].
LOADED_SECONDS = 0.5
#: Duration of pulling [s].
PULLED_SECONDS = 0.25
#: Displacements beyond this many lengths are invalid.
FARTHEST = 10.0
#: Steps are tried in this order, as fractions of the default one.
SHARES = (0.5, 0.25, 0.1)
#: Largest number of elements of bodies that are stepped.
STEPPED_ELEMENTS = {"cuda": 700_000, "cpu": 30_000}

#: Fraction of subtrees with a flat or inverted leaf in that state.
BAD = 0.1

#: Cube levels of organs, as on the command line.
ORGAN_LEVEL = 7
#: Root cubes across the graded ball.
GRADED_CUBES = 16


#: Makes a state of a body: its description, and displacements [N, 3].
Maker = Callable[["Subject", wp.Device], tuple[str, np.ndarray]]


@dataclass
class State:
    """Displacements of a body's nodes.

    Attributes:
        name: Name in the table.
        how: How it was made.
        u: float32 [N, 3] [m].
    """

    name: str
    how: str
    u: np.ndarray


@dataclass
class Subject:
    """A body and its states.

    Attributes:
        name: Name in the table.
        mesh: A forest.
        held: Fixed nodes, bool [N].
        states: Names of its states, keys of MAKERS, without "at rest".
        coarser: Makes the same body with about an eighth of the elements.
        pulled: Nodes that are pulled along z in the state "pulled", bool [N].
        worlds: Number of copies.
        poisson: Poisson's ratio.
    """

    name: str
    mesh: wc.TetForest
    held: np.ndarray
    states: tuple[str, ...]
    coarser: Callable[[], Subject] | None = None
    pulled: np.ndarray | None = None
    worlds: int = 1
    poisson: float = MATERIAL["poisson"]

    @property
    def material(self) -> dict[str, float]:
        """Young's modulus [Pa], Poisson's ratio and density [kg/m^3]."""
        return MATERIAL | {"poisson": self.poisson}

    @property
    def points(self) -> np.ndarray:
        return self.mesh.points

    @cached_property
    def length(self) -> float:
        """Largest extent [m]."""
        return float(np.ptp(self.points, axis=0).max())

    def edges(self, elements: np.ndarray | slice, u: np.ndarray | float = 0.0) -> np.ndarray:
        """x1 - x0, x2 - x0, x3 - x0 of elements under displacements, as columns; float64 [n, 3, 3] [m]."""
        corners = (self.points + u)[self.mesh.tets[elements]]
        return np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)

    def deformation_gradients(self, elements: np.ndarray, u: np.ndarray) -> np.ndarray:
        """F [n, 3, 3]."""
        return self.edges(elements, u) @ np.linalg.inv(self.edges(elements))

    def gradients(self, elements: np.ndarray) -> np.ndarray:
        """Hat functions' gradients [n, 4, 3] [1/m]."""
        inverse = np.linalg.inv(self.edges(elements))
        return np.concatenate([-inverse.sum(1, keepdims=True), inverse], axis=1)

    def volume_ratios(self, u: np.ndarray) -> np.ndarray:
        """det F of all elements [T]."""
        return np.linalg.det(self.edges(slice(None), u)) / np.linalg.det(self.edges(slice(None)))

    def all_states(self, device: wp.Device) -> Iterator[State]:
        """At rest, then the other states in turn."""
        yield State("at rest", "-", np.zeros_like(self.points, dtype=np.float32))
        for name in self.states:
            how, u = MAKERS[name](self, device)
            yield State(name, how, u.astype(np.float32))


# --- bodies -----------------------------------------------------------------------------------------------------------


def beam(level: int, worlds: int = 1) -> Subject:
    """The paper's beam, fixed at one end."""
    mesh = wc.TetForest.box(paper.CELLS, paper.CELL_SIZE, level)
    states = ("under its weight", "falling", "twisted by pi", "stretched to 1.8", "squeezed to 0.5")
    name = f"beam {level}" if worlds == 1 else f"{worlds} beams {level}"
    chosen = states if worlds == 1 else states[:1]
    return Subject(name, mesh, mesh.points[:, 2] < 1e-9, chosen, lambda: beam(level - 3, worlds), worlds=worlds)


def notched_beam(level: int) -> Subject:
    """The beam with a slot 8 mm wide and two thirds deep across its middle, for pulling."""
    size = np.array(paper.CELLS) * paper.CELL_SIZE
    across, middle = float(size[0]), size[2] / 2
    whole = wc.Domain.box((0.0, 0.0, 0.0), size.tolist(), device="cpu")
    slot = wc.Domain.box(
        (-0.01, across / 3, middle - 0.004), (across + 0.01, across + 0.01, middle + 0.004), device="cpu"
    )
    mesh = wc.TetForest.from_domain(whole - slot, paper.CELL_SIZE, max_level=level, min_level=level - 3)
    z = mesh.points[:, 2]
    return Subject(
        f"notched beam {level}",
        mesh,
        z < 1e-9,
        ("pulled",),
        lambda: notched_beam(level - 3),
        pulled=z > size[2] - 1e-9,
    )


def cube(level: int) -> Subject:
    """One root cube of 64 mm, with its floor fixed."""
    mesh = wc.TetForest.box((1, 1, 1), paper.CELL_SIZE, level)
    states = ("one leaf turned over", "all leaves turned over", "a tenth of subtrees bad")
    return Subject(f"cube {level}", mesh, mesh.points[:, 1] < 1e-9, states)


def organ(name: str, count: int, worlds: int = 1) -> Subject:
    """A ball of 10 cm or the bunny, with about this many elements, its lowest tenth fixed."""
    domain = wc.Domain.sphere(0.05) if name == "ball" else wc.Domain.from_surface("warp:bunny")
    size = float(np.ptp(domain.bounds, axis=0).max()) * 1.001 / max(1, round((count / 30) ** (1 / 3)))
    level = ORGAN_LEVEL + (count > 300_000)
    mesh = wc.TetForest.from_domain(domain, size, max_level=level, target_elements=count)
    y = mesh.points[:, 1]
    states = ("under its weight", "a tenth of subtrees bad")
    held = y < y.min() + 0.1 * np.ptp(y)
    title = f"{name} {len(mesh.tets)}" if worlds == 1 else f"{worlds} {name}s {len(mesh.tets)}"
    return Subject(title, mesh, held, states, lambda: organ(name, count // 8, worlds), worlds=worlds)


def graded_ball(level: int) -> Subject:
    """A ball of 10 cm, its lowest tenth fixed, with leaves of this level at its surface and larger ones inside."""
    mesh = wc.TetForest.from_domain(wc.Domain.sphere(0.05), 0.1001 / GRADED_CUBES, max_level=level)
    y = mesh.points[:, 1]
    states = ("under its weight", "a tenth of subtrees bad")
    return Subject(
        f"graded ball {len(mesh.tets)}", mesh, y < y.min() + 0.1 * np.ptp(y), states, lambda: graded_ball(level - 3)
    )


# --- states by physics ------------------------------------------------------------------------------------------------


def new_body(subject: Subject, device: wp.Device) -> wc.SoftBody:
    """One copy with its fixed nodes."""
    body = wc.SoftBody(subject.mesh, wc.Isotropic(**subject.material), device=device, threads=1)
    body.fix(subject.held)
    return body


def _physics(
    seconds: float, damping: float = 0.0, prepare: Callable[[Subject, wc.SoftBody], None] | None = None
) -> Maker:
    """The state of a body, or of a coarser one, interpolated, after this time."""

    def make(subject: Subject, device: wp.Device) -> tuple[str, np.ndarray]:
        if subject.coarser is None or len(subject.mesh.tets) <= STEPPED_ELEMENTS[kind(device)]:
            return move(subject, device)
        coarse = dataclasses.replace(subject.coarser(), poisson=subject.poisson)
        how, u = make(coarse, device)
        elements, weights = coarse.mesh.embed(subject.points)
        found = np.einsum("na,nai->ni", weights, u[coarse.mesh.tets[elements]].astype(float))
        return how if "from" in how else f"{how}, from {coarse.name}", found

    def move(subject: Subject, device: wp.Device) -> tuple[str, np.ndarray]:
        default = wc.Simulation(new_body(subject, device), gravity=GRAVITY).dt
        for share in SHARES:
            body = new_body(subject, device)
            if prepare is not None:
                prepare(subject, body)
            sim = wc.Simulation(body, integrator=wc.SymplecticEuler(share * default, damping), gravity=GRAVITY)
            try:
                sim.advance(seconds)
            except wc.UnstableError:
                continue
            u = body.displacements.numpy()
            if np.abs(u).max() < FARTHEST * subject.length:
                return f"{seconds:g} s, {share:g} of the default step", u
        raise RuntimeError(f"{subject.name}: no step of {SHARES} times the default one goes well")

    return make


def _pull(subject: Subject, body: wc.SoftBody) -> None:
    """Move one end away by three tenths of the length."""
    away = [0.0, 0.0, 0.3 * subject.length]
    body.prescribe(subject.pulled, times=[0.0, PULLED_SECONDS], displacements=np.array([[0.0, 0.0, 0.0], away]))


def _falling(subject: Subject, device: wp.Device) -> tuple[str, np.ndarray]:
    """Fall from rest until the wave from the support has passed half of the layers of elements."""
    layers = len(np.unique(np.round(subject.points[:, 2] / subject.length, 9)))
    body = new_body(subject, device)
    wc.Simulation(body, gravity=GRAVITY).advance_steps(max(layers // 2, 1))
    return f"{max(layers // 2, 1)} steps", body.displacements.numpy()


# --- states by maps ---------------------------------------------------------------------------------------------------


def _mapped(matrix: Callable[[np.ndarray], np.ndarray], how: str) -> Maker:
    """Move every cross-section by the matrix [n, 3, 3] for its position along z [n], from 0 to 1."""

    def make(subject: Subject, device: wp.Device) -> tuple[str, np.ndarray]:
        x = subject.points
        middle = 0.5 * (x.min(axis=0) + x.max(axis=0)) * [1.0, 1.0, 0.0]
        return how, np.einsum("nij,nj->ni", matrix(x[:, 2] / subject.length), x - middle) + middle - x

    return make


def _twist(angle: float) -> Callable[[np.ndarray], np.ndarray]:
    def matrix(z: np.ndarray) -> np.ndarray:
        c, s, o = np.cos(angle * z), np.sin(angle * z), np.zeros_like(z)
        return np.moveaxis(np.array([[c, -s, o], [s, c, o], [o, o, o + 1]]), -1, 0)

    return matrix


def _stretch(*factors: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda z: np.broadcast_to(np.diag(factors), (len(z), 3, 3))


def _all_turned(subject: Subject, device: wp.Device) -> tuple[str, np.ndarray]:
    return "x by -0.6, y by 1.1, z by 1.3", subject.points * [-1.6, 0.1, 0.3]


def _one_turned(subject: Subject, device: wp.Device) -> tuple[str, np.ndarray]:
    """A corner of the body with few elements, moved so that exactly one of them is inverted."""
    tets, u = subject.mesh.tets, np.zeros_like(subject.points)
    valence = np.bincount(tets.ravel(), minlength=len(u))
    node = int(np.argmin(np.where(valence > 0, valence, np.iinfo(int).max)))
    rows, corners = np.nonzero(tets == node)
    g = subject.gradients(rows)[np.arange(len(rows)), corners]
    # Of the moves that take its first element to det F = -1/4, the shortest that does not invert the others.
    tried = np.random.default_rng(0).standard_normal((4000, 3))
    tried *= (-1.25 / (tried @ g[0]))[:, None]
    ratios = np.sort(1 + tried @ g.T, axis=1)
    fine = tried[(ratios[:, 1:] > 0.5).all(axis=1)]
    u[node] = fine[np.argmin(np.linalg.norm(fine, axis=1))]
    return "a corner moved", u


def _tenth_bad(subject: Subject, device: wp.Device) -> tuple[str, np.ndarray]:
    """Random nodes, each moved so far that one of its elements is flat or inverted, until a tenth of the
    subtrees of three levels have such an element."""
    tets = subject.mesh.tets
    rng = np.random.default_rng(0)
    order = rng.permutation(len(tets))
    nodes, first = np.unique(tets[order].ravel(), return_index=True)
    element, corner = order[first // 4], first % 4
    g = subject.gradients(element)[np.arange(len(nodes)), corner]
    far = -np.where(rng.random(len(nodes)) < 0.5, 1.0, 1.3) / np.sum(g**2, axis=1)
    moves = np.zeros_like(subject.points)
    moves[nodes] = far[:, None] * g
    drawn = np.full(len(moves), 2.0)
    drawn[nodes] = rng.random(len(nodes))
    _, subtree = np.unique(_three_up(subject.mesh), return_inverse=True)
    subtree = subtree.ravel()
    share = 0.02
    for _ in range(12):
        u = np.where(drawn[:, None] < share, moves, 0.0)
        bad = np.bincount(subtree, subject.volume_ratios(u) < 0.05) > 0
        if abs(bad.mean() - BAD) < 0.1 * BAD:
            break
        share *= math.log(1 - BAD) / math.log(1 - min(bad.mean(), 0.9)) if bad.any() else 2.0
    return f"{bad.mean():.3f} of subtrees", u


def _three_up(mesh: wc.TetForest) -> np.ndarray:
    """The ancestor three levels above each leaf, or the root."""
    found, leaves = mesh.tree.leaves.copy(), mesh.tree.leaves
    for steps in (1, 2, 3):
        above = mesh.tree.above(leaves, steps)
        found = np.where(above >= 0, above, found)
    return found


MAKERS: dict[str, Maker] = {
    "under its weight": _physics(LOADED_SECONDS),
    "falling": _falling,
    "twisted by pi": _mapped(_twist(math.pi), "map"),
    "stretched to 1.8": _mapped(_stretch(1.8**-0.5, 1.8**-0.5, 1.8), "map, det F = 1"),
    "squeezed to 0.5": _mapped(_stretch(2**0.5, 2**0.5, 0.5), "map, det F = 1"),
    "pulled": _physics(PULLED_SECONDS, 20.0, _pull),
    "one leaf turned over": _one_turned,
    "all leaves turned over": _all_turned,
    "a tenth of subtrees bad": _tenth_bad,
}
