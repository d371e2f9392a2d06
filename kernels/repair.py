"""Forces of the subtrees that the fast kernels left out: leaf by leaf with the rotation that is right for every F.

Which those are is a byte a subtree, read eight at a time: nearly always all are zero. A group of eight subtrees is one
thread's, so that where each group has a slot of its own for its forces, their order is settled.
"""

import warp as wp

from .constitutive import corotated_strain, hooke
from .elements import ForestElements, frame, local_gradient, scatter_stress
from .rotation import byers_xu

wp.set_module_options({"enable_backward": False})

#: Subtrees that one thread looks after; ``flagged`` has a multiple of these.
SUBTREES = 8
LEAVES = 8


@wp.func
def is_flagged(flags: wp.uint64, member: int):
    return ((flags >> wp.uint64(8 * member)) & wp.uint64(255)) != wp.uint64(0)


@wp.func
def is_left_out(flags: wp.uint64, leaf: int):
    """Whether the ``leaf``-th of the 64 leaves of eight subtrees was."""
    return ((flags >> wp.uint64(leaf)) & wp.uint64(1)) != wp.uint64(0)


@wp.func
def scatter_turned(
    elements: ForestElements, t: int, r: wp.mat33, mu: float, lam: float, u: wp.array[wp.vec4], f: wp.array[wp.vec4]
):
    """Add the forces of element t with r, the rotation of its F Q."""
    strain = corotated_strain(local_gradient(elements, t, u), frame(elements, t), r)
    scatter_stress(elements, t, r * hooke(strain, mu, lam), f)


@wp.kernel(enable_backward=False)
def repair_own(
    # In
    flagged: wp.array[wp.uint64],
    first: wp.array[wp.int32],
    elements: ForestElements,
    mu: wp.array[wp.float32],
    lam: wp.array[wp.float32],
    stride: int,
    u: wp.array[wp.vec4],
    # Out
    f: wp.array[wp.vec4],
):
    """Every leaf with its own rotation."""
    i = wp.tid()
    flags = flagged[i]
    if flags == wp.uint64(0):
        return
    leaf = int(0)
    while leaf < SUBTREES * LEAVES:
        member = leaf // LEAVES
        if is_left_out(flags, leaf):
            t = first[SUBTREES * i + member] + leaf % LEAVES
            r = byers_xu(frame(elements, t) + local_gradient(elements, t, u))
            scatter_turned(elements, t, r, mu[t * stride], lam[t * stride], u, f)
        leaf += 1


@wp.kernel(enable_backward=False)
def repair_shared(
    # In
    flagged: wp.array[wp.uint64],
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
    """Every leaf with the rotation of its subtree's root."""
    i = wp.tid()
    flags = flagged[i]
    if flags == wp.uint64(0):
        return
    member = int(0)
    while member < SUBTREES:
        if is_flagged(flags, member):
            s = SUBTREES * i + member
            q = frame(roots, s)
            rotation = byers_xu(q + local_gradient(roots, s, u)) * wp.transpose(q)
            leaf = int(0)
            while leaf < LEAVES:
                t = first[s] + leaf
                scatter_turned(elements, t, rotation * frame(elements, t), mu[t * stride], lam[t * stride], u, f)
                leaf += 1
        member += 1
