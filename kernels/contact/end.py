"""The end of the contact of a step: forces and their work at nodes, and the watch for the next search."""

import warp as wp

from warp_corot.kernels.elements.elements import load_node, store_node
from warp_corot.kernels.modules import INLINED
from warp_corot.kernels.stepping.balance import count_constraint
from warp_corot.kernels.stepping.pace import Pace

from .begin import BLOCK as BLOCK
from .mass_split import Sums, take_force
from .motion import Dynamics, Surface, force_at
from .watch import Watch, follow_node

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": INLINED})


@wp.func
def push(
    i: int,
    force: wp.vec3,
    counts: int,
    pace: Pace,
    offset: int,
    body: Dynamics,
    account: wp.array2d[wp.float64],
    contact_forces: wp.array[wp.vec4],
):
    """Add the contact force of a node to its forces, and count its work if ``counts`` says so."""
    store_node(contact_forces, i, force)
    if wp.dot(force, force) > 0.0:
        store_node(body.f, i, load_node(body.f, i) + force)
        if counts != 0:
            w = body.inverse_mass[i]
            v = load_node(body.v, i)
            count_constraint(i, force, force_at(i, body), v, body.damping, body.gravity, w, pace, offset, account)


@wp.kernel(enable_backward=False)
def end_contact(
    # In
    start: int,
    count: int,
    place_start: int,
    places: int,
    shift: int,
    buffer: int,
    grain: float,
    nodes: Surface,
    surface: Surface,
    counts: int,
    pace: Pace,
    offset: int,
    # In and out
    sums: Sums,
    watch: Watch,
    body: Dynamics,
    account: wp.array2d[wp.float64],
    # Out
    contact_forces: wp.array[wp.vec4],
):
    """Add the contact forces to a body's forces, and clear their sums; follow the body's places.

    Args:
        start, count: The first of the ``nodes``, which are places or bear them, and how many there are.
        place_start, places: The first place, and how many of them to follow.
        shift, buffer: How much larger the numbers of nodes in the sums are, and the buffer of these.
        counts: Whether the work of contact is counted here.
    """
    k = wp.tid()
    if k < count:
        s = start + k
        i = nodes.node[s]
        if i >= 0:
            force = wp.vec3()
            n = s + shift
            if watch.awake[0] != 0 and sums.touched[n] != 0:
                force = take_force(n, buffer, grain, sums)
            push(i, force, counts, pace, offset, body, account, contact_forces)
    elif k < count + places and watch.awake[0] != 0:
        # Other threads than those of nodes, so that neither wait for the other.
        s = place_start + k - count
        if surface.node[s] >= 0:
            follow_node(s, surface, watch)
