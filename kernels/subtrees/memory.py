"""Memory of subtrees on CUDA: ten displacements of each subtree, and sums of forces at its ten nodes.

Subtrees in groups of eight read each displacement of the group once, and add up its forces in shared memory first. A
table tells each lane which slots to add up, so that each node of a group takes one atomic addition.
"""

import functools

import warp as wp

from warp_corot.kernels.elements.elements import ADD_FORCE, Subtrees, add_force, load_node
from warp_corot.kernels.tables.subtree import GROUP_NODES, SLOT_STRIDE, group_slots, group_sources

from .forces import mat10

wp.set_module_options({"enable_backward": False})

#: Threads of a block, which is the block_dim of launches.
BLOCK = 128


def _numbers(values: list[int]) -> str:
    return ", ".join(map(str, values))


def _table(name: str, rows: list[list[int]]) -> str:
    numbers = ", ".join(f"{{{_numbers(row)}}}" for row in rows)
    return f"static const unsigned char {name}[{len(rows)}][{len(rows[0])}] = {{{numbers}}};"


def _load_snippet(shapes: tuple[int, ...]) -> str:
    """Read each of a group's displacements once into shared memory, and give every lane the ten of its subtree."""
    slots = [[place for ten in group_slots(shape) for place in ten] for shape in shapes]
    return f"""
#if defined(__CUDA_ARCH__)
    {_table("slot", slots)}
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
        const float4 a = staged[g][slot[row][10 * lane + k]];
        x.data[k][0] = a.x; x.data[k][1] = a.y; x.data[k][2] = a.z;
    }}
    return x;
#else
    return wp::mat_t<10, 3, wp::float32>();
#endif
"""


def _merge_snippet(shapes: tuple[int, ...]) -> str:
    """Sum a group's forces in shared memory and add each node's sum to memory once; a lane sums every eighth node."""
    sources = [group_sources(shape) for shape in shapes]
    empty = 10  # the spare slot of the first subtree, kept zero
    tables: list[list[int]] = [[] for _ in shapes]
    rounds = ""
    for r in range(GROUP_NODES // 8):
        lists = [of_shape[8 * r : 8 * r + 8] for of_shape in sources]
        longest = max(len(slots) for of_shape in lists for slots in of_shape)
        rounds += f"""
    {{
        float4 sum = make_float4(0.f, 0.f, 0.f, 0.f);
        #pragma unroll
        for (int m = 0; m < {longest}; ++m) {{
            const float4 a = part[g][source[row][{len(tables[0])} + 8 * m + lane]];
            sum.x += a.x; sum.y += a.y; sum.z += a.z;
        }}
        const int node = wp::index(targets, group, {8 * r} + lane);
        const wp::vec_t<3, wp::float32> force(sum.x, sum.y, sum.z);
        if (node >= 0) {{ {ADD_FORCE} }}
    }}"""
        for table, of_shape in zip(tables, lists, strict=True):
            table += [slots[m] if m < len(slots) else empty for m in range(longest) for slots in of_shape]
    return f"""
#if defined(__CUDA_ARCH__)
    {_table("source", tables)}
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
def group_memory(shapes: tuple[int, ...]) -> tuple[wp.Function, wp.Function]:
    """Functions by which subtrees in groups read displacements and write forces; ``row`` is the shape's place."""

    @wp.func_native(_load_snippet(shapes))
    def load_group(nodes: wp.array2d[wp.int32], group: int, row: int, u: wp.array[wp.vec4]) -> mat10: ...

    @wp.func_native(_merge_snippet(shapes))
    def merge_group(targets: wp.array2d[wp.int32], group: int, row: int, x: mat10, f: wp.array[wp.vec4]): ...

    return load_group, merge_group


@wp.func
def load_single(subtrees: Subtrees, s: int, u: wp.array[wp.vec4]):
    x = mat10()
    for k in range(10):
        x[k] = load_node(u, subtrees.nodes[k, s])
    return x


@wp.func
def add_single(subtrees: Subtrees, s: int, g: mat10, f: wp.array[wp.vec4]):
    for k in range(10):
        add_force(f, subtrees.targets[k, s], g[k])


@functools.cache
def memory_of(shape: int, grouped: bool) -> tuple[wp.Function, wp.Function]:
    """Functions by which a subtree reads displacements and writes forces."""
    if not grouped:
        return load_single, add_single
    load_group, merge_group = group_memory((shape,))

    @wp.func
    def load(subtrees: Subtrees, s: int, u: wp.array[wp.vec4]):
        return load_group(subtrees.nodes, s // 8, 0, u)

    @wp.func
    def add(subtrees: Subtrees, s: int, g: mat10, f: wp.array[wp.vec4]):
        merge_group(subtrees.targets, s // 8, 0, g, f)

    return load, add
