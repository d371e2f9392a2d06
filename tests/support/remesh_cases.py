"""Changing forests for tests, and what must hold for them after every pass."""

import itertools

import numpy as np
import pytest
import warp as wp
from plan_oracle import shape_codes
from sequential import Bisection

from warp_corot.discretization.changing import passes
from warp_corot.discretization.changing.pools import CARRIED_BY_NODES, DeviceForest, PassCounts
from warp_corot.discretization.sizes import padded
from warp_corot.kernels.remesh import pools
from warp_corot.kernels.tables.shapes import FRAME_SHIFT
from warp_corot.mesh.lattice import LATTICE_BITS

CUBE = 0.064
DENSITY = 1000.0
PAIRS = list(itertools.combinations(range(4), 2))


def set_marks(forest, marks):
    """1 for leaves to bisect, -1 for leaves that may be merged, 0 for the others, [T]."""
    whole = np.zeros(len(forest.pools.marks), np.int8)
    whole[: forest.leaf_count] = marks
    forest.pools.marks.assign(whole)


def apply_marks(remesh, marks):
    """Change a mesh by a pass with these marks instead of the criterion."""
    set_marks(remesh.forest, marks)
    remesh.launch(marked=True)


class RemeshPass(passes.RemeshPass):
    """Passes that are recorded once and replayed, by the criterion or by marks."""

    def run(self):
        self._replay(marked=False)

    def apply(self, marks):
        set_marks(self.forest, marks)
        self._replay(marked=True)

    def _replay(self, *, marked):
        if self.device.is_cuda and not wp.is_conditional_graph_supported():
            self.launch(marked=marked)
            return
        graphs = self.__dict__.setdefault("graphs", {})
        if marked not in graphs:
            with wp.ScopedCapture(device=self.device) as capture:
                self.launch(marked=marked)
            graphs[marked] = capture.graph
        wp.capture_launch(graphs[marked])


def free_nodes(device):
    """The number of further nodes for which there is room."""
    return device.node_capacity - device.virtual_count - device.node_count


def free_leaves(device):
    """The number of further leaves for which there is room."""
    return device.count(pools.FREE_PAIRS)


def is_full(device):
    """Whether a refinement was ever left out because the pools were full."""
    return bool(device.count(pools.FULL))


def counts_of(device):
    """The counts after the last pass."""
    return PassCounts.of(device.pools.counts.numpy())


def support_impulse(device):
    """Impulse of the supports in all passes, as mass came to and left held nodes [N s], float64 [3]."""
    return device.carriage.arrays.impulse.numpy()[0]


def leaf_list(forest):
    """Leaves as the sequential reference names them, in the forest's order."""
    corners = (forest.lattice * (Bisection.CUBE >> LATTICE_BITS))[forest.tets].tolist()
    return [(int(n), *map(tuple, points)) for n, points in zip(forest.levels, corners, strict=True)]


def assert_conforming(forest):
    faces = np.concatenate([forest.tets[:, list(face)] for face in itertools.combinations(range(4), 3)])
    faces, count = np.unique(np.sort(faces, axis=1), axis=0, return_counts=True)
    assert count.max() <= 2
    edges = np.unique(np.sort(np.concatenate([forest.tets[:, pair] for pair in PAIRS]), axis=1), axis=0)
    # Midpoints of edges, as keys, are not nodes.
    weights = np.array([1, 1 << 20, 1 << 40])
    nodes = 2 * forest.lattice[: len(forest.points)].astype(np.int64) @ weights
    assert not np.isin(forest.lattice[edges].astype(np.int64).sum(axis=1) @ weights, nodes).any()


def assert_tree(forest):
    """Children are the halves of their parent: by position, independently of the rule that made them."""
    tree = forest.tree
    inner = np.flatnonzero(tree.first_child >= 0)
    assert len(tree.level) == np.count_nonzero(tree.parent < 0) + 2 * len(inner)
    for half in range(2):
        child = tree.first_child[inner] + half
        assert (tree.parent[child] == inner).all()
        assert (tree.level[child] == tree.level[inner] + 1).all()
    x = forest.lattice.astype(float)
    centre = x[tree.tets].mean(axis=1)
    both = centre[tree.first_child[inner]] + centre[tree.first_child[inner] + 1]
    assert np.allclose(both, 2 * centre[inner])
    made = forest.node_ends[:, 0] >= 0
    assert np.array_equal(2 * forest.lattice[made], forest.lattice[forest.node_ends[made]].sum(axis=1))


def assert_sound(device):
    """Check what must hold after every pass; returns the mesh."""
    forest = device.to_forest()
    source = device.source
    assert_conforming(forest)
    assert_tree(forest)
    assert forest.volumes.sum() == pytest.approx(source.volumes.sum(), rel=1e-12)
    # Leaves are in tree order, and export keeps them and the numbers of nodes.
    assert np.array_equal(device.leaf_tets, device.pools.tets.numpy()[device.leaf_elements])
    assert np.array_equal(forest.tets, device.leaf_tets)
    assert_balanced(device)
    assert_padding(device)
    assert_codes(device)
    assert_carriage(device, forest)
    return forest


