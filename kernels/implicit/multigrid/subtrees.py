"""The finest level over subtrees on CUDA, without its matrix, and the matrix of the level of their roots.

In products over subtrees a leaf's rotation takes sixteen bytes; its part of an assembled matrix has a hundred.

A root's hat functions are linear in each of its leaves, so P^T K P of a subtree is a sum over its leaves with the
gradients of these functions, ten blocks for the pairs of its corners. The finest matrix itself is never assembled.
"""

import functools

import warp as wp

from warp_corot.kernels.corotated.turned_subtrees import LeafMaterial, leaf_axes
from warp_corot.kernels.elements.dilatation import Dilatation
from warp_corot.kernels.elements.elements import (
    ForestElements,
    Subtrees,
    load_node,
    nodal_forces,
    rest_volume,
    root_of,
    store_node,
)
from warp_corot.kernels.elements.forces import in_local_frame, own_gradient
from warp_corot.kernels.elements.shapes import leaf_forces_of
from warp_corot.kernels.elements.simd8 import law_kernel
from warp_corot.kernels.math.matrices import identity3
from warp_corot.kernels.modules import unique_kernel
from warp_corot.kernels.subtrees.forces import mat10
from warp_corot.kernels.subtrees.memory import memory_of
from warp_corot.kernels.tables.shapes import VOLUME, fingerprint
from warp_corot.kernels.tables.subtree import HANDEDNESS, LEAVES, POSITIONS

from .cycle import LevelArrays, make_step
from .pattern import EntrySums, kept_share, key_of, place_of
from .values import both_free, finish_entry, inverse_block, other_block

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def rank_places(
    # In
    mesh_nodes: int,
    ranks: int,
    rank: wp.array[wp.int32],
    # In and out
    places: wp.array2d[wp.int32],
):
    """Replace the numbers of nodes by their ranks, world after world; -1 stays."""
    i, j = wp.tid()
    node = places[i, j]
    if node >= 0:
        places[i, j] = (node / mesh_nodes) * ranks + rank[node % mesh_nodes]


@wp.struct
class SubtreeArrays:
    """The finest level without its matrix, and what nodes add to the diagonal besides subtrees."""

    level: LevelArrays
    stiffening: float  # viscous damping counts as so many times b K
    scales: wp.array[float]  # of the operator
    masses: wp.array[float]  # a M, by rank; minus one at held nodes
    blocks: wp.array[wp.mat33]  # of other forces, by rank; one if there are none
    products: wp.array[wp.vec4]  # K z, zero between the steps


@wp.kernel(enable_backward=False)
def find_own(
    # In
    mesh_nodes: int,
    nodes: wp.array[wp.int32],
    inverse_mass: wp.array[float],
    others: wp.array[wp.mat33],
    # Out
    arrays: SubtreeArrays,
    marks: wp.array[wp.vec4],
):
    """Find these from blocks by node, and mark free nodes with one."""
    world, i = wp.tid()
    at = world * arrays.level.ranks + i
    node = nodes[i]
    is_free = arrays.level.free[at] != wp.uint8(0)
    has_node = node < mesh_nodes
    mass = float(-1.0)
    block = wp.mat33()
    if is_free:
        mass = 0.0
        if has_node:
            mass = arrays.scales[0] / inverse_mass[world * mesh_nodes + node]
            block = other_block(others, world * mesh_nodes + node, arrays.scales)
    arrays.masses[at] = mass
    if others.shape[0] > 1:
        arrays.blocks[at] = block
    marks[at] = wp.vec4(wp.where(is_free, 1.0, 0.0), 0.0, 0.0, 0.0)


@wp.func
def own_block(arrays: SubtreeArrays, at: int):
    """The block of a node; zero if the node is held."""
    block = wp.max(arrays.masses[at], 0.0) * identity3()
    if arrays.blocks.shape[0] > 1:
        block += arrays.blocks[at]
    return block


