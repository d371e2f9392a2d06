"""Vectors of Lanczos' iteration on M^-1/2 K M^-1/2, one vec4 a node: what it does between two evaluations of forces.

Sums are float64, and always in the same order: a few partial sums each, which the host adds up.
"""

import warp as wp

from .elements import load_node, store_node

wp.set_module_options({"enable_backward": False})

#: Partial sums; each is one thread's.
PARTIAL_SUMS = 4096


@wp.kernel(enable_backward=False)
def largest_motions(inverse_mass: wp.array[wp.float32], q: wp.array[wp.vec4], largest: wp.array[wp.float32]):
    """Largest component of M^-1/2 q among every ``len(largest)``-th node."""
    part = wp.tid()
    most = float(0.0)
    i = part
    while i < q.shape[0]:
        a = wp.sqrt(inverse_mass[i]) * load_node(q, i)
        most = wp.max(most, wp.max(wp.abs(a[0]), wp.max(wp.abs(a[1]), wp.abs(a[2]))))
        i += largest.shape[0]
    largest[part] = most


@wp.kernel(enable_backward=False)
def probe_motion(scale: float, inverse_mass: wp.array[wp.float32], q: wp.array[wp.vec4], u: wp.array[wp.vec4]):
    """u = scale M^-1/2 q."""
    i = wp.tid()
    store_node(u, i, (scale * wp.sqrt(inverse_mass[i])) * load_node(q, i))


@wp.kernel(enable_backward=False)
def apply_stiffness(
    # In
    scale: float,
    beta: float,
    inverse_mass: wp.array[wp.float32],
    f: wp.array[wp.vec4],
    before: wp.array[wp.vec4],
    # Out
    w: wp.array[wp.vec4],
):
    """w = M^-1/2 K M^-1/2 q - beta before, from the forces f = -scale K M^-1/2 q."""
    i = wp.tid()
    store_node(w, i, (-wp.sqrt(inverse_mass[i]) / scale) * load_node(f, i) - beta * load_node(before, i))


@wp.kernel(enable_backward=False)
def add_scaled(factor: float, a: wp.array[wp.vec4], b: wp.array[wp.vec4]):
    """b += factor a."""
    i = wp.tid()
    store_node(b, i, load_node(b, i) + factor * load_node(a, i))


@wp.kernel(enable_backward=False)
def scale_by(factor: float, a: wp.array[wp.vec4]):
    i = wp.tid()
    store_node(a, i, factor * load_node(a, i))


@wp.kernel(enable_backward=False)
def inner_products(a: wp.array[wp.vec4], b: wp.array[wp.vec4], sums: wp.array[wp.float64]):
    """Partial sums of a . b."""
    part = wp.tid()
    total = wp.float64(0.0)
    i = part
    while i < a.shape[0]:
        x = load_node(a, i)
        y = load_node(b, i)
        for axis in range(3):
            # What fits into float32 need not do so once multiplied.
            total += wp.float64(x[axis]) * wp.float64(y[axis])
        i += sums.shape[0]
    sums[part] = total
