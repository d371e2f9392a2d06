"""The residual of Newton's method; see ``newton``, of which steps with one iteration launch nothing else."""

import warp as wp

from warp_corot.kernels.elements.elements import load_node, store_node
from warp_corot.kernels.stepping.integrate import Dynamics, load_at
from warp_corot.kernels.stepping.sums import Sums, dot64, store_sum

from .newton import REFERENCE, SQUARE

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def find_residual(
    # In
    sums: Sums,
    body: Dynamics,
    mass: wp.array[wp.float32],
    external_share: wp.array[wp.float32],
    inertia: wp.array[wp.float32],
    pull: wp.array[wp.vec4],
    increment: wp.array[wp.vec4],
    # In and out
    f: wp.array[wp.vec4],
    # Out
    r: wp.array[wp.vec4],
    outer: wp.array[wp.vec4],
):
    """r = f + outer at free nodes, outer = others + external + m (pull - a d), with the other forces in ``body``.

    Afterwards f and the other forces are zero, ready for the next sums.
    """
    world, thread = wp.tid()
    square = wp.float64(0.0)
    reference = wp.float64(0.0)
    for k in range(thread, sums.count, sums.threads):
        i = world * sums.count + k
        internal = load_node(f, i)
        other = load_node(body.f, i)
        external = external_share[0] * (mass[i] * body.gravity + load_at(i, body))
        rest = wp.vec3()
        push = wp.vec3()
        if body.inverse_mass[i] > 0.0:
            external += other + mass[i] * load_node(pull, i)
            push = external - (inertia[0] * mass[i]) * load_node(increment, i)
            rest = internal + push
            reference += dot64(external, external)
        else:
            reference += dot64(internal, internal)
        square += dot64(rest, rest)
        store_node(r, i, rest)
        store_node(outer, i, push)
        store_node(f, i, wp.vec3())
        store_node(body.f, i, wp.vec3())
    store_sum(sums, world, thread, SQUARE, square)
    store_sum(sums, world, thread, REFERENCE, reference)