@wp.func
def finished_product(at: int, arrays: SubtreeArrays, z: wp.vec3):
    """A z of one node from K z, which becomes zero for the next product."""
    scale = arrays.scales[2] + arrays.scales[1] * arrays.stiffening
    product = scale * load_node(arrays.products, at) + arrays.masses[at] * z
    if arrays.blocks.shape[0] > 1:
        product += arrays.blocks[at] * z
    store_node(arrays.products, at, wp.vec3())
    return product


@wp.kernel(enable_backward=False)
def finish_smoothing(
    arrays: SubtreeArrays, alpha: float, beta: float, from_zero: bool, z: wp.array[wp.vec4], other: wp.array[wp.vec4]
):
    """Make one step as ``cycle.smooth`` does, from ``products`` with K z."""
    at = wp.tid()
    product = finished_product(at, arrays, load_node(z, at))
    make_step(at, product, alpha, beta, from_zero, arrays.level, z, other)


@wp.kernel(enable_backward=False)
def finish_residual(arrays: SubtreeArrays, z: wp.array[wp.vec4], residual: wp.array[wp.vec4]):
    """r - A z, zero at held nodes, from ``products`` with K z."""
    at = wp.tid()
    product = finished_product(at, arrays, load_node(z, at))
    rest = wp.vec3()
    if arrays.masses[at] >= 0.0:
        rest = load_node(arrays.level.r, at) - product
    store_node(residual, at, rest)


@functools.cache
def keep_rows(shape: int, of: Dilatation) -> wp.Kernel:
    """Write the rows of subtrees whose leaves share their dilatation, at displacements u, with w - 1 in the fourth
    lane; see ``pattern``. Those of the first nodes of all subtrees come first, then those of the second ones.
    """
    leaves = LEAVES[shape]
    measure, curvature_of = of.measure, of.curvature

    @law_kernel()
    def keep_rows(
        # In
        count: int,
        leaf_numbers: wp.array[wp.int32],
        elements: ForestElements,
        u: wp.array[wp.vec4],
        mu: wp.array[float],
        lam: wp.array[float],
        stride: int,
        most: float,
        # Out
        rows: wp.array[wp.vec4],
    ):
        _generated_from = wp.static(fingerprint(leaves))
        s = wp.tid()
        first = leaf_numbers[s]
        row = mat10()
        sum = float(0.0)
        total = float(0.0)
        shear = float(0.0)
        for leaf in range(8):
            t = first + leaf
            theta, slope = measure(own_gradient(elements, t, u))
            modulus = lam[t * stride]
            weight = modulus * rest_volume(elements, t)
            sum += weight * theta
            total += weight
            shear += mu[t * stride] * rest_volume(elements, t)
            f0, f1, f2, f3 = nodal_forces(elements, t, in_local_frame(elements, t, -modulus * slope))
            row[wp.static(leaves[leaf][0])] += f0
            row[wp.static(leaves[leaf][1])] += f1
            row[wp.static(leaves[leaf][2])] += f2
            row[wp.static(leaves[leaf][3])] += f3
        factor = float(0.0)
        if total > 0.0:
            factor = wp.sqrt(kept_share(total, shear, most) * wp.max(curvature_of(sum / total), 0.0) / total)
        size = float(0.0)
        for n in range(10):
            size += wp.length(row[n])
        for n in range(10):
            own = wp.length(row[n])
            weight = float(1.0)
            if own > 0.0:
                weight = 0.25 * size / own
            v = factor * row[n]
            rows[n * count + s] = wp.vec4(v[0], v[1], v[2], weight - 1.0)

    return keep_rows


