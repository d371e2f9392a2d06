"""Transfers between levels, and the conversion of the cycle's input and output, on the CPU: those of ``cycle`` without
the first step from zero, one thread for each world. A launch over all nodes took longer to count them than to move
their values.
"""

import warp as wp

from warp_corot.kernels.elements.lanes import COMPILER_FLAGS, on_cpu

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": COMPILER_FLAGS})

#: The vectors of one world, and its flags of free nodes.
_WORLD = """
    const auto vectors = [&](const auto& all, int nodes) {
        return reinterpret_cast<four*>(all.data) + (long long)world * nodes;
    };
    const unsigned char* is_free = free.data + (long long)world * ranks;
    const four zero = {0.0f, 0.0f, 0.0f, 0.0f};
"""


@wp.func_native(
    on_cpu(
        _WORLD,
        """
    const four* from = vectors(given, mesh_nodes);
    four* to = vectors(r, ranks);
    for (int i = 0; i < ranks; ++i) to[i] = nodes.data[i] < mesh_nodes && is_free[i] ? from[nodes.data[i]] : zero;
""",
    )
)
def take_nodes(
    world: int,
    ranks: int,
    mesh_nodes: int,
    nodes: wp.array[wp.int32],
    free: wp.array[wp.uint8],
    given: wp.array[wp.vec4],
    r: wp.array[wp.vec4],
): ...


@wp.func_native(
    on_cpu(
        _WORLD,
        """
    const four *from = vectors(z, ranks), *held = vectors(given, mesh_nodes);
    four* to = vectors(result, mesh_nodes);
    for (int i = 0; i < ranks; ++i) {
        const int node = nodes.data[i];
        if (node < mesh_nodes) to[node] = is_free[i] ? from[i] : held[node];
    }
""",
    )
)
def hand_nodes(
    world: int,
    ranks: int,
    mesh_nodes: int,
    nodes: wp.array[wp.int32],
    free: wp.array[wp.uint8],
    given: wp.array[wp.vec4],
    z: wp.array[wp.vec4],
    result: wp.array[wp.vec4],
): ...


@wp.func_native(
    on_cpu(
        _WORLD,
        """
    const four* from = vectors(residual, fine);
    four* to = vectors(r, coarse);
    for (int i = 0; i < coarse; ++i) {
        four total = zero;
        for (int p = starts.data[i]; p < starts.data[i + 1]; ++p) total += from[midpoints.data[p]];
        to[i] = is_free[i] ? 0.5f * total + from[i] : zero;
    }
""",
    )
)
def restrict_nodes(
    world: int,
    ranks: int,
    coarse: int,
    fine: int,
    free: wp.array[wp.uint8],
    starts: wp.array[wp.int32],
    midpoints: wp.array[wp.int32],
    residual: wp.array[wp.vec4],
    r: wp.array[wp.vec4],
): ...


@wp.func_native(
    on_cpu(
        _WORLD,
        """
    const four* from = vectors(correction, coarse);
    four* to = vectors(z, fine);
    for (int i = 0; i < coarse; ++i)
        if (is_free[i]) to[i] += from[i];
    for (int i = coarse; i < fine; ++i)
        if (is_free[i]) to[i] += 0.5f * (from[ends.data[i][0]] + from[ends.data[i][1]]);
""",
    )
)
def prolongate_nodes(
    world: int,
    ranks: int,
    coarse: int,
    fine: int,
    free: wp.array[wp.uint8],
    ends: wp.array[wp.vec2i],
    correction: wp.array[wp.vec4],
    z: wp.array[wp.vec4],
): ...


@wp.kernel(enable_backward=False)
def take_in(
    # In
    ranks: int,
    mesh_nodes: int,
    nodes: wp.array[wp.int32],
    free: wp.array[wp.uint8],
    given: wp.array[wp.vec4],
    # Out
    r: wp.array[wp.vec4],
):
    """Sort the residual by rank, zero at held nodes."""
    take_nodes(wp.tid(), ranks, mesh_nodes, nodes, free, given, r)


@wp.kernel(enable_backward=False)
def hand_out(
    # In
    ranks: int,
    mesh_nodes: int,
    nodes: wp.array[wp.int32],
    free: wp.array[wp.uint8],
    given: wp.array[wp.vec4],
    z: wp.array[wp.vec4],
    # Out
    result: wp.array[wp.vec4],
):
    """As ``cycle.hand_out``."""
    hand_nodes(wp.tid(), ranks, mesh_nodes, nodes, free, given, z, result)


@wp.kernel(enable_backward=False)
def restrict_residual(
    # In
    ranks: int,
    coarse: int,
    fine: int,
    free: wp.array[wp.uint8],
    starts: wp.array[wp.int32],
    midpoints: wp.array[wp.int32],
    residual: wp.array[wp.vec4],
    # Out
    r: wp.array[wp.vec4],
):
    """P^T of the finer level's residual, zero at held nodes."""
    restrict_nodes(wp.tid(), ranks, coarse, fine, free, starts, midpoints, residual, r)


@wp.kernel(enable_backward=False)
def prolongate_correction(
    # In
    ranks: int,
    coarse: int,
    fine: int,
    free: wp.array[wp.uint8],
    ends: wp.array[wp.vec2i],
    correction: wp.array[wp.vec4],
    # In and out
    z: wp.array[wp.vec4],
):
    """As ``cycle.prolongate_correction``."""
    prolongate_nodes(wp.tid(), ranks, coarse, fine, free, ends, correction, z)
