"""The values of each level's matrix: the finest from the leaves, the others from the next finer level.

A leaf has K_mn = V (lambda g_m g_n^T + mu g_n g_m^T + mu (g_m . g_n) I) with the gradients g of its hat functions,
turned by its rotation: the corotated R K R^T, or linear elasticity without the rotation. Leaves in tension also have
V / 2 [g_m]x^T Theta [g_n]x - V [p S (g_m x g_n)]x of ``corotated.tension``. Every entry gathers its
contributions, so there are no atomic additions and sums have a fixed order.

Entries are stored transposed, as ``cycle.row_product`` takes them. Rows and columns of held nodes are zero; their
displacements are left out of the cycle.
"""

import functools

import warp as wp

from warp_corot.kernels.elements.elements import (
    LEVEL_MASK,
    ForestElements,
    edge_length,
    frame,
    local_gradient,
    mirror_sign,
    rest_volume,
)
from warp_corot.kernels.elements.simd8 import constants
from warp_corot.kernels.math.matrices import semidefinite
from warp_corot.kernels.math.rotation import quick_rotation
from warp_corot.kernels.modules import unique_kernel

from .cycle import FOUR, LevelArrays, sum_over_lanes
from .pattern import EntrySums

wp.set_module_options({"enable_backward": False})


#: A block whose determinant over the cube of a third of its trace is smaller is changed before it is inverted.
LEAST_DETERMINANT = wp.constant(1.0e-8)


@wp.kernel(enable_backward=False)
def find_free(
    # In
    ranks: int,
    mesh_nodes: int,
    nodes: wp.array[wp.int32],
    inverse_mass: wp.array[float],
    # Out
    free: wp.array[wp.uint8],
):
    """Find the free nodes, by rank; nodes of no leaf count as free."""
    world, i = wp.tid()
    node = nodes[i]
    is_free = bool(True)
    if node < mesh_nodes:
        is_free = inverse_mass[world * mesh_nodes + node] > 0.0
    free[world * ranks + i] = wp.where(is_free, wp.uint8(1), wp.uint8(0))


@wp.func
def turned_frame(elements: ForestElements, t: int, u: wp.array[wp.vec4]):
    return quick_rotation(frame(elements, t) + local_gradient(elements, t, u))


@wp.func
def rest_frame(elements: ForestElements, t: int, u: wp.array[wp.vec4]):
    return frame(elements, t)


@functools.cache
def write_frames(is_turned: bool) -> wp.Kernel:
    """Each leaf's frame at displacements u, or at rest, times sqrt(V) / h; the third column of the Maubach frame."""
    frame_of = turned_frame if is_turned else rest_frame

    @unique_kernel()
    def write_frames(
        # In
        elements: ForestElements,
        u: wp.array[wp.vec4],
        # Out
        frames: wp.array[wp.mat33],
    ):
        t = wp.tid()
        q = frame_of(elements, t, u) * (wp.sqrt(rest_volume(elements, t)) / edge_length(elements, t))
        mirrored = mirror_sign(elements.code[t])
        for axis in range(3):
            q[axis, 2] = q[axis, 2] * mirrored
        frames[t] = q

    return write_frames


@wp.struct
class Leaves:
    """What the finest matrix comes from, and its entries. ``gradients`` come from ``tables.shapes``, [shape, node];
    pairs and rows come from ``pattern``."""

    elements: ForestElements
    world_elements: int
    frames: wp.array[wp.mat33]
    gradients: wp.array[wp.vec3]
    mu: wp.array[float]
    lam: wp.array[float]
    stride: int
    sums: EntrySums
    entries: int
    ranks: int
    mesh_nodes: int
    row_entries: int
    pairs: wp.array[wp.vec2i]
    rows: wp.array[wp.vec4]
    scales: wp.array[float]  # of the operator
    stiffening: float  # viscous damping counts as so many times b K
    most_lambda: float  # lambda counts as so many times mu at most
    taut: wp.array[wp.uint8]  # see ``corotated.tension``; none if it does not count
    twists: wp.array[wp.mat33]
    swells: wp.array[wp.mat33]
    nodes: wp.array[wp.int32]  # by rank
    inverse_mass: wp.array[float]  # by node
    free: wp.array[wp.uint8]
    others: wp.array[wp.mat33]  # blocks of other forces, by node; one if there are none
    more: wp.array[wp.mat33]  # what the rows' weights add to the diagonal, by rank; one if there are none
    blocks: wp.array[wp.mat33]