@functools.cache
def add_diagonals(shape: int, grouped: bool, uniform: bool, shares: bool) -> wp.Kernel:
    """Add the diagonal blocks of K: xx, yy and zz, or if ``mixed`` xy, xz and yz. Launch with block_dim
    ``subtrees.memory.BLOCK``.
    """
    _load, add = memory_of(shape, grouped)
    leaf_gradients = leaf_forces_of(shape)
    leaves, hands, volume = LEAVES[shape], HANDEDNESS[shape], VOLUME[shape]

    @wp.func
    def part_of(a: wp.vec3, m: float, k: float, mixed: bool):
        part = wp.vec3(a[0] * a[1], a[0] * a[2], a[1] * a[2]) * (m + k)
        if not mixed:
            square = m * wp.dot(a, a)
            part = (m + k) * wp.cw_mul(a, a) + wp.vec3(square, square, square)
        return part

    @unique_kernel(grid_stride=False)
    def add_diagonals(
        # In
        subtrees: Subtrees,
        material: LeafMaterial,
        turns: wp.array[wp.vec4],
        rows: wp.array[wp.vec4],
        mixed: bool,
        # In and out
        diagonals: wp.array[wp.vec4],
    ):
        _generated_from = wp.static(fingerprint(leaves, hands))
        s = wp.tid()
        h, _q, mirror = root_of(subtrees, s)
        count = turns.shape[0] / 8
        first = wp.where(wp.static(uniform), 0, subtrees.first[s])
        size = wp.static(volume) * h
        m = size * material.mu[first]
        k = wp.min(size * material.lam[first], material.most_lambda * m)
        g = mat10()
        for leaf in range(8):
            if wp.static(not uniform):
                m = size * material.mu[first + leaf]
                k = wp.min(size * material.lam[first + leaf], material.most_lambda * m)
            a0, a1, a2 = leaf_axes(turns, leaf * count + s, mirror * wp.static(hands[leaf]))
            f0, f1, f2, f3 = leaf_gradients(a0, a1, a2)
            g[wp.static(leaves[leaf][0])] += part_of(f0, m, k, mixed)
            g[wp.static(leaves[leaf][1])] += part_of(f1, m, k, mixed)
            g[wp.static(leaves[leaf][2])] += part_of(f2, m, k, mixed)
            g[wp.static(leaves[leaf][3])] += part_of(f3, m, k, mixed)
        if wp.static(shares):
            for n in range(10):
                row = rows[n * count + s]
                v = wp.vec3(row[0], row[1], row[2])
                g[n] += part_of(v, 0.0, 1.0 + row[3], mixed)
        add(subtrees, s, g, diagonals)

    return add_diagonals


@wp.kernel(enable_backward=False)
def invert_diagonals(arrays: SubtreeArrays, mixed: wp.array[wp.vec4]):
    """Find the inverses of diagonal blocks, zero at held nodes, from their parts in ``products`` and ``mixed``, and
    empty these for the next time."""
    at = wp.tid()
    a = arrays.products[at]
    b = mixed[at]
    arrays.products[at] = wp.vec4()
    mixed[at] = wp.vec4()
    inverse = wp.mat33()
    if arrays.masses[at] >= 0.0:
        block = wp.mat33(a[0], b[0], b[1], b[0], a[1], b[2], b[1], b[2], a[2])
        inverse = inverse_block(
            (arrays.scales[2] + arrays.scales[1] * arrays.stiffening) * block + own_block(arrays, at)
        )
    arrays.level.inverses[at] = inverse


#: The pairs of a root's corners, and the place of each.
PAIRS = [(m, n) for m in range(4) for n in range(m, 4)]
#: Blocks of a root.
ROOT_BLOCKS = len(PAIRS)
#: Rows of the blocks of all pairs.
mat30 = wp.types.matrix(shape=(30, 3), dtype=wp.float32)
mat43 = wp.types.matrix(shape=(4, 3), dtype=wp.float32)


def _ends(shape: int) -> list[tuple[int, int]]:
    """The corners of the root between which each of its ten nodes lies; twice the node itself if it is one."""
    x = POSITIONS[shape]
    found = [(n, n) for n in range(4)]
    for at in x[4:]:
        found += [(m, n) for m, n in PAIRS if all(abs(0.5 * (x[m][c] + x[n][c]) - at[c]) < 1e-6 for c in range(3))]
    return found


#: The types whose ten nodes are corners and midpoints of edges. In type 2 one is the midpoint of a new edge.
TYPES = (0, 1)
#: These corners of each type, and where its leaves have the corners: 4 times the leaf plus the place in it.
ENDS = tuple(_ends(shape) for shape in TYPES)
CORNERS = tuple(
    [next(4 * leaf + nodes.index(n) for leaf, nodes in enumerate(LEAVES[shape]) if n in nodes) for n in range(4)]
    for shape in TYPES
)


