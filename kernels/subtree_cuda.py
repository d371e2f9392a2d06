"""Corotated forces of complete subtrees on CUDA: one thread a subtree, eight leaves in registers.

Three things make it fast. Forces are summed over the eight leaves in registers, and over a group of eight subtrees in
shared memory, by a table that tells each lane which slots to add up, so that nothing is added atomically twice. What
leaves for global memory are 16-byte vector reductions where the card has them. And rotations are found by four unscaled
iterations.

A subtree that these do not turn adds nothing and is flagged; ``repair`` does flagged subtrees.
"""

import functools

import warp as wp

from .elements import ADD_FORCE, FRAME_SHIFT, LEVEL_MASK, Subtrees, add_force, load_node, mirror_sign
from .subtree import GROUP_NODES, SLOT_STRIDE, group_slots, group_sources
from .subtree_forces import deformed_of, mat10, own_forces, shared_forces

wp.set_module_options({"enable_backward": False})

BLOCK = 128


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
        const int node = wp::index(targets, group, {8 * r} + lane);
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
def memory_of(shape: int, grouped: bool) -> tuple[wp.Function, wp.Function]:
    """How a subtree's displacements come in and its forces go out."""
    if grouped:

        @wp.func_native(_load_snippet(shape))
        def load_group(nodes: wp.array2d[wp.int32], group: int, u: wp.array[wp.vec4]) -> mat10: ...

        @wp.func_native(_merge_snippet(shape))
        def merge_group(targets: wp.array2d[wp.int32], group: int, x: mat10, f: wp.array[wp.vec4]): ...

        @wp.func
        def load(subtrees: Subtrees, s: int, u: wp.array[wp.vec4]):
            return load_group(subtrees.nodes, s // 8, u)

        @wp.func
        def add(subtrees: Subtrees, s: int, g: mat10, f: wp.array[wp.vec4]):
            merge_group(subtrees.targets, s // 8, g, f)

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
            add_force(f, subtrees.targets[k, s], g[k])

    return load, add


@functools.cache
def scatter_subtrees_own(shape: int, grouped: bool, uniform: bool) -> wp.Kernel:
    """Corotated forces of subtrees, every leaf with its own rotation. Launch with block_dim BLOCK."""
    load, add = memory_of(shape, grouped)
    deformed, forces = deformed_of(shape), own_forces(shape, uniform)

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
        s = wp.tid()
        code = subtrees.code[s]
        h = 0.5 * subtrees.size[(code & LEVEL_MASK) // 3]
        mirror = mirror_sign(code)
        x = deformed(load(subtrees, s, u), subtrees.frames[code >> FRAME_SHIFT], 1.0 / h, mirror)
        g, trusted = forces(x, h, mirror, mu, lam, wp.where(wp.static(uniform), 0, subtrees.first[s]))
        flagged[s] = wp.where(trusted, wp.uint8(0), wp.uint8(1))
        add(subtrees, s, g, f)

    return scatter_subtrees_own


@functools.cache
def scatter_subtrees_shared(shape: int, grouped: bool, uniform: bool, given: bool) -> wp.Kernel:
    """Corotated forces of subtrees whose leaves share a rotation: the subtree root's, or a given one from further up.

    Launch with block_dim BLOCK.
    """
    load, add = memory_of(shape, grouped)
    deformed, forces = deformed_of(shape), shared_forces(shape, uniform, given)

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
        s = wp.tid()
        code = subtrees.code[s]
        h = 0.5 * subtrees.size[(code & LEVEL_MASK) // 3]
        mirror = mirror_sign(code)
        q = subtrees.frames[code >> FRAME_SHIFT]
        x = deformed(load(subtrees, s, u), q, 1.0 / h, mirror)
        turn = wp.mat33()
        if wp.static(given):
            turn = rotations[unit[s]] * q
        g, trusted = forces(x, h, mirror, turn, mu, lam, wp.where(wp.static(uniform), 0, subtrees.first[s]))
        if wp.static(not given):
            flagged[s] = wp.where(trusted, wp.uint8(0), wp.uint8(1))
        add(subtrees, s, g, f)

    return scatter_subtrees_shared
