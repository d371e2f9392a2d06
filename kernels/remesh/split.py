"""Separation of nodes: every node becomes one for each component of the leaves around it, joined by uncut faces.

Corners of leaves are united across uncut faces (a lock-free union-find: of two roots the larger is linked to the
smaller, so that the outcome does not depend on the order). The component with the smallest corner keeps the node; each
of the others gets a copy with the same displacement, velocity and supports, and takes its leaves' mass and its share
of load and reaction along. Nothing hangs on a node or an edge afterwards.

The corners of a leaf's ancestors are those of certain leaves below them: the first child's, and the far end of the
refinement edge from the second. So each is written by one leaf. An ancestor is torn if its children do not agree on
the nodes that they share.
"""

import warp as wp

from warp_corot.kernels.elements.elements import load_node, store_node
from warp_corot.kernels.meshing.bisection import refinement_end
from warp_corot.kernels.plan.plan import TORN

from .cut import COPIES, MARKED, STAMP, Cuts, add_star, face_node, forget, is_cut, meet, star_count
from .pools import ADDED, FULL, LEAVES, NODE_TOP, Carried, Pools, copy_node, quarter_mass, refresh_mass

wp.set_module_options({"enable_backward": False})


@wp.func
def root_of(c: int, cuts: Cuts):
    root = int(c)
    while cuts.link[root] != root:
        root = cuts.link[root]
    return root


@wp.func
def unite(a: int, b: int, cuts: Cuts):
    """Join the components of two corners."""
    low = root_of(a, cuts)
    high = root_of(b, cuts)
    while low != high:
        if low > high:
            swapped = int(low)
            low = high
            high = swapped
        before = wp.atomic_cas(cuts.link, high, high, low)
        if before == high:
            return
        low = root_of(low, cuts)
        high = root_of(before, cuts)


@wp.kernel(enable_backward=False)
def list_stars(
    # In
    threads: int,
    # In and out
    pools: Pools,
    cuts: Cuts,
):
    """List the leaves around marked nodes."""
    count = wp.where(cuts.counts[MARKED] > 0, pools.counts[LEAVES], 0)
    for i in range(wp.tid(), count, threads):
        tet = pools.leaf_tets[i]
        names = bool(False)
        for n in range(4):
            if cuts.mark[tet[n]] == cuts.counts[STAMP]:
                names = True
        if names:
            add_star(i, pools, cuts)


@wp.func
def local_place(tet: wp.vec4i, node: int):
    """The place of a node among the four of a leaf, -1 if it is none of them."""
    found = int(-1)
    for n in range(4):
        if tet[n] == node:
            found = n
    return found


@wp.kernel(enable_backward=False)
def unite_corners(
    # In
    threads: int,
    # In and out
    pools: Pools,
    cuts: Cuts,
):
    """Join the corners of leaves on both sides of uncut faces."""
    for f in range(wp.tid(), 4 * star_count(cuts), threads):
        s = f / 4
        i = cuts.stars[s]
        if not is_cut(f, pools, cuts):
            tet = pools.leaf_tets[i]
            before = meet(s, f % 4, tet, cuts)
            if before >= 0:
                other = pools.leaf_tets[cuts.stars[before / 4]]
                for n in range(3):
                    here = face_node(f % 4, n)
                    there = local_place(other, tet[here])
                    if there >= 0:
                        unite(4 * s + here, 4 * (before / 4) + there, cuts)


@wp.kernel(enable_backward=False)
def choose_keepers(
    # In
    threads: int,
    # In and out
    pools: Pools,
    cuts: Cuts,
):
    for c in range(wp.tid(), 4 * star_count(cuts), threads):
        forget(c, cuts)
        if cuts.link[c] == c:
            node = pools.leaf_tets[cuts.stars[c / 4]][c % 4]
            if cuts.mark[node] == cuts.counts[STAMP]:
                wp.atomic_min(cuts.keeper, node, c)


@wp.kernel(enable_backward=False)
def copy_nodes(
    # In
    threads: int,
    # In and out
    pools: Pools,
    carried: Carried,
    cuts: Cuts,
):
    """Make a node for each component but the first; without room, components stay together."""
    for c in range(wp.tid(), 4 * star_count(cuts), threads):
        if cuts.link[c] == c:
            node = pools.leaf_tets[cuts.stars[c / 4]][c % 4]
            if cuts.mark[node] == cuts.counts[STAMP] and cuts.keeper[node] != c:
                new = pools.counts[NODE_TOP] + wp.atomic_add(cuts.counts, COPIES, 1)
                if new < pools.node_limit:
                    pools.lattice[new] = pools.lattice[node]
                    pools.ends[new] = pools.ends[node]
                    pools.valence[new] = 0
                    pools.touched[new] = 0
                    carried.mass[new] = wp.float64(0.0)
                    copy_node(node, new, carried)
                    cuts.former_mass[new] = cuts.former_mass[node]
                    cuts.copy[c] = new
                else:
                    wp.atomic_max(pools.counts, FULL, 1)