@wp.func_native("""
    #pragma unroll
    for (int p = 0, a = 0; a < 4; ++a) {
        #pragma unroll
        for (int b = a; b < 4; ++b, ++p) {
            const float* u = hats.data[a];
            const float* v = hats.data[b];
            const float d = m * (u[0] * v[0] + u[1] * v[1] + u[2] * v[2]);
            #pragma unroll
            for (int i = 0; i < 3; ++i) {
                #pragma unroll
                for (int j = 0; j < 3; ++j)
                    found.data[3 * p + i][j] += k * u[i] * v[j] + m * v[i] * u[j] + (i == j ? d : 0.0f);
            }
        }
    }
    return found;
""")
def with_pairs(found: mat30, hats: mat43, m: float, k: float) -> mat30:
    """Add the blocks k u v^T + m v u^T + m (u . v) I of all pairs of vectors."""
    ...


@wp.func_native("""
    float* to = &wp::index(blocks, at).data[0][0];
    for (int i = 0; i < 30; ++i)
        for (int j = 0; j < 3; ++j) to[3 * i + j] = found.data[i][j];
""")
def store_pairs(found: mat30, at: int, blocks: wp.array[wp.mat33]):
    """Write the blocks of all pairs."""
    ...


@functools.cache
def write_roots(shape: int, grouped: bool, uniform: bool, shares: bool) -> wp.Kernel:
    """Write the blocks of each root, mat33 [worlds * roots * ROOT_BLOCKS], without what held nodes add."""
    load, _add = memory_of(shape, grouped)
    leaf_gradients = leaf_forces_of(shape)
    leaves, hands, volume, ends = LEAVES[shape], HANDEDNESS[shape], VOLUME[shape], ENDS[shape]

    @unique_kernel(grid_stride=False)
    def write_roots(
        # In
        subtrees: Subtrees,
        per_world: int,
        roots: int,
        first_root: int,
        material: LeafMaterial,
        turns: wp.array[wp.vec4],
        rows: wp.array[wp.vec4],
        free: wp.array[wp.vec4],
        # Out
        blocks: wp.array[wp.mat33],
    ):
        _generated_from = wp.static(fingerprint(leaves, hands, ends))
        s = wp.tid()
        h, _q, mirror = root_of(subtrees, s)
        is_free = load(subtrees, s, free)
        count = turns.shape[0] / 8
        first = wp.where(wp.static(uniform), 0, subtrees.first[s])
        size = wp.static(volume) * h
        m = size * material.mu[first]
        k = wp.min(size * material.lam[first], material.most_lambda * m)
        found = mat30()
        for leaf in range(8):
            if wp.static(not uniform):
                m = size * material.mu[first + leaf]
                k = wp.min(size * material.lam[first + leaf], material.most_lambda * m)
            a0, a1, a2 = leaf_axes(turns, leaf * count + s, mirror * wp.static(hands[leaf]))
            f0, f1, f2, f3 = leaf_gradients(a0, a1, a2)
            hats = mat43()
            f0 = (0.5 * is_free[wp.static(leaves[leaf][0]), 0]) * f0
            hats[wp.static(ends[leaves[leaf][0]][0])] += f0
            hats[wp.static(ends[leaves[leaf][0]][1])] += f0
            f1 = (0.5 * is_free[wp.static(leaves[leaf][1]), 0]) * f1
            hats[wp.static(ends[leaves[leaf][1]][0])] += f1
            hats[wp.static(ends[leaves[leaf][1]][1])] += f1
            f2 = (0.5 * is_free[wp.static(leaves[leaf][2]), 0]) * f2
            hats[wp.static(ends[leaves[leaf][2]][0])] += f2
            hats[wp.static(ends[leaves[leaf][2]][1])] += f2
            f3 = (0.5 * is_free[wp.static(leaves[leaf][3]), 0]) * f3
            hats[wp.static(ends[leaves[leaf][3]][0])] += f3
            hats[wp.static(ends[leaves[leaf][3]][1])] += f3
            found = with_pairs(found, hats, m, k)
        if wp.static(shares):
            hats = mat43()
            for n in range(10):
                share = (0.5 * is_free[n, 0]) * load_node(rows, n * count + s)
                hats[wp.static(ends[n][0])] += share
                hats[wp.static(ends[n][1])] += share
            found = with_pairs(found, hats, 0.0, 1.0)
        world = s / per_world
        at = wp.static(ROOT_BLOCKS) * (world * roots + first_root + s - world * per_world)
        store_pairs(found, at, blocks)

    return write_roots


