"""The end of the contact of a step: forces and their work at nodes, and the watch for the next search."""

from typing import Any

import warp as wp

from warp_corot.kernels.elements.elements import load_node, store_node
from warp_corot.kernels.stepping.integrate import by_vectors
from warp_corot.kernels.stepping.pace import Pace
from warp_corot.kernels.stepping.work import count_constraint

from .begin import BLOCK as BLOCK
from .mass_split import Sums, take_force
from .motion import Surface
from .watch import Watch, follow_node

wp.set_module_options({"enable_backward": False})


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
    damping: float,
    gravity: wp.vec3,
    inverse_mass: wp.array[wp.float32],
    has_load: int,
    load: wp.array[Any],
    pace: Pace,
    offset: int,
    v: wp.array[wp.vec4],
    # In and out
    sums: Sums,
    watch: Watch,
    f: wp.array[wp.vec4],
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
            store_node(contact_forces, i, force)
            if wp.dot(force, force) > 0.0:
                total = load_node(f, i) + force
                store_node(f, i, total)
                if counts != 0:
                    count_constraint(
                        i, force, total, damping, gravity, inverse_mass, has_load, load, pace, offset, v, account
                    )
    if watch.awake[0] != 0 and k < places and surface.node[place_start + k] >= 0:
        follow_node(place_start + k, surface, watch)


END_CONTACT = by_vectors(end_contact, "load")
