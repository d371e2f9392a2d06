"""Corotated forces of complete subtrees on CUDA: one thread a subtree, eight leaves in registers.

Three things make it fast. Forces are summed over the eight leaves in registers, and over a group of eight subtrees in
shared memory, by a table that tells each lane which slots to add up, so that nothing is added atomically twice. What
leaves for global memory are 16-byte vector reductions where the card has them. And rotations are found by four unscaled
iterations (``rotation.newton_rotation``).

A subtree with a leaf that these do not turn, strongly stretched, flat or inverted, adds nothing and is flagged;
``repair_own`` and ``repair_shared`` do flagged subtrees with the robust rotation.
"""

import functools

import warp as wp

from .constitutive import corotated_strain, hooke
from .elements import (
    ADD_FORCE,
    FRAME_SHIFT,
    LEVEL_MASK,
    ROOT2,
    ForestElements,
    Subtrees,
    add_force,
    frame,
    load_node,
    local_gradient,
    mirror_sign,
    scatter_stress,
)
from .rotation import ITERATIONS, byers_xu, column, newton_rotation
from .shapes import VOLUME, fingerprint
from .subtree import (
    FRAMES,
    GROUP_NODES,
    HANDEDNESS,
    LEAVES,
    POSITIONS,
    SLOT_STRIDE,
    group_slots,
    group_sources,
)

wp.set_module_options({"enable_backward": False})

BLOCK = 128
mat10 = wp.types.matrix(shape=(10, 3), dtype=wp.float32)


def _numbers(values: list[int]) -> str:
    return ", ".join(map(str, values))


def _load_snippet(shape: int) -> str:
    """Stage a group's displacements in shared memory, each read once, and hand every lane its subtree's ten."""
    slots = [place for ten in group_slots(shape) for place in ten]
    return f"""
#if defined(__CUDA_ARCH__)
    static const unsigned char slot[80] = {{{_numbers(slots)}}};
    __shared__ float4 staged[{BLOCK // 8}][{GROUP_NODES + 1}];
    const int lane = threadIdx.x & 7;
    const int g = threadIdx.x >> 3;
    #pragma unroll
    for (int r = 0; r < {GROUP_NODES // 8}; ++r) {{
        const int node = wp::index(nodes, group, 8 * r + lane);
        if (node >= 0) staged[g][8 * r + lane] = *reinterpret_cast<const float4*>(&wp::index(u, node));
    }}
    __syncwarp();
    wp::mat_t<10, 3, wp::float32> x;
    #pragma unroll
    for (int k = 0; k < 10; ++k) {{
        const float4 a = staged[g][slot[10 * lane + k]];
        x.data[k][0] = a.x; x.data[k][1] = a.y; x.data[k][2] = a.z;
    }}
    return x;
#else
    return wp::mat_t<10, 3, wp::float32>();
#endif
"""