@wp.func_native(
    FOUR
    + constants(LEVELS=int(LEVEL_MASK))
    + """
    const auto &upper = leaves.sums.upper, &places = leaves.sums.places, &pairs = leaves.pairs;
    const auto &starts = leaves.sums.starts, &codes = leaves.sums.codes;
    const auto &mu = leaves.mu, &lam = leaves.lam;
    const int stride = leaves.stride;
    const auto &more = leaves.more, &blocks = leaves.blocks;
    const float scale = leaves.scales.data[2] + leaves.scales.data[1] * leaves.stiffening;
    const long long first = (long long)world * leaves.world_elements, first_row = (long long)world * leaves.row_entries;
    const auto row = [&](int place) { return *reinterpret_cast<const four*>(&leaves.rows.data[first_row + place]); };
    const auto turned = [](const float* q, const float* g) {
        const four x = {q[0], q[3], q[6], 0.0f}, y = {q[1], q[4], q[7], 0.0f}, z = {q[2], q[5], q[8], 0.0f};
        return x * g[0] + y * g[1] + z * g[2];
    };
    // [a]x^T H [b]x with H half of Theta, by columns of products of H; and -[p S (a x b)]x.
    const auto add_tension = [&](long long t, const four& a, const four& b, four* c) {
        const float* theta = &leaves.twists.data[t].data[0][0];
        four h[3], ha = {}, hb = {};
        for (int k = 0; k < 3; ++k) {
            h[k] = four{theta[3 * k], theta[3 * k + 1], theta[3 * k + 2], 0.0f} * 0.5f;
            ha += h[k] * a[k];
            hb += h[k] * b[k];
        }
        const float trace = h[0][0] + h[1][1] + h[2][2], along = a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
        const float d = trace * along - (ha[0] * b[0] + ha[1] * b[1] + ha[2] * b[2]);
        for (int j = 0; j < 3; ++j) c[j] += h[j] * -along + b * (ha[j] - trace * a[j]) + hb * a[j];
        float w[3] = {};
        if (leaves.swells.shape[0]) {
            const float* s = &leaves.swells.data[t].data[0][0];
            const float n[3] = {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
            for (int i = 0; i < 3; ++i) w[i] = s[3 * i] * n[0] + s[3 * i + 1] * n[1] + s[3 * i + 2] * n[2];
        }
        c[0] += four{d, -w[2], w[1], 0.0f};
        c[1] += four{w[2], d, -w[0], 0.0f};
        c[2] += four{-w[1], w[0], d, 0.0f};
    };
    const long long count = upper.shape[0];
    const int last = count * (number + 1) / parts;
    for (int u = count * number / parts; u < last; ++u) {
        four c[3] = {};
        if (upper.data[u][0] == upper.data[u][1]) {
            if (more.shape[0] <= 1) continue;
            for (int at = starts.data[u]; at < starts.data[u + 1]; ++at) {
                if (codes.data[at] >= -1) continue;
                const four a = row(pairs.data[-2 - codes.data[at]][0]), b = a * a[3];
                for (int j = 0; j < 3; ++j) c[j] += a * b[j];
            }
            float* to = &more.data[(long long)world * leaves.ranks + upper.data[u][0]].data[0][0];
            for (int j = 0; j < 3; ++j)
                for (int i = 0; i < 3; ++i) to[3 * j + i] = scale * c[j][i];
            continue;
        }
        for (int at = starts.data[u]; at < starts.data[u + 1]; ++at) {
            const int code = codes.data[at];
            if (code < 0) {
                const four a = row(pairs.data[-2 - code][0]), b = row(pairs.data[-2 - code][1]);
                for (int j = 0; j < 3; ++j) c[j] += a * b[j];
                continue;
            }
            const long long t = first + (code >> 4);
            const float* g = &leaves.gradients.data[4 * ((leaves.elements.code.data[t] & LEVELS) % 3)][0];
            const float* q = &leaves.frames.data[t].data[0][0];
            const four a = turned(q, g + 3 * ((code >> 2) & 3)), b = turned(q, g + 3 * (code & 3));
            const float m = mu.data[t * stride], l = lam.data[t * stride], most = leaves.most_lambda * m;
            const four la = a * (l < most ? l : most), mb = b * m, ab = a * mb;
            const float d = ab[0] + ab[1] + ab[2];
            c[0] += la * b[0] + mb * a[0] + four{d, 0.0f, 0.0f, 0.0f};
            c[1] += la * b[1] + mb * a[1] + four{0.0f, d, 0.0f, 0.0f};
            c[2] += la * b[2] + mb * a[2] + four{0.0f, 0.0f, d, 0.0f};
            if (leaves.taut.shape[0] && leaves.taut.data[t]) add_tension(t, a, b, c);
        }
        float* own = &blocks.data[(long long)world * leaves.entries + places.data[u][0]].data[0][0];
        float* mirrored = &blocks.data[(long long)world * leaves.entries + places.data[u][1]].data[0][0];
        for (int j = 0; j < 3; ++j) {
            c[j] *= scale;
            for (int i = 0; i < 3; ++i) {
                own[3 * j + i] = c[j][i];
                mirrored[3 * i + j] = c[j][i];
            }
        }
    }
"""
)
def gather_entries(number: int, parts: int, world: int, leaves: Leaves): ...