def assert_balanced(device):
    """Nodes of leaves are the first ones; no element is without its parent, and nothing is lost from the pools."""
    tree, used = device.tree()
    count, limit = device.node_count, device.node_capacity - device.virtual_count
    assert np.array_equal(np.unique(device.leaf_tets), np.arange(count))
    assert free_nodes(device) == limit - count
    valence = device.pools.valence.numpy()
    names = np.bincount(tree.tets[tree.first_child < 0].ravel(), minlength=device.node_capacity)
    assert np.array_equal(names, valence)
    assert np.array_equal(np.flatnonzero(valence), device.nodes_in_use)
    # A parent's nodes have the same names in its children.
    inner = tree.first_child[tree.first_child >= 0]
    below = np.concatenate([tree.tets[inner], tree.tets[inner + 1]], axis=1)
    assert (tree.tets[tree.first_child >= 0][:, :, None] == below[:, None, :]).any(axis=2).all()
    pairs = device.pools.free_pairs.numpy()[: free_leaves(device)]
    unused = np.setdiff1d(np.arange(device.pools.roots, device.tree_capacity), used)
    assert np.array_equal(np.sort(np.concatenate([pairs, pairs + 1])), unused)


def assert_padding(device):
    """Beyond the counts nothing has a mass or moves."""
    tets, count = device.pools.leaf_tets.numpy(), device.leaf_count
    assert len(tets) == device.capacity + 1024
    sinks = device.node_capacity + np.arange(count, len(tets)) % 1024
    assert (tets[count:] == sinks[:, None]).all()
    for name in CARRIED_BY_NODES:
        array = getattr(device.carriage.arrays, name).numpy()
        assert len(array) == device.node_capacity + 1024
        assert (array[device.node_count :] == (-1 if name == "row" else 0)).all(), name


def assert_codes(device):
    """Every tetrahedron's code equals that from its nodes' positions: level, handedness and frame."""
    tree, used = device.tree()
    expected, frames = shape_codes(device.pools.lattice.numpy(), tree.tets, tree.level)
    code = device.pools.code.numpy()[used]
    low = (1 << FRAME_SHIFT) - 1
    assert np.array_equal(code & low, expected & low)
    found = device.pools.frames.numpy()[code >> FRAME_SHIFT]
    assert np.allclose(found, frames[expected >> FRAME_SHIFT], atol=1e-7)


def assert_carriage(device, forest):
    """Rest positions are those of the mesh, and lumped masses those of the leaves' densities."""
    arrays = device.carriage.arrays
    count = device.node_count
    assert np.allclose(
        arrays.rest.numpy()[:count, :3], forest.points, rtol=1e-7, atol=1e-7 * np.abs(forest.points).max()
    )
    quarter = 0.25 * arrays.density.numpy()[device.leaf_elements] * forest.volumes
    masses = np.zeros(count)
    np.add.at(masses, device.leaf_tets, quarter[:, None])
    assert np.allclose(arrays.mass.numpy()[:count], masses, rtol=1e-9, atol=1e-12 * masses.max())
    held = arrays.held.numpy()[:count] != 0
    free = (masses > 0) & ~held
    expected = np.divide(1.0, masses, where=free, out=np.zeros_like(masses))
    assert np.allclose(arrays.mass32.numpy()[:count], masses, rtol=1e-6, atol=1e-12 * masses.max())
    assert np.allclose(arrays.inverse_mass.numpy()[:count], expected, rtol=1e-6)
    assert (arrays.row.numpy()[:count][~held] == -1).all()


def momentum(device):
    """Linear momentum, and the sum of the magnitudes of its terms."""
    arrays = device.carriage.arrays
    p = arrays.mass.numpy()[:, None] * arrays.v.numpy()[:, :3].astype(float)
    return p.sum(axis=0), np.abs(p).sum()


def set_nodes(carriage, **given):
    """Set displacements, velocities and loads, [n, 3], and held and rows, [n], of the first nodes."""
    names = {"displacements": "u", "velocities": "v", "loads": "load", "held": "held", "rows": "row"}
    for name, values in given.items():
        array, values = getattr(carriage.arrays, names[name]), np.asarray(values)
        whole = array.numpy().copy()
        whole[: len(values)] = padded(values.astype(np.float64)) if values.ndim == 2 else values
        array.assign(whole)
    if "held" in given:
        carriage.update_inverse_mass()


def moving(forest, device, rng, **options):
    """A forest on the device with random displacements and velocities."""
    made = DeviceForest(forest, options.pop("capacity", 20000), density=options.pop("density", DENSITY), device=device)
    n = len(forest.points)
    shape = (n, 3)
    set_nodes(made.carriage, displacements=1e-3 * rng.normal(size=shape), velocities=rng.normal(size=shape), **options)
    return made


def random_marks(device, rng, refine, simplify):
    """Random fractions of the leaves: those nearest to a random point may be merged, scattered ones are bisected.

    All leaves around a node must be marked for its removal, which scattered ones hardly ever are.
    """
    mesh = device.to_forest()
    centre = mesh.points[mesh.tets].mean(axis=1)
    distance = np.linalg.norm(centre - rng.choice(centre), axis=1)
    marks = np.where(rng.random(len(centre)) < refine, 1, 0)
    marks[distance <= np.quantile(distance, simplify)] = -1
    return np.where(rng.random(len(centre)) < 0.01, 0, marks)
