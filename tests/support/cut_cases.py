"""What must hold for a forest on the device after every cut, found independently of the kernels that cut."""

import numpy as np
from remesh_cases import assert_padding
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from warp_corot.mesh.topology import boundary_faces

FACES = [[m for m in range(4) if m != n] for n in range(4)]


def face_table(tets):
    """The two leaves and their local faces at each inner face, [m, 2, 2]; faces are equal if their nodes are."""
    nodes = np.sort(tets[:, FACES], axis=2).reshape(-1, 3)
    _, number, count = np.unique(nodes, axis=0, return_inverse=True, return_counts=True)
    assert count.max() <= 2
    order = np.argsort(number.ravel(), kind="stable")
    inner = np.flatnonzero(np.diff(number.ravel()[order]) == 0)
    both = np.stack([order[inner], order[inner + 1]], axis=1)
    return np.stack([both // 4, both % 4], axis=2)


def star_components(tets, pairs):
    """A component for each corner of each leaf, [T, 4]: those of one node joined by these inner faces."""
    (a, face_a), (b, _) = np.moveaxis(pairs, 0, 2)
    here = np.array(FACES)[face_a]
    there = (tets[a[:, None], here][:, :, None] == tets[b][:, None, :]).argmax(axis=2)
    links = np.stack([4 * a[:, None] + here, 4 * b[:, None] + there], axis=2).reshape(-1, 2)
    graph = coo_array((np.ones(len(links)), links.T), shape=(tets.size, tets.size))
    return connected_components(graph, directed=False)[1].reshape(tets.shape)


def hung(tets, pairs):
    """How many groups of leaves, joined by these inner faces, hang on nodes and edges of others."""
    component = star_components(tets, pairs)
    groups = np.unique(np.stack([tets.ravel(), component.ravel()], axis=1), axis=0)
    return len(groups) - len(np.unique(tets))


def assert_cut_sound(device, *, lone=False, hung_before=0):
    """Check a cut forest; returns its mesh."""
    tets, leaves = device.leaf_tets, device.leaf_elements
    pools, arrays = device.pools, device.carriage.arrays
    cut = pools.cut.numpy()
    faces = face_table(tets)
    bits = (cut[leaves][:, None] >> np.arange(4)) % 2 == 1
    at = [bits[faces[:, k, 0], faces[:, k, 1]] for k in range(2)]
    np.testing.assert_array_equal(*at)  # both leaves of a face know that it is cut
    whole = faces[~at[0]]
    # Every node has one component of leaves joined by uncut faces: nothing hangs on a node or an edge.
    assert hung(tets, whole) <= hung_before
    np.testing.assert_array_equal(np.unique(tets), np.arange(device.node_count))
    if not lone:
        graph = coo_array((np.ones(len(whole)), whole[:, :, 0].T), shape=(len(tets),) * 2)
        assert np.bincount(connected_components(graph, directed=False)[1]).min() > 1
    # Pools.
    np.testing.assert_array_equal(tets, pools.tets.numpy()[leaves])
    tree, _ = device.tree()
    names = np.bincount(tree.tets[tree.first_child < 0].ravel(), minlength=device.node_capacity)
    np.testing.assert_array_equal(names, pools.valence.numpy())
    assert_ancestors(tree)
    assert_padding(device)
    # What nodes carry.
    mesh = device.to_forest()
    masses = np.zeros(device.node_count)
    quarter = 0.25 * arrays.density.numpy()[leaves] * mesh.volumes
    np.add.at(masses, tets, quarter[:, None])
    np.testing.assert_allclose(arrays.mass.numpy()[: len(masses)], masses, rtol=1e-9)
    np.testing.assert_allclose(arrays.mass32.numpy()[: len(masses)], masses, rtol=1e-6)
    free = arrays.held.numpy()[: len(masses)] == 0
    expected = np.where(free, 1.0 / masses, 0.0)
    np.testing.assert_allclose(arrays.inverse_mass.numpy()[: len(masses)], expected, rtol=1e-6)
    np.testing.assert_allclose(arrays.rest.numpy()[: len(masses), :3], mesh.points, rtol=1e-6, atol=1e-7)
    assert_closed(boundary_faces(mesh.tets, mesh.points)[0])
    return mesh


def assert_ancestors(tree):
    """An ancestor has the corners of certain leaves; it is torn if two leaves below name different nodes at a place."""
    inner = np.flatnonzero(tree.first_child >= 0)
    cut = np.zeros(len(tree.level), int) if tree.cut is None else tree.cut
    torn = np.zeros(len(tree.level), bool)
    for level in np.unique(tree.level[inner])[::-1]:
        above = inner[tree.level[inner] == level]
        first = tree.first_child[above]
        k = 3 - level % 3
        a, b = tree.tets[first], tree.tets[first + 1]
        corners = a.copy()
        corners[:, k] = b[:, k - 1]
        np.testing.assert_array_equal(tree.tets[above], corners)
        differ = [a[:, n] != b[:, n - 1 if n < k else n] for n in range(1, 4)]
        torn[above] = torn[first] | torn[first + 1] | np.any(differ, axis=0)
    np.testing.assert_array_equal(cut[inner] >= 16, torn[inner])


def assert_closed(triangles):
    """A surface is closed and wound consistently: every edge is passed as often each way."""
    edges = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2).astype(np.int64)
    ways = np.where(edges[:, 0] < edges[:, 1], 1, -1)
    edges.sort(axis=1)
    _, number = np.unique(edges[:, 0] << 32 | edges[:, 1], return_inverse=True)
    assert not np.bincount(number, weights=ways).any()
