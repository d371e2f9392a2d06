"""Which leaves of complete subtrees share their root's rotation within a tolerance, element by element.

The kernels that add forces decide this themselves (``native/near_leaves.h``). This one decides by the same rule and
writes the rotation that each leaf uses.
"""

import functools

import warp as wp

from warp_corot.kernels.elements.constitutive import symmetric
from warp_corot.kernels.elements.elements import (
    LEVEL_MASK,
    ForestElements,
    frame,
    gradient_of,
    load_node,
    local_gradient,
)
from warp_corot.kernels.math.rotation import quick_rotation
from warp_corot.kernels.modules import unique_kernel
from warp_corot.kernels.tables.shapes import fingerprint
from warp_corot.kernels.tables.subtree import LEAVES

wp.set_module_options({"enable_backward": False})

SUBTREE_LEVELS = wp.constant(3)


@functools.cache
def share_near_rotations(shape: int) -> wp.Kernel:
    """Give the root's rotation to the leaves of each subtree of a type in which it is near all of theirs."""
    # A leaf and its corner that stand on each of the root's four nodes.
    corners = [next((k, leaf.index(n)) for k, leaf in enumerate(LEAVES[shape]) if n in leaf) for n in range(4)]

    @unique_kernel()
    def share_near_rotations(
        # In
        roots: ForestElements,
        first: wp.array[wp.int32],
        elements: ForestElements,
        tolerance: float,
        u: wp.array[wp.vec4],
        # In and out
        rotations: wp.array[wp.mat33],
    ):
        _generated_from = wp.static(fingerprint(corners))
        s = wp.tid()
        # A subtree that is padding has no leaves of its own.
        for leaf in range(8):
            levels = (elements.code[first[s] + leaf] & LEVEL_MASK) - (roots.code[s] & LEVEL_MASK)
            if levels != SUBTREE_LEVELS:
                return
        u0 = load_node(u, elements.nodes[first[s] + wp.static(corners[0][0])][wp.static(corners[0][1])])
        u1 = load_node(u, elements.nodes[first[s] + wp.static(corners[1][0])][wp.static(corners[1][1])])
        u2 = load_node(u, elements.nodes[first[s] + wp.static(corners[2][0])][wp.static(corners[2][1])])
        u3 = load_node(u, elements.nodes[first[s] + wp.static(corners[3][0])][wp.static(corners[3][1])])
        q = frame(roots, s)
        r = quick_rotation(q + gradient_of(roots, s, u0, u1, u2, u3)) * wp.transpose(q)
        is_near = bool(True)
        for leaf in range(8):
            b = frame(elements, first[s] + leaf)
            turned = r * b
            # R^T F - I = R^T G + (R^T - I), in the leaf's frame.
            e = wp.transpose(turned) * local_gradient(elements, first[s] + leaf, u) + wp.transpose(turned - b) * b
            strain = symmetric(e)
            skew = e - strain
            # A comparison with NaN is false.
            is_near = is_near and wp.ddot(skew, skew) <= tolerance * tolerance and wp.ddot(strain, strain) <= 0.25
        if is_near:
            for leaf in range(8):
                rotations[first[s] + leaf] = r

    return share_near_rotations
