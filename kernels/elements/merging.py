"""Nodal forces of neighbouring elements, added up before they go to memory."""

import functools

import warp as wp

from .elements import ADD_FORCE

wp.set_module_options({"enable_backward": False})


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
