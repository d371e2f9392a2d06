"""The tables of clusters found on the device, for meshes that change; see ``single.Clusters``.

A thread block for each cluster finds its nodes by a hash table, then gives each a place: first the nodes of more than
four corners, then the others, so that the threads of a warp have similar sums. Further slots of a node come after all
of these. On a CPU one thread does all that.
"""

import functools

import warp as wp

from warp_corot.kernels.modules import unique_kernel
from warp_corot.kernels.tables.cluster_layout import NUMBERS, QUAD_BYTES, TASK_SLOTS, ClusterLayout

from .single import Clusters

wp.set_module_options({"enable_backward": False})


def _table_snippet(layout: ClusterLayout) -> str:
    size, corners = layout.elements, layout.corners
    places = 1 << corners.bit_length()  # of the hash table: at most half are taken
    return f"""
#if defined(__CUDA_ARCH__)
    #define STAY __shared__
    #define TOGETHER __syncthreads()
    #define CLAIM(at, node) atomicCAS(&at, -1, node)
    #define COUNT(at) atomicAdd(&at, 1)
    const int thread = threadIdx.x, threads = blockDim.x;
#else
    #define STAY static
    #define TOGETHER
    #define CLAIM(at, node) (at == -1 ? (at = node, -1) : at)
    #define COUNT(at) at++
    const int thread = 0, threads = 1;
#endif
    #define EACH(i, n) for (int i = thread; i < n; i += threads)
    STAY int found[{places}], degree[{places}], sums[2][{places}];
    EACH(k, {places}) {{ found[k] = -1; degree[k] = 0; }}
    TOGETHER;
    // Each corner's place in the table, and its rank among those on the same node.
    STAY short place_of[{corners}], rank_of[{corners}];
    EACH(k, {corners}) {{
        const int i = {size} * cluster + k % {size};
        if (i < count) {{
            const int node = wp::index(nodes, i)[k / {size}];
            int place = (int)((unsigned)node * 2654435761u >> {32 - places.bit_length() + 1});
            for (;;) {{
                const int there = CLAIM(found[place], node);
                if (there == -1 || there == node) break;
                place = (place + 1) % {places};
            }}
            place_of[k] = place;
            rank_of[k] = COUNT(degree[place]);
        }}
    }}
    TOGETHER;
    // Three sums over the table at once, ten bits each: busy nodes, others, and further tasks of a node.
    EACH(k, {places}) {{
        const int d = degree[k];
        sums[0][k] = (d > {NUMBERS}) | (d > 0 && d <= {NUMBERS}) << 10 | (d > 0 ? (d - 1) / {TASK_SLOTS} : 0) << 20;
    }}
    int from = 0;
    TOGETHER;
    for (int step = 1; step < {places}; step *= 2) {{
        EACH(k, {places}) sums[1 - from][k] = sums[from][k] + (k >= step ? sums[from][k - step] : 0);
        from = 1 - from;
        TOGETHER;
    }}
    const int all = sums[from][{places} - 1];
    const int busy = all & 1023, node_count = busy + (all >> 10 & 1023);
    const int begin = wp::index(clusters.begin, cluster);
    if (thread == 0) {{
        wp::index(clusters.node_count, cluster) = node_count;
        wp::index(clusters.task_count, cluster) = node_count + (all >> 20);
    }}
    // Nodes' places in the cluster, which take those of the degrees; tasks with no slot yet.
    EACH(k, {places}) {{
        const int d = degree[k], sum = sums[from][k];
        if (d > 0) {{
            const int place = d > {NUMBERS} ? (sum & 1023) - 1 : busy + (sum >> 10 & 1023) - 1;
            const int pieces = (d - 1) / {TASK_SLOTS}, more = node_count + (sum >> 20) - pieces;
            degree[k] = place;
            sums[1 - from][k] = more;
            const unsigned long long zero = {QUAD_BYTES * corners}ull;
            const unsigned long long four = zero | zero << 16 | zero << 32 | zero << 48;
            for (int piece = 0; piece <= pieces; ++piece) {{
                const int task = begin + (piece == 0 ? place : more + piece - 1);
                wp::index(clusters.nodes, task) = found[k];
                wp::index(clusters.slots, task) = wp::vec_t<2, wp::uint64>(four, four);
            }}
        }}
    }}
    TOGETHER;
    EACH(k, {corners}) {{
        const int i = {size} * cluster + k % {size};
        if (i < count) {{
            const int at = place_of[k], place = degree[at], piece = rank_of[k] / {TASK_SLOTS};
            const int task = begin + (piece == 0 ? place : sums[1 - from][at] + piece - 1);
            unsigned short* slots = (unsigned short*)&wp::index(clusters.slots, task);
            slots[rank_of[k] % {TASK_SLOTS}] = {QUAD_BYTES} * k;
            unsigned short* of = (unsigned short*)&wp::index(clusters.corners, i);
            of[k / {size}] = {QUAD_BYTES} * place;
        }}
    }}
    TOGETHER;
    #undef EACH
    #undef COUNT
    #undef CLAIM
    #undef STAY
    #undef TOGETHER
"""


@functools.cache
def find_clusters(layout: ClusterLayout) -> wp.Kernel:
    """Find the tables of all clusters; a thread block each, of ``layout.threads`` threads, on a CPU a thread each.

    ``counts`` says at ``row`` how many elements there are, ``goes`` whether anything is to be done.
    """

    @wp.func_native(_table_snippet(layout))
    def write_tables(cluster: int, count: int, nodes: wp.array[wp.vec4i], clusters: Clusters): ...

    @unique_kernel(grid_stride=False)
    def find_clusters(
        # In
        lanes: int,
        nodes: wp.array[wp.vec4i],
        goes: wp.array[wp.int32],
        # Out
        clusters: Clusters,
    ):
        if goes[0] != 0:
            write_tables(wp.tid() // lanes, clusters.count[0], nodes, clusters)

    return find_clusters
