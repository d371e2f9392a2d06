"""The mesh and state that are timed, and float64 references for a random sample of it.

A node's exact force needs only the elements around it. So the oracle of the test suite is evaluated on the elements
around a thousand random nodes, which costs the same at any size of the mesh.
"""

from __future__ import annotations

import sys
from functools import cached_property
from pathlib import Path

import numpy as np
import warp as wp

import warp_corot as wc

sys.path.append(str(Path(__file__).resolve().parent.parent / "tests" / "support"))
try:
    import oracle
except ImportError as error:
    sys.exit(
        "benchmarks check every result against tests/support/oracle.py, "
        f"which needs {error.name}: pip install {error.name}"
    )

#: Nodal displacements are uniform up to this fraction of the edge length, in both directions along each axis.
JITTER = 0.05
SAMPLE_NODES = 1000
#: Poisson's ratio is just below the value from which elements share their dilatation by default.
MATERIAL = {"young": 1e6, "poisson": 0.44, "density": 1000.0}

#: Levels of the subtrees that are computed together, and of groups of eight of them.
SUBTREE_LEVELS = 3
GROUP_LEVELS = 6


def relative_error(found: np.ndarray, reference: np.ndarray) -> float:
    """Largest error over the largest reference value; infinite if anything found is not finite."""
    if not np.isfinite(found).all():
        return float("inf")
    return float(np.abs(found - reference).max() / np.abs(reference).max())


def padded(vectors: np.ndarray) -> np.ndarray:
    """Nodal vectors [N, 3] as the float32 [N, 4] of the device."""
    return np.concatenate([vectors, np.zeros((len(vectors), 1), np.float32)], axis=1)


def drawn_nodes(count: int, wanted: int, seed: int = 1) -> np.ndarray:
    """About ``wanted`` of ``count`` nodes, or all."""
    drawn = np.random.default_rng(seed).integers(0, count, wanted)
    return np.unique(drawn) if count > wanted else np.arange(count)


class Sample:
    """Some nodes with all the elements around them.

    Attributes:
        nodes: Drawn nodes of the whole mesh [n].
        elements: Elements of the whole mesh with at least one of them [m].
        used: Nodes of the whole mesh in these elements.
        mesh: These elements in float64, as a mesh of the used nodes.
        rows: Positions of the drawn nodes in ``used`` [n].
    """

    def __init__(self, points: np.ndarray, tets: np.ndarray, seed: int = 1, nodes: np.ndarray | None = None):
        count = len(points)
        self.nodes = drawn_nodes(count, SAMPLE_NODES, seed) if nodes is None else np.unique(nodes)
        drawn = np.zeros(count, bool)
        drawn[self.nodes] = True
        self.elements = np.flatnonzero(drawn[tets].any(axis=1))
        self.used, local = np.unique(tets[self.elements], return_inverse=True)
        self.mesh = oracle.Mesh(points[self.used], local.reshape(-1, 4))
        self.rows = np.searchsorted(self.used, self.nodes)

    def forces(self, model: str, x: np.ndarray, mu: float, lam: float, **options) -> np.ndarray:
        """Nodal forces [n, 3] of a model of the oracle at positions x [N, 3] of the whole mesh."""
        return oracle.evaluate(model, self.mesh, x[self.used], mu, lam, **options)[1][self.rows]

    def masses(self, density: float) -> np.ndarray:
        """Lumped masses [n]."""
        return self.mesh.masses(density)[self.rows]


class Problem:
    """One root cube bisected to a level, with its nodes moved at random.

    Attributes:
        mesh: The forest.
        u: Displacements, float32 [N, 3]; x: deformed positions, float64 [N, 3].
        body: The forest as a body in that state.
        mu, lam: Lamé's parameters [Pa].
    """

    def __init__(self, level: int, device: wp.Device):
        self.device = device
        self.level = level
        self.mesh = wc.TetForest.box((1, 1, 1), 1.0, level)
        self.edge = self.mesh.cell_size / 2 ** (level // 3)
        rng = np.random.default_rng(0)
        self.u = (JITTER * self.edge * rng.uniform(-1.0, 1.0, self.mesh.points.shape)).astype(np.float32)
        self.x = self.mesh.points + self.u.astype(np.float64)
        self.material = wc.Isotropic(**MATERIAL)
        self.mu, self.lam = (float(value) for value in oracle.lame(MATERIAL["young"], MATERIAL["poisson"]))
        self.body = self.new_body(self.mesh)

    def new_body(self, mesh: wc.TetForest | wc.TetMesh) -> wc.SoftBody:
        body = wc.SoftBody(mesh, self.material, device=self.device)
        body.displacements = self.u
        return body

    @cached_property
    def held(self) -> np.ndarray:
        """Nodes that steps keep fixed, those on the floor; bool [N]."""
        return self.mesh.points[:, 2] < 1e-9

    @property
    def tet_count(self) -> int:
        return len(self.mesh.tets)

    @property
    def node_count(self) -> int:
        return len(self.mesh.points)

    @property
    def nodes_per_tet(self) -> float:
        return self.node_count / self.tet_count

    @cached_property
    def sample(self) -> Sample:
        return Sample(self.mesh.points, self.mesh.tets)

    @cached_property
    def general_body(self) -> wc.SoftBody:
        """The same elements as a general mesh: rest matrices, no shapes."""
        return self.new_body(wc.TetMesh(self.mesh.points, self.mesh.tets))

    def subtree_nodes(self, levels: int) -> np.ndarray:
        """The nodes of each complete subtree of this many levels, int32 [T / 2**levels, 10 or 35 or 37]."""
        # Leaves are in tree order, so those of a subtree are contiguous.
        nodes = np.sort(self.mesh.tets.reshape(-1, 4 << levels), axis=1)
        first = np.ones(nodes.shape, bool)
        first[:, 1:] = nodes[:, 1:] != nodes[:, :-1]
        return nodes[first].reshape(len(nodes), -1)

    def units(self, levels_up: int) -> tuple[np.ndarray, np.ndarray]:
        """The ancestors this many levels up: indices into the tree [n], and each element's index among them, int32
        [T]."""
        if levels_up == 0:
            return self.mesh.tree.leaves, np.arange(self.tet_count, dtype=np.int32)
        units, unit = np.unique(self.mesh.ancestors(self.level - levels_up), return_inverse=True)
        return units, unit.ravel().astype(np.int32)

    def rotations_of(self, tets: np.ndarray) -> np.ndarray:
        """Rotations [n, 3, 3] of a few tetrahedra [n, 4], leaves or not, in float64."""
        used, local = np.unique(tets, return_inverse=True)
        mesh = oracle.Mesh(self.mesh.points[used], local.reshape(-1, 4))
        return oracle.polar(mesh.deformation_gradients(self.x[used]))

    def shared_rotations(self, levels_up: int) -> np.ndarray:
        """The ancestor's rotation for each element of the sample [m, 3, 3]."""
        leaves = self.mesh.tree.leaves[self.sample.elements]
        ancestors = self.mesh.tree.ancestors(leaves, self.level - levels_up)
        return self.rotations_of(self.mesh.tree.rows(ancestors)[0])
