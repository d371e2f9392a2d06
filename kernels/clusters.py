"""Forces of elements in clusters, on CUDA: a cluster's nodes meet in shared memory, and each is read and added to once.

A thread block takes as many elements as it has threads, which follow one another in the order of the tree and so share
most of their nodes: some 0.6 nodes an element are left of four. Each thread writes an element's four forces to slots;
then each thread sums the slots of a node, in a settled order, and adds the sum to memory.
"""

import functools
from typing import Any

import warp as wp

from .block import LOAD, STORE, shared_vectors, synchronize_block
from .elements import add_force, frame, gradient_of, load_node, nodal_forces
from .repair import LeftOut, append

wp.set_module_options({"enable_backward": False})

#: Elements of a cluster, and threads of its block.
CLUSTER = 128
CORNERS = 4 * CLUSTER
#: A node's first place in ``Clusters.slots``, from the cluster's first on, and how many it has, in one integer.
FIRST_BITS = 16


@wp.struct
class Clusters:
    """Elements by clusters."""

    elements: wp.array[wp.int32]  # [clusters * CLUSTER] which of a mesh's elements, -1 past the last
    corners: wp.array[wp.uint64]  # the same; which of the cluster's nodes its four are, 16 bits each
    begin: wp.array[wp.int32]  # [clusters + 1] where a cluster's nodes begin in the next two
    nodes: wp.array[wp.int32]
    sums: wp.array[wp.int32]
    slots: wp.array[wp.uint16]  # [clusters * CORNERS] a node's after another's


@wp.func
def corner(word: wp.uint64, k: int):
    return int((word >> wp.uint64(16 * k)) & wp.uint64(0xFFFF))


@functools.cache
def scatter_clusters(Elements: Any, stress: wp.Function) -> wp.Kernel:
    """Add the elastic nodal forces of a law to f; launch with block_dim CLUSTER and whole blocks.

    ``stress`` gives P Q and whether it may be trusted; elements where it may not are put on a list.
    """
    displacement, slot = shared_vectors(CORNERS, "displacements"), shared_vectors(CORNERS, "forces")

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def scatter_clusters(
        # In
        clusters: Clusters,
        elements: Elements,
        mu: wp.array[wp.float32],
        lam: wp.array[wp.float32],
        stride: int,
        u: wp.array[wp.vec4],
        # Out
        f: wp.array[wp.vec4],
        left_out: LeftOut,
    ):
        i = wp.tid()
        cluster = i // CLUSTER
        thread = i % CLUSTER
        begin = clusters.begin[cluster]
        count = clusters.begin[cluster + 1] - begin
        t = clusters.elements[i]
        place = thread
        while place < count:
            displacement(wp.static(STORE), place, load_node(u, clusters.nodes[begin + place]))
            place += CLUSTER
        synchronize_block()
        if t >= 0:
            word = clusters.corners[i]
            g = gradient_of(
                elements,
                t,
                displacement(wp.static(LOAD), corner(word, 0), wp.vec3()),
                displacement(wp.static(LOAD), corner(word, 1), wp.vec3()),
                displacement(wp.static(LOAD), corner(word, 2), wp.vec3()),
                displacement(wp.static(LOAD), corner(word, 3), wp.vec3()),
            )
            p, trusted = stress(g, frame(elements, t), mu[t * stride], lam[t * stride])
            if not trusted:
                p = wp.mat33()
                append(left_out, t, 1)
            f0, f1, f2, f3 = nodal_forces(elements, t, p)
            slot(wp.static(STORE), 4 * thread, f0)
            slot(wp.static(STORE), 4 * thread + 1, f1)
            slot(wp.static(STORE), 4 * thread + 2, f2)
            slot(wp.static(STORE), 4 * thread + 3, f3)
        synchronize_block()
        place = thread
        while place < count:
            about = clusters.sums[begin + place]
            k = CORNERS * cluster + (about & wp.static((1 << FIRST_BITS) - 1))
            end = k + (about >> wp.static(FIRST_BITS))
            force = wp.vec3()
            while k < end:
                force += slot(wp.static(LOAD), int(clusters.slots[k]), wp.vec3())
                k += 1
            add_force(f, clusters.nodes[begin + place], force)
            place += CLUSTER

    return scatter_clusters
