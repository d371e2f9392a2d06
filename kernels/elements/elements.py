"""Elements on the device: deformation gradients in, nodal forces out.

Two kinds of elements share one set of functions, chosen by the type of the struct: tetrahedra of the forest, whose
shape is a few bits, and general tetrahedra with a rest matrix each. Both work in a local frame Q (a proper rotation;
the identity for general elements): ``local_gradient`` gives G = (du/dX) Q, so that Q + G is the local-frame deformation
gradient F Q. Working from displacements keeps small strains free of the cancellation that positions would bring.
"""

import functools
from typing import Any

import warp as wp

from warp_corot.kernels.elements.shapes import columns_of, leaf_forces_of
from warp_corot.kernels.tables.shapes import FRAME_SHIFT, LEVEL_BITS, MIRROR_BIT, VOLUME

wp.set_module_options({"enable_backward": False})

LEVEL_MASK = wp.constant((1 << LEVEL_BITS) - 1)

columns0, columns1, columns2 = (columns_of(shape) for shape in range(3))
leaf_forces0, leaf_forces1, leaf_forces2 = (leaf_forces_of(shape) for shape in range(3))


@wp.struct
class ForestElements:
    """Tetrahedra of the bisected forest: four nodes and one integer each."""

    nodes: wp.array[wp.vec4i]  # [T] in Maubach order
    targets: wp.array[wp.vec4i]  # [T] where their forces are added: the nodes, or a slot each (see ``elements``)
    code: wp.array[wp.int32]  # [T] level | mirrored << 6 | frame << 7
    frames: wp.array[wp.mat33]  # [n_frames] proper local frames Q
    size: wp.array[wp.float32]  # [levels div 3] edge length h [m]


@wp.struct
class Subtrees:
    """Complete three-level subtrees of one type (see ``tables.subtree``), in groups of eight or one by one."""

    # Groups: [groups, 40], -1 past the last; one by one: [10, subtrees], CPU [subtrees, 10].
    nodes: wp.array2d[wp.int32]
    targets: wp.array2d[wp.int32]  # where their forces are added, as in ForestElements
    code: wp.array[wp.int32]  # [subtrees] shape code of the subtree's root
    first: wp.array[wp.int32]  # [subtrees] its first leaf among the mesh's elements
    frames: wp.array[wp.mat33]  # as ForestElements
    size: wp.array[wp.float32]


@wp.struct
class GeneralElements:
    """Tetrahedra of any shape, positively oriented."""

    nodes: wp.array[wp.vec4i]  # [T]
    targets: wp.array[wp.vec4i]  # [T] as in ForestElements
    rest_inverse: wp.array[wp.mat33]  # [T] inverse of the matrix of rest edges (x1-x0, x2-x0, x3-x0) [1/m]
    volume: wp.array[wp.float32]  # [T] rest volume [m^3]
    numbers: wp.array[wp.int32]  # [T] which of a mesh's elements they are; empty: all of them (CPU)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const float4 a = *reinterpret_cast<const float4*>(&wp::index(nodes, i));
    return wp::vec_t<3, wp::float32>(a.x, a.y, a.z);
#else
    const wp::vec_t<4, wp::float32>& a = wp::index(nodes, i);
    return wp::vec_t<3, wp::float32>(a[0], a[1], a[2]);
#endif
""")
def load_node(nodes: wp.array[wp.vec4], i: int) -> wp.vec3:
    """The vector of node i by one 16-byte load. Warp does not know that vec4 arrays are aligned and would make four
    loads.
    """
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    *reinterpret_cast<float4*>(&wp::index(nodes, i)) = make_float4(value[0], value[1], value[2], 0.0f);
#else
    wp::index(nodes, i) = wp::vec_t<4, wp::float32>(value[0], value[1], value[2], 0.0f);
#endif
""")
def store_node(nodes: wp.array[wp.vec4], i: int, value: wp.vec3):
    """Write the vector of node i by one 16-byte store."""
    ...


@wp.func
def shape_of(code: int):
    return (code & LEVEL_MASK) % 3


@wp.func
def mirror_sign(code: int):
    """-1 for an element whose Maubach frame is left-handed: its third column is turned round."""
    return 1.0 - 2.0 * float((code >> MIRROR_BIT) & 1)