def _merge_snippet(shape: int) -> str:
    """Sum a group's forces in shared memory and reduce each node's once; a lane sums every eighth node's."""
    sources = group_sources(shape)
    empty = 10  # the spare slot of the first subtree, kept zero
    table: list[int] = []
    rounds = ""
    for r in range(GROUP_NODES // 8):
        lists = sources[8 * r : 8 * r + 8]
        longest = max(map(len, lists))
        rounds += f"""
    {{
        float4 sum = make_float4(0.f, 0.f, 0.f, 0.f);
        #pragma unroll
        for (int m = 0; m < {longest}; ++m) {{
            const float4 a = part[g][source[{len(table)} + 8 * m + lane]];
            sum.x += a.x; sum.y += a.y; sum.z += a.z;
        }}
        const int node = wp::index(nodes, group, {8 * r} + lane);
        const wp::vec_t<3, wp::float32> force(sum.x, sum.y, sum.z);
        if (node >= 0) {{ {ADD_FORCE} }}
    }}"""
        table += [slots[m] if m < len(slots) else empty for m in range(longest) for slots in lists]
    return f"""
#if defined(__CUDA_ARCH__)
    static const unsigned char source[{len(table)}] = {{{_numbers(table)}}};
    __shared__ float4 part[{BLOCK // 8}][{8 * SLOT_STRIDE + 1}];
    const int lane = threadIdx.x & 7;
    const int g = threadIdx.x >> 3;
    #pragma unroll
    for (int k = 0; k < 10; ++k)
        part[g][{SLOT_STRIDE} * lane + k] = make_float4(x.data[k][0], x.data[k][1], x.data[k][2], 0.f);
    if (lane == 0) part[g][{empty}] = make_float4(0.f, 0.f, 0.f, 0.f);
    __syncwarp();
    {rounds}
#endif
"""


@functools.cache
def _memory(shape: int, grouped: bool) -> tuple[wp.Function, wp.Function]:
    """How a subtree's displacements come in and its forces go out."""
    if grouped:

        @wp.func_native(_load_snippet(shape))
        def load_group(nodes: wp.array2d[wp.int32], group: int, u: wp.array[wp.vec4]) -> mat10: ...

        @wp.func_native(_merge_snippet(shape))
        def merge_group(nodes: wp.array2d[wp.int32], group: int, x: mat10, f: wp.array[wp.vec4]): ...

        @wp.func
        def load(subtrees: Subtrees, s: int, u: wp.array[wp.vec4]):
            return load_group(subtrees.nodes, s // 8, u)

        @wp.func
        def add(subtrees: Subtrees, s: int, g: mat10, f: wp.array[wp.vec4]):
            merge_group(subtrees.nodes, s // 8, g, f)

        return load, add

    @wp.func
    def load(subtrees: Subtrees, s: int, u: wp.array[wp.vec4]):
        x = mat10()
        for k in range(10):
            x[k] = load_node(u, subtrees.nodes[k, s])
        return x

    @wp.func
    def add(subtrees: Subtrees, s: int, g: mat10, f: wp.array[wp.vec4]):
        for k in range(10):
            add_force(f, subtrees.nodes[k, s], g[k])

    return load, add


@functools.cache
def _columns(shape: int) -> wp.Function:
    """Differences of four nodes, the columns of F in the Maubach frame where lengths are in edge lengths."""

    @wp.func
    def columns(x0: wp.vec3, x1: wp.vec3, x2: wp.vec3, x3: wp.vec3):
        c0 = x1 - x0
        c1 = x2 - x1
        c2 = x3 - x2
        if wp.static(shape == 1):
            c2 = c2 + (x3 - x0)
        if wp.static(shape == 2):
            c0 = ROOT2 * (x0 - x2)
            c1 = ROOT2 * (x1 - x2)
            c2 = 2.0 * c2
        return c0, c1, c2

    return columns


@functools.cache
def _nodal_forces(shape: int) -> wp.Function:
    """Forces on the four nodes from the columns of the stress times V / h."""

    @wp.func
    def nodal_forces(p0: wp.vec3, p1: wp.vec3, p2: wp.vec3):
        f0 = p0
        f1 = p1 - p0
        f2 = p2 - p1
        f3 = -p2
        if wp.static(shape == 1):
            f0 = p0 + p2
            f3 = -2.0 * p2
        if wp.static(shape == 2):
            f0 = -ROOT2 * p0
            f1 = -ROOT2 * p1
            f2 = ROOT2 * (p0 + p1) + 2.0 * p2
            f3 = -2.0 * p2
        return f0, f1, f2, f3

    return nodal_forces


@functools.cache
def _deformed(shape: int) -> wp.Function:
    """Turn ten displacements into ten positions relative to the first node's displacement, in edge lengths of a leaf.

    In that unit a subtree at rest has whole numbers for columns, and its forces vanish exactly.
    """
    at = [[2.0 * c for c in point] for point in POSITIONS[shape]]

    @wp.func
    def deformed(x: mat10, q: wp.mat33, inv_h: float, mirror: float):
        _generated_from = wp.static(fingerprint(at))
        q0 = column(q, 0)
        q1 = column(q, 1)
        q2 = column(q, 2) * mirror
        origin = x[0]
        y = mat10()
        for k in range(10):
            y[k] = (x[k] - origin) * inv_h + (
                wp.static(at[k][0]) * q0 + wp.static(at[k][1]) * q1 + wp.static(at[k][2]) * q2
            )
        return y

    return deformed


@functools.cache
def scatter_subtrees_own(shape: int, grouped: bool, uniform: bool) -> wp.Kernel:
    """Corotated forces of subtrees, every leaf with its own rotation. Launch with block_dim BLOCK.

    With a rotation, R sym(R^T F) = F, so P = 2 mu (F - R) + lambda tr(R^T F - I) R: no matrix is multiplied.
    """
    load, add = _memory(shape, grouped)
    columns, nodal_forces, deformed = _columns(shape), _nodal_forces(shape), _deformed(shape)
    leaves, handed = LEAVES[shape], HANDEDNESS[shape]
    volume = VOLUME[shape]

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def scatter_subtrees_own(
        # In
        subtrees: Subtrees,
        mu: wp.array[wp.float32],
        lam: wp.array[wp.float32],
        u: wp.array[wp.vec4],
        # Out
        f: wp.array[wp.vec4],
        flagged: wp.array[wp.uint8],
    ):
        _generated_from = wp.static(fingerprint(leaves, handed))
        s = wp.tid()
        code = subtrees.code[s]
        h = 0.5 * subtrees.size[(code & LEVEL_MASK) // 3]
        mirror = mirror_sign(code)
        x = deformed(load(subtrees, s, u), subtrees.frames[code >> FRAME_SHIFT], 1.0 / h, mirror)
        first = subtrees.first[s]
        m = mu[0]
        k = lam[0]
        # P V/h = from_f F + from_z Z with Z = 2^ITERATIONS R.
        area = wp.static(volume) * h * h
        area_z = wp.static(0.5**ITERATIONS) * area
        g = mat10()
        trusted = bool(True)
        for leaf in range(8):
            if wp.static(not uniform):
                m = mu[first + leaf]
                k = lam[first + leaf]
            hand = mirror * wp.static(handed[leaf])
            c0, c1, c2 = columns(
                x[wp.static(leaves[leaf][0])],
                x[wp.static(leaves[leaf][1])],
                x[wp.static(leaves[leaf][2])],
                x[wp.static(leaves[leaf][3])],
            )
            z0, z1, z2, converged = newton_rotation(c0, c1, c2, hand)
            trusted = trusted and converged
            trace = wp.static(0.5**ITERATIONS) * (wp.dot(z0, c0) + wp.dot(z1, c1) + wp.dot(z2, c2))
            from_f = 2.0 * m * area
            from_z = (k * (trace - 3.0) - 2.0 * m) * area_z
            f0, f1, f2, f3 = nodal_forces(
                from_f * c0 + from_z * z0, from_f * c1 + from_z * z1, from_f * c2 + from_z * z2
            )
            g[wp.static(leaves[leaf][0])] += f0
            g[wp.static(leaves[leaf][1])] += f1
            g[wp.static(leaves[leaf][2])] += f2
            g[wp.static(leaves[leaf][3])] += f3
        if not trusted:
            g = mat10()
        flagged[s] = wp.where(trusted, wp.uint8(0), wp.uint8(1))
        add(subtrees, s, g, f)

    return scatter_subtrees_own


@functools.cache
def scatter_subtrees_shared(shape: int, grouped: bool, uniform: bool, given: bool) -> wp.Kernel:
    """Corotated forces of subtrees whose leaves share a rotation: the subtree root's, or a given one from further up.

    The ten displacements are turned back once; in the subtree's own frame the leaves are linear elements.
    Launch with block_dim BLOCK.
    """
    load, add = _memory(shape, grouped)
    columns, nodal_forces, deformed = _columns(shape), _nodal_forces(shape), _deformed(shape)
    leaves, frames, at = LEAVES[shape], FRAMES[shape], POSITIONS[shape]
    volume = VOLUME[shape]

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def scatter_subtrees_shared(
        # In
        subtrees: Subtrees,
        mu: wp.array[wp.float32],
        lam: wp.array[wp.float32],
        u: wp.array[wp.vec4],
        rotations: wp.array[wp.mat33],
        unit: wp.array[wp.int32],
        # Out
        f: wp.array[wp.vec4],
        flagged: wp.array[wp.uint8],
    ):
        _generated_from = wp.static(fingerprint(leaves, frames, at))
        s = wp.tid()
        code = subtrees.code[s]
        h = 0.5 * subtrees.size[(code & LEVEL_MASK) // 3]
        mirror = mirror_sign(code)
        q = subtrees.frames[code >> FRAME_SHIFT]
        x = deformed(load(subtrees, s, u), q, 1.0 / h, mirror)
        trusted = bool(True)
        r0 = wp.vec3()
        r1 = wp.vec3()
        r2 = wp.vec3()
        if wp.static(given):
            r = rotations[unit[s]] * q
            r0 = column(r, 0)
            r1 = column(r, 1)
            r2 = column(r, 2) * mirror
        else:
            c0, c1, c2 = columns(x[0], x[1], x[2], x[3])
            # The subtree's edge is two of a leaf's.
            z0, z1, z2, converged = newton_rotation(0.5 * c0, 0.5 * c1, 0.5 * c2, mirror)
            trusted = converged
            r0 = wp.static(0.5**ITERATIONS) * z0
            r1 = wp.static(0.5**ITERATIONS) * z1
            r2 = wp.static(0.5**ITERATIONS) * z2
        y = mat10()
        for n in range(10):
            # Displacement in the subtree's Maubach frame.
            y[n] = wp.vec3(
                wp.dot(r0, x[n]) - wp.static(2.0 * at[n][0]),
                wp.dot(r1, x[n]) - wp.static(2.0 * at[n][1]),
                wp.dot(r2, x[n]) - wp.static(2.0 * at[n][2]),
            )
        first = subtrees.first[s]
        m = mu[0]
        k = lam[0]
        area = wp.static(volume) * h * h
        g = mat10()
        for leaf in range(8):
            if wp.static(not uniform):
                m = mu[first + leaf]
                k = lam[first + leaf]
            b0, b1, b2 = columns(
                y[wp.static(leaves[leaf][0])],
                y[wp.static(leaves[leaf][1])],
                y[wp.static(leaves[leaf][2])],
                y[wp.static(leaves[leaf][3])],
            )
            c = wp.matrix_from_cols(b0, b1, b2)
            # B^T C in the leaf's frame B, zeros of B left out.
            e = wp.mat33()
            for i in range(3):
                for j in range(3):
                    for axis in range(3):
                        if wp.static(abs(frames[leaf][i][axis]) > 1e-9):
                            e[i, j] += wp.static(frames[leaf][i][axis]) * c[axis, j]
            double_mu = 2.0 * m * area
            pressure = k * area * (e[0, 0] + e[1, 1] + e[2, 2])
            s01 = m * area * (e[0, 1] + e[1, 0])
            s02 = m * area * (e[0, 2] + e[2, 0])
            s12 = m * area * (e[1, 2] + e[2, 1])
            sigma = wp.mat33(
                double_mu * e[0, 0] + pressure,
                s01,
                s02,
                s01,
                double_mu * e[1, 1] + pressure,
                s12,
                s02,
                s12,
                double_mu * e[2, 2] + pressure,
            )
            p = wp.mat33()
            for axis in range(3):
                for j in range(3):
                    for i in range(3):
                        if wp.static(abs(frames[leaf][i][axis]) > 1e-9):
                            p[axis, j] += wp.static(frames[leaf][i][axis]) * sigma[i, j]
            f0, f1, f2, f3 = nodal_forces(column(p, 0), column(p, 1), column(p, 2))
            g[wp.static(leaves[leaf][0])] += f0
            g[wp.static(leaves[leaf][1])] += f1
            g[wp.static(leaves[leaf][2])] += f2
            g[wp.static(leaves[leaf][3])] += f3
        for n in range(10):
            force = g[n]
            g[n] = force[0] * r0 + force[1] * r1 + force[2] * r2
        if not trusted:
            g = mat10()
        if wp.static(not given):
            flagged[s] = wp.where(trusted, wp.uint8(0), wp.uint8(1))
        add(subtrees, s, g, f)

    return scatter_subtrees_shared


@wp.kernel(enable_backward=False)
def repair_own(
    # In
    flagged: wp.array[wp.uint8],
    first: wp.array[wp.int32],
    elements: ForestElements,
    mu: wp.array[wp.float32],
    lam: wp.array[wp.float32],
    stride: int,
    u: wp.array[wp.vec4],
    # Out
    f: wp.array[wp.vec4],
):
    """Forces of flagged subtrees, leaf by leaf with the rotation that is right for every F."""
    s = wp.tid()
    if flagged[s] == wp.uint8(0):
        return
    for leaf in range(8):
        t = first[s] + leaf
        g = local_gradient(elements, t, u)
        q = frame(elements, t)
        r = byers_xu(q + g)
        scatter_stress(elements, t, r * hooke(corotated_strain(g, q, r), mu[t * stride], lam[t * stride]), f)


@wp.kernel(enable_backward=False)
def repair_shared(
    # In
    flagged: wp.array[wp.uint8],
    first: wp.array[wp.int32],
    roots: ForestElements,
    elements: ForestElements,
    mu: wp.array[wp.float32],
    lam: wp.array[wp.float32],
    stride: int,
    u: wp.array[wp.vec4],
    # Out
    f: wp.array[wp.vec4],
):
    """Forces of flagged subtrees with their root's rotation."""
    s = wp.tid()
    if flagged[s] == wp.uint8(0):
        return
    frame_of_root = frame(roots, s)
    rotation = byers_xu(frame_of_root + local_gradient(roots, s, u)) * wp.transpose(frame_of_root)
    for leaf in range(8):
        t = first[s] + leaf
        g = local_gradient(elements, t, u)
        q = frame(elements, t)
        r = rotation * q
        scatter_stress(elements, t, r * hooke(corotated_strain(g, q, r), mu[t * stride], lam[t * stride]), f)
