"""Forces of elements in clusters, on CUDA: a cluster's nodes meet in shared memory, and each is read and added to once.

A thread block takes as many elements as it has threads, which follow one another in the order of the tree and so share
most of their nodes: some 0.6 nodes an element are left of four. Each thread writes an element's four forces to slots;
then each thread sums up to eight slots of a node, in a settled order, and adds the sum to memory.
"""

import functools
from typing import Any

import warp as wp

from .block import LOAD, LOAD_BYTES, STORE, number_in, shared_vectors, synchronize_block
from .block_layout import NUMBERS
from .elements import add_force, frame, gradient_of, load_node, nodal_forces

wp.set_module_options({"enable_backward": False})

#: Elements of a cluster, and threads of its block.
CLUSTER = 128
CORNERS = 4 * CLUSTER
#: Blocks that a multiprocessor's registers must have room for.
RESIDENT = 8


@wp.struct
class Clusters:
    """Elements by clusters."""

    elements: wp.array[wp.int32]  # [clusters * CLUSTER] which of a mesh's elements, -1 past the last
    corners: wp.array[wp.uint64]  # the same; which of the cluster's nodes its four are, 16 bits each
    begin: wp.array[wp.int32]  # [clusters + 1] where a cluster's tasks begin
    nodes: wp.array[wp.int32]  # [tasks] a cluster's nodes; those with more slots come again after all of these
    slots: wp.array2d[wp.uint64]  # [2, tasks] four slots each, the zero one past the last, in bytes


@functools.cache
def scatter_clusters(Elements: Any, stress: wp.Function) -> wp.Kernel:
    """Add the nodal forces of a law of ``constitutive`` to f; launch with block_dim CLUSTER and whole blocks."""
    displacement, slot = shared_vectors(CORNERS, "displacements"), shared_vectors(CORNERS + 1, "forces")

    # What is out of line is rarely run, and shall not take registers from all.
    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, launch_bounds=(CLUSTER, RESIDENT))
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
    ):
        i = wp.tid()
        cluster = i // CLUSTER
        thread = i % CLUSTER
        begin = clusters.begin[cluster]
        count = clusters.begin[cluster + 1] - begin
        t = clusters.elements[i]
        numbers0 = wp.uint64(0)
        numbers1 = wp.uint64(0)
        if thread < count:
            # Read early, so that nobody waits for them.
            numbers0 = clusters.slots[0, begin + thread]
            numbers1 = clusters.slots[1, begin + thread]
        place = thread
        while place < count:
            displacement(wp.static(STORE), place, load_node(u, clusters.nodes[begin + place]))
            place += CLUSTER
        if thread == 0:
            slot(wp.static(STORE), CORNERS, wp.vec3())
        synchronize_block()
        if t >= 0:
            word = clusters.corners[i]
            g = gradient_of(
                elements,
                t,
                displacement(wp.static(LOAD), number_in(word, 0), wp.vec3()),
                displacement(wp.static(LOAD), number_in(word, 1), wp.vec3()),
                displacement(wp.static(LOAD), number_in(word, 2), wp.vec3()),
                displacement(wp.static(LOAD), number_in(word, 3), wp.vec3()),
            )
            q = frame(elements, t)
            p = q * stress(wp.transpose(q) * g, mu[t * stride], lam[t * stride])
            f0, f1, f2, f3 = nodal_forces(elements, t, p)
            slot(wp.static(STORE), thread, f0)
            slot(wp.static(STORE), thread + CLUSTER, f1)
            slot(wp.static(STORE), thread + 2 * CLUSTER, f2)
            slot(wp.static(STORE), thread + 3 * CLUSTER, f3)
        synchronize_block()
        place = thread
        while place < count:
            if place >= CLUSTER:
                numbers0 = clusters.slots[0, begin + place]
                numbers1 = clusters.slots[1, begin + place]
            force = wp.vec3()
            for k in range(wp.static(NUMBERS)):
                force += slot(wp.static(LOAD_BYTES), number_in(numbers0, k), force)
            for k in range(wp.static(NUMBERS)):
                force += slot(wp.static(LOAD_BYTES), number_in(numbers1, k), force)
            add_force(f, clusters.nodes[begin + place], force)
            place += CLUSTER

    return scatter_clusters