@wp.func
def root_of(subtrees: Subtrees, s: int):
    """Half the edge length of a subtree's root [m], its frame Q, and ``mirror_sign``."""
    code = subtrees.code[s]
    h = 0.5 * subtrees.size[(code & LEVEL_MASK) // 3]
    mirror = mirror_sign(code)
    q = subtrees.frames[code >> FRAME_SHIFT]
    return h, q, mirror


@wp.func
def edge_of(elements: ForestElements, code: int):
    """The edge length of elements of a shape code [m]."""
    return elements.size[(code & LEVEL_MASK) // 3]


@wp.func
def edge_length(elements: ForestElements, t: int):
    return edge_of(elements, elements.code[t])


@wp.func
def frame(elements: ForestElements, t: int):
    return elements.frames[elements.code[t] >> FRAME_SHIFT]


@wp.func
def frame(elements: GeneralElements, t: int):
    return wp.mat33(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


@wp.func
def rest_volume(elements: ForestElements, t: int):
    h = edge_length(elements, t)
    shape = shape_of(elements.code[t])
    volume = wp.where(shape == 1, wp.static(VOLUME[1]), wp.static(VOLUME[0]))
    return h * h * h * wp.where(shape == 2, wp.static(VOLUME[2]), volume)


@wp.func
def rest_volume(elements: GeneralElements, t: int):
    return elements.volume[t]


@wp.func
def node_displacements(nodes: wp.vec4i, u: wp.array[wp.vec4]):
    return load_node(u, nodes[0]), load_node(u, nodes[1]), load_node(u, nodes[2]), load_node(u, nodes[3])


@wp.func
def gradient_of_code(elements: ForestElements, code: int, u0: wp.vec3, u1: wp.vec3, u2: wp.vec3, u3: wp.vec3):
    """G = (du/dX) Q [3, 3] of nodal displacements: sums and differences by type, divided by the edge length."""
    shape = shape_of(code)
    c0, c1, c2 = columns0(u0, u1, u2, u3)
    if shape == 1:
        c0, c1, c2 = columns1(u0, u1, u2, u3)
    elif shape == 2:
        c0, c1, c2 = columns2(u0, u1, u2, u3)
    inv_h = 1.0 / edge_of(elements, code)
    return wp.matrix_from_cols(c0 * inv_h, c1 * inv_h, c2 * (inv_h * mirror_sign(code)))


@wp.func
def gradient_of(elements: ForestElements, t: int, u0: wp.vec3, u1: wp.vec3, u2: wp.vec3, u3: wp.vec3):
    return gradient_of_code(elements, elements.code[t], u0, u1, u2, u3)


@wp.func
def gradient_of(elements: GeneralElements, t: int, u0: wp.vec3, u1: wp.vec3, u2: wp.vec3, u3: wp.vec3):
    return wp.matrix_from_cols(u1 - u0, u2 - u0, u3 - u0) * elements.rest_inverse[t]


@wp.func
def local_gradient(elements: Any, t: int, u: wp.array[wp.vec4]):
    """G of element t under nodal displacements u."""
    u0, u1, u2, u3 = node_displacements(elements.nodes[t], u)
    return gradient_of(elements, t, u0, u1, u2, u3)


#: Adds ``force`` to ``f[node]``: one 16-byte reduction where the card has them (a global reduction costs about the same
#: scalar or vector), else three scalar ones; a plain sum on the CPU, which has one thread.
ADD_FORCE = """
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
    asm volatile("red.global.add.v4.f32 [%0], {%1, %2, %3, %4};"
        :: "l"(&wp::index(f, node)), "f"(force[0]), "f"(force[1]), "f"(force[2]), "f"(0.0f) : "memory");
#else
    wp::vec_t<4, wp::float32>& sum = wp::index(f, node);
    #if defined(__CUDA_ARCH__)
        for (int i = 0; i < 3; ++i) atomicAdd(&sum[i], force[i]);
    #else
        for (int i = 0; i < 3; ++i) sum[i] += force[i];
    #endif
#endif
"""


@wp.func_native(ADD_FORCE)
def add_force(f: wp.array[wp.vec4], node: int, force: wp.vec3): ...


@wp.func
def nodal_forces(elements: ForestElements, t: int, p: wp.mat33):
    """The forces -V P grad N_i on the four nodes [N], where P = P_world Q is the local-frame first Piola-Kirchhoff
    stress [Pa]."""
    code = elements.code[t]
    shape = shape_of(code)
    area = rest_volume(elements, t) / edge_length(elements, t)
    p0 = wp.vec3(p[0, 0], p[1, 0], p[2, 0]) * area
    p1 = wp.vec3(p[0, 1], p[1, 1], p[2, 1]) * area
    p2 = wp.vec3(p[0, 2], p[1, 2], p[2, 2]) * (area * mirror_sign(code))
    f0, f1, f2, f3 = leaf_forces0(p0, p1, p2)
    if shape == 1:
        f0, f1, f2, f3 = leaf_forces1(p0, p1, p2)
    elif shape == 2:
        f0, f1, f2, f3 = leaf_forces2(p0, p1, p2)
    return f0, f1, f2, f3


@wp.func
def nodal_forces(elements: GeneralElements, t: int, p: wp.mat33):
    h = (-elements.volume[t]) * p * wp.transpose(elements.rest_inverse[t])
    f1 = wp.vec3(h[0, 0], h[1, 0], h[2, 0])
    f2 = wp.vec3(h[0, 1], h[1, 1], h[2, 1])
    f3 = wp.vec3(h[0, 2], h[1, 2], h[2, 2])
    return -(f1 + f2 + f3), f1, f2, f3


@wp.func
def add_nodal_forces(elements: Any, t: int, p: wp.mat33, places: wp.vec4i, f: wp.array[wp.vec4]):
    """Add the nodal forces of a local-frame first Piola-Kirchhoff stress [Pa] at four given places."""
    f0, f1, f2, f3 = nodal_forces(elements, t, p)
    add_force(f, places[0], f0)
    add_force(f, places[1], f1)
    add_force(f, places[2], f2)
    add_force(f, places[3], f3)


@wp.func
def scatter_stress(elements: Any, t: int, p: wp.mat33, f: wp.array[wp.vec4]):
    """Add the nodal forces of a local-frame first Piola-Kirchhoff stress [Pa]."""
    add_nodal_forces(elements, t, p, elements.targets[t], f)


# --- forces of neighbouring elements, added up before they go to memory ----------------------------------------------


@functools.cache
def add_four_forces(rounds: int) -> wp.Function:
    """Add an element's forces to its nodes', where neighbouring threads have neighbouring elements.

    On CUDA a sum in memory costs more than everything else, and consecutive elements mostly share nodes. So a thread
    passes its forces on shared nodes to the next thread, two by two, then four by four, for a number of ``rounds``. Of
    four sums an element, 2.5 are left after one round and 2.0 after two in the order of a forest's leaves; 2.95 and
    2.46 in the order of ``add_soft_grid``.
    """
    snippet = f"""
    int at[4];
    float sum[4][3];
    const wp::vec_t<3, wp::float32>* const given[4] = {{&f0, &f1, &f2, &f3}};
    for (int k = 0; k < 4; ++k) {{
        at[k] = nodes[k];
        for (int axis = 0; axis < 3; ++axis) sum[k][axis] = (*given[k])[axis];
    }}
#if defined(__CUDA_ARCH__)
    const unsigned all = 0xffffffffu;
    if (__activemask() == all) {{
        #pragma unroll
        for (int mask = 1; mask < {1 << rounds}; mask *= 2) {{
            const bool gives = (threadIdx.x & mask) != 0;
            bool is_given[4] = {{false, false, false, false}};
            #pragma unroll
            for (int k = 0; k < 4; ++k) {{
                const int node = __shfl_xor_sync(all, at[k], mask);
                const float x = __shfl_xor_sync(all, sum[k][0], mask);
                const float y = __shfl_xor_sync(all, sum[k][1], mask);
                const float z = __shfl_xor_sync(all, sum[k][2], mask);
                #pragma unroll
                for (int j = 0; j < 4; ++j) {{
                    const bool same = node >= 0 && at[j] == node;
                    is_given[j] = is_given[j] || (same && gives);
                    if (same && !gives) {{ sum[j][0] += x; sum[j][1] += y; sum[j][2] += z; }}
                }}
            }}
            #pragma unroll
            for (int j = 0; j < 4; ++j) if (is_given[j]) at[j] = -1;
        }}
    }}
#endif
    const auto add = [&](int node, const float* force) {{ {ADD_FORCE} }};
    for (int k = 0; k < 4; ++k) if (at[k] >= 0) add(at[k], sum[k]);
    """

    @wp.func_native(snippet)
    def add_four_forces(f: wp.array[wp.vec4], nodes: wp.vec4i, f0: wp.vec3, f1: wp.vec3, f2: wp.vec3, f3: wp.vec3): ...

    return add_four_forces


# --- sums in one order -----------------------------------------------------------------------------------------------
#
# Sums of forces in one order, in whatever order threads run.
#
# Atomic sums differ a little from run to run. Here each unit of work (an element, a subtree, a group of subtrees) has
# a slot of its own for each of its nodes, and a node adds up its slots. Slots stand in the order of the units,
# because scattered writes cost five times as much as scattered reads.


@wp.kernel(enable_backward=False)
def gather_slots(
    # In
    starts: wp.array[wp.int32],
    order: wp.array[wp.int32],
    clears: int,
    # In and out
    slots: wp.array[wp.vec4],
    # Out
    f: wp.array[wp.vec4],
):
    """Add each node's slots to its force; then they are zero if this ``clears`` them."""
    i = wp.tid()
    total = load_node(f, i)
    for at in range(starts[i], starts[i + 1]):
        total += load_node(slots, order[at])
        if clears != 0:
            store_node(slots, order[at], wp.vec3())
    store_node(f, i, total)