@wp.kernel(enable_backward=False)
def list_root_pairs(
    # In
    first_root: int,
    bits: int,
    leaf_numbers: wp.array[wp.int32],
    nodes: wp.array[wp.vec4i],
    corners: wp.vec4i,
    rank: wp.array[wp.int32],
    # Out
    keys: wp.array[wp.int64],
    codes: wp.array[wp.int32],
):
    """List the ten pairs of corners of each root; ``corners`` are those of ``CORNERS``. A code is 32 times the root,
    plus 2 times the pair's place, plus one where the second corner has the lower rank.
    """
    s = wp.tid()
    at = 10 * (first_root + s)
    place = int(0)
    for m in range(4):
        for n in range(m, 4):
            i = rank[nodes[leaf_numbers[s] + corners[m] / 4][corners[m] & 3]]
            j = rank[nodes[leaf_numbers[s] + corners[n] / 4][corners[n] & 3]]
            keys[at] = key_of(wp.min(i, j), wp.max(i, j), bits)
            codes[at] = 32 * (first_root + s) + 2 * place + wp.where(j < i, 1, 0)
            at += 1
            place += 1


@wp.kernel(enable_backward=False)
def find_middles(
    # In
    coarse: int,
    ends: wp.array[wp.vec2i],
    starts: wp.array[wp.int32],
    columns: wp.array[wp.int32],
    # Out
    middles: wp.array[wp.int32],
):
    """Write each finer node at the entry of its ends, where there is one, in the upper triangle."""
    node = coarse + wp.tid()
    i = wp.min(ends[node][0], ends[node][1])
    p = place_of(i, wp.max(ends[node][0], ends[node][1]), starts, columns)
    if p >= 0:
        middles[p] = node


@wp.kernel(enable_backward=False)
def gather_roots(
    # In
    level: LevelArrays,
    sums: EntrySums,
    roots: int,
    arrays: SubtreeArrays,
    midpoint_starts: wp.array[wp.int32],
    midpoints: wp.array[wp.int32],
    middles: wp.array[wp.int32],
    root_blocks: wp.array[wp.mat33],
    # Out
    inverses: wp.array[wp.mat33],
):
    """Find P^T A P of the level of roots and the inverses of its diagonal blocks. What nodes add, they add to the ends
    of their edge.
    """
    world, u = wp.tid()
    i = sums.upper[u][0]
    first = world * level.ranks
    total = wp.mat33()
    if both_free(world, u, level, sums):
        for at in range(sums.starts[u], sums.starts[u + 1]):
            code = sums.codes[at]
            if code >= 0:
                block = root_blocks[wp.static(ROOT_BLOCKS) * (world * roots + code / 32) + (code & 31) / 2]
                if (code & 1) == 0:
                    block = wp.transpose(block)
                total += block
        total = (arrays.scales[2] + arrays.scales[1] * arrays.stiffening) * total
        if i == sums.upper[u][1]:
            total += own_block(arrays, first + i)
            for k in range(midpoint_starts[i], midpoint_starts[i + 1]):
                total += 0.25 * own_block(arrays, first + midpoints[k])
        elif middles[sums.places[u][0]] >= 0:
            total += 0.25 * own_block(arrays, first + middles[sums.places[u][0]])
    finish_entry(total, world, u, level, sums, inverses)