@wp.kernel(enable_backward=False)
def rename_corners(
    # In
    threads: int,
    # In and out
    pools: Pools,
    carried: Carried,
    cuts: Cuts,
):
    """Write the new nodes into leaves, and hand the leaves' mass on to them."""
    for s in range(wp.tid(), star_count(cuts), threads):
        i = cuts.stars[s]
        e = pools.leaves[i]
        tet = pools.leaf_tets[i]
        for n in range(4):
            new = cuts.copy[root_of(4 * s + n, cuts)]
            if new >= 0:
                node = tet[n]
                mass = quarter_mass(e, pools.level[e], carried)
                wp.atomic_add(carried.mass, node, -mass)
                wp.atomic_add(carried.mass, new, mass)
                wp.atomic_add(pools.valence, node, -1)
                wp.atomic_add(pools.valence, new, 1)
                tet[n] = new
        pools.leaf_tets[i] = tet
        pools.tets[e] = tet


@wp.func
def settle(node: int, carried: Carried, cuts: Cuts):
    """Scale a node's load and reaction to its share of the mass, and update its mass for stepping."""
    mass = carried.mass[node]
    share = float(0.0)
    if cuts.former_mass[node] > wp.float64(0.0):
        share = float(mass / cuts.former_mass[node])
    if share != 1.0:
        store_node(carried.load, node, share * load_node(carried.load, node))
        store_node(carried.reaction, node, share * load_node(carried.reaction, node))
    refresh_mass(node, carried)


@wp.func
def copies(pools: Pools, cuts: Cuts):
    """The number of nodes made, as far as there was room."""
    return wp.min(cuts.counts[COPIES], pools.node_limit - pools.counts[NODE_TOP])


@wp.kernel(enable_backward=False)
def settle_nodes(
    # In
    threads: int,
    pools: Pools,
    # In and out
    carried: Carried,
    cuts: Cuts,
):
    marked = wp.where(cuts.counts[COPIES] > 0, cuts.counts[MARKED], 0)
    for k in range(wp.tid(), marked + copies(pools, cuts), threads):
        if k < marked:
            settle(cuts.marked[k], carried, cuts)
        else:
            settle(pools.counts[NODE_TOP] + k - marked, carried, cuts)


@wp.kernel(enable_backward=False)
def rename_ancestors(
    # In
    threads: int,
    pools: Pools,
    # In and out
    cuts: Cuts,
):
    """Write the corners of leaves into the ancestors that have them."""
    for c in range(wp.tid(), 4 * star_count(cuts), threads):
        e = pools.leaves[cuts.stars[c / 4]]
        at = c % 4
        node = cuts.names[e, at]
        above = pools.parent[e]
        while above >= 0:
            k = refinement_end(pools.level[above])
            if (e - pools.roots) % 2 == 1:
                at = wp.where(at == k - 1, k, -1)
            elif at == k:
                at = -1
            if at >= 0 and cuts.names[above, at] != node:
                cuts.names[above, at] = node
                e = above
                above = pools.parent[e]
            else:
                above = -1


@wp.func
def is_torn(first: int, k: int, pools: Pools):
    """Whether two children do not agree on the nodes that they share; k: the end of their parent's refinement edge."""
    a = pools.tets[first]
    b = pools.tets[first + 1]
    torn = bool(False)
    for n in range(1, 4):
        if (n < k and a[n] != b[n - 1]) or (n >= k and a[n] != b[n]):
            torn = True
    return torn


@wp.kernel(enable_backward=False)
def tear_ancestors(
    # In
    threads: int,
    # In and out
    pools: Pools,
    cuts: Cuts,
):
    """Find which ancestors of the leaves are torn, and renew the ends of their midpoints."""
    for s in range(wp.tid(), star_count(cuts), threads):
        above = pools.parent[pools.leaves[cuts.stars[s]]]
        torn = bool(False)
        while above >= 0:
            k = refinement_end(pools.level[above])
            first = pools.first_child[above]
            tet = pools.tets[above]
            ends = wp.vec2i(wp.min(tet[0], tet[k]), wp.max(tet[0], tet[k]))
            pools.ends[pools.tets[first][k]] = ends
            pools.ends[pools.tets[first + 1][k]] = ends
            torn = torn or (pools.cut[above] & TORN) != 0 or is_torn(first, k, pools)
            if torn:
                wp.atomic_or(pools.cut, above, TORN)
            above = pools.parent[above]


@wp.kernel(enable_backward=False)
def end_cut(
    # In and out
    pools: Pools,
    cuts: Cuts,
):
    made = copies(pools, cuts)
    pools.counts[NODE_TOP] = pools.counts[NODE_TOP] + made
    pools.counts[ADDED] = pools.counts[ADDED] + made
    cuts.counts[COPIES] = made