@unique_kernel()
def gather_leaves(number: int, parts: int, leaves: Leaves):
    """Find the entries off the diagonal, and what weights add to it.

    A thread finds one of so many ``parts`` of the entries, from ``number`` on: one entry on CUDA. A column of a block
    is four lanes, so that a contribution takes some forty instructions on a CPU.
    """
    world, thread = wp.tid()
    gather_entries(number + thread, parts, world, leaves)


@wp.func
def inverse_block(a: wp.mat33):
    """The inverse of a symmetric positive definite block, regularised if the block is nearly singular; zero for a zero
    block.
    """
    third = (a[0, 0] + a[1, 1] + a[2, 2]) / 3.0
    result = wp.mat33()
    if third > 0.0:
        unit = a / third
        if wp.determinant(unit) < LEAST_DETERMINANT:
            unit += 0.05 * wp.identity(n=3, dtype=float)
        result = wp.inverse(unit) / third
    return result


@wp.func
def other_block(others: wp.array[wp.mat33], node: int, scales: wp.array[float]):
    """What other forces add to the diagonal of A at a node."""
    block = wp.mat33()
    if others.shape[0] > 1:
        block = others[node]
        if wp.trace(block) != 0.0:
            block = scales[2] * semidefinite(block)
    return block


@wp.kernel(enable_backward=False)
def finish_leaves(
    # In
    begin: int,
    leaves: Leaves,
    starts: wp.array[wp.int32],
    columns: wp.array[wp.int32],
    diagonal: wp.array[wp.int32],
    # In and out
    blocks: wp.array[wp.mat33],
    # Out
    inverses: wp.array[wp.mat33],
):
    """Find the finest level's diagonal, from the row ``begin`` on: stiffness, from the row's sum of blocks, which is
    zero because a translation causes no force; mass; and blocks of other forces, if there are any. Held nodes have
    zeros.
    """
    world, i = wp.tid()
    i += begin
    first = world * leaves.entries
    first_free = world * leaves.ranks
    own = diagonal[i]
    is_free = leaves.free[first_free + i] != wp.uint8(0)
    total = wp.mat33()
    for p in range(starts[i], starts[i + 1]):
        if p != own:
            total -= blocks[first + p]
            if not is_free or leaves.free[first_free + columns[p]] == wp.uint8(0):
                blocks[first + p] = wp.mat33()
    inverse = wp.mat33()
    if is_free:
        node = leaves.nodes[i]
        if node < leaves.mesh_nodes:
            node += world * leaves.mesh_nodes
            mass = leaves.scales[0] / leaves.inverse_mass[node]
            total += mass * wp.identity(n=3, dtype=float) + other_block(leaves.others, node, leaves.scales)
        smoothed = total
        if leaves.more.shape[0] > 1:
            smoothed += leaves.more[first_free + i]
        inverse = inverse_block(smoothed)
    else:
        total = wp.mat33()
    blocks[first + own] = total
    inverses[first_free + i] = inverse


@wp.func
def finish_entry(
    total: wp.mat33, world: int, u: int, level: LevelArrays, sums: EntrySums, inverses: wp.array[wp.mat33]
):
    """Write an entry of a coarser matrix, transposed, and its mirror image, or the inverse of a diagonal block."""
    i, where, first = sums.upper[u][0], sums.places[u], world * level.entries
    if i == sums.upper[u][1]:
        total = 0.5 * (total + wp.transpose(total))
        inverses[world * level.count + i] = inverse_block(total)
    else:
        level.rows.blocks[first + where[1]] = wp.transpose(total)
    level.rows.blocks[first + where[0]] = total


@wp.func
def both_free(world: int, u: int, level: LevelArrays, sums: EntrySums):
    i, j = world * level.ranks + sums.upper[u][0], world * level.ranks + sums.upper[u][1]
    return level.free[i] != wp.uint8(0) and level.free[j] != wp.uint8(0)


@wp.func
def matrix_over_lanes(part: wp.mat33, lanes: int):
    """The sum of the parts of neighbouring threads."""
    return wp.matrix_from_rows(
        sum_over_lanes(part[0], lanes), sum_over_lanes(part[1], lanes), sum_over_lanes(part[2], lanes)
    )


@wp.kernel(enable_backward=False)
def gather_products(
    # In
    lanes: int,
    level: LevelArrays,
    sums: EntrySums,
    fine: LevelArrays,
    # Out
    inverses: wp.array[wp.mat33],
):
    """Find P^T A P of a coarser level and the inverses of its diagonal blocks.

    Args:
        lanes: The number of threads that share the sum of an entry.
    """
    world, thread = wp.tid()
    u, lane = thread // lanes, thread % lanes
    total = wp.mat33()
    if both_free(world, u, level, sums):
        weights = wp.vec3(1.0, 0.5, 0.25)
        for at in range(sums.starts[u] + lane, sums.starts[u + 1], lanes):
            code = sums.codes[at]
            total += weights[code & 3] * fine.rows.blocks[world * fine.entries + (code >> 2)]
    total = matrix_over_lanes(total, lanes)
    if lane == 0:
        finish_entry(total, world, u, level, sums, inverses)
