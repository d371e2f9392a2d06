"""Carriers: the nodes that move places of contact in implicit steps, and take the forces there.

A place that is a node carries itself; one between nodes has its bearers, see ``bearing``. Carriers are numbered, first
all places and then all bearers.
"""

import warp as wp

from warp_corot.kernels.elements.elements import add_force, load_node, store_node
from warp_corot.kernels.implicit.assembled import Couplings, couple

from .bearing import borne_force, is_borne
from .motion import Surface

wp.set_module_options({"enable_backward": False})


@wp.struct
class Carriers:
    """Carriers of places, [C] = [S + B]; see ``Surface`` and ``Bearing``."""

    entry: wp.array[wp.int32]  # of the node in the vectors of the step; -1: unused
    compliance: wp.array[wp.float32]  # of the node alone [m/N]; zero: it is held
    crowd: wp.array2d[wp.float32]  # [2, C] the sum of weights in obstacles that push, and in pairs
    gone: wp.array[wp.vec3]  # how far a held node has gone in the step [m]


@wp.kernel(enable_backward=False)
def begin_carriers(
    # In
    start: int,
    offset: int,
    first: int,
    inverse_mass: wp.array[wp.float32],
    blocks: wp.array[wp.mat33],
    rest: wp.array[wp.vec4],
    u: wp.array[wp.vec4],
    increment: wp.array[wp.vec4],
    guess: wp.array[wp.vec4],
    # Out
    surface: Surface,
    carriers: Carriers,
):
    """Where a body's carriers are when a step begins, and how far they may go; held nodes are where it ends.

    Args:
        start: The first one in ``surface``, the places or their bearers.
        offset: The number of the first carrier there.
        first: The first entry of the body.
        blocks: The blocks on the diagonal of the body's matrix [N/m].
        increment: How far held nodes have gone in the step [m].
        guess: How far free nodes may go [m].
    """
    s = start + wp.tid()
    c = offset + s
    i = surface.node[s]
    surface.f[s] = wp.vec3()
    surface.d[s] = wp.vec3()
    surface.yielding[s] = 0.0
    carriers.compliance[c] = 0.0
    carriers.gone[c] = wp.vec3()
    carriers.entry[c] = -1
    if i < 0:
        return
    home = load_node(rest, i)
    surface.rest[s] = home
    surface.x[s] = home + load_node(u, i)
    surface.d[s] = load_node(guess, i)
    carriers.entry[c] = first + i
    if inverse_mass[i] > 0.0:
        surface.yielding[s] = 1.0
        carriers.compliance[c] = 3.0 / wp.max(wp.trace(blocks[i]), 1.0e-30)
    else:
        # The motion tells the search how fast it is.
        surface.d[s] = load_node(increment, i)
        carriers.gone[c] = surface.d[s]


@wp.func
def carriers_of(s: int, surface: Surface):
    """The numbers of a place's carriers, and its weights, zero for none."""
    if is_borne(s, surface):
        first = surface.node.shape[0]
        return surface.bearing.bearers[s] + wp.vec4i(first, first, first, first), surface.bearing.weights[s]
    return wp.vec4i(s, s, s, s), wp.vec4(1.0, 0.0, 0.0, 0.0)


@wp.func
def motion_at(s: int, surface: Surface, carriers: Carriers, d: wp.array[wp.vec4]):
    """The motion of a place after motions d [m]."""
    c, w = carriers_of(s, surface)
    e = wp.vec3()
    for k in range(4):
        if w[k] != 0.0:
            e += w[k] * load_node(d, carriers.entry[c[k]])
    return e


@wp.func
def gone_at(s: int, surface: Surface, carriers: Carriers):
    """How far held nodes have moved a place in the step [m]."""
    c, w = carriers_of(s, surface)
    e = wp.vec3()
    for k in range(4):
        if w[k] != 0.0:
            e += w[k] * carriers.gone[c[k]]
    return e


@wp.func
def push_at(s: int, force: wp.vec3, surface: Surface, carriers: Carriers, y: wp.array[wp.vec4]):
    """Add a force at a place to its carriers that are free [N]."""
    c, w = carriers_of(s, surface)
    for k in range(4):
        if w[k] != 0.0 and carriers.compliance[c[k]] > 0.0:
            add_force(y, carriers.entry[c[k]], w[k] * force)


@wp.func
def couple_at(
    number: int, places: int, s: int, part: wp.vec3, surface: Surface, carriers: Carriers, couplings: Couplings
):
    """Add a place's free carriers to a product of an assembled matrix with this number, which has ``places`` nodes;
    returns how many it has then."""
    c, w = carriers_of(s, surface)
    for k in range(4):
        if w[k] != 0.0 and carriers.compliance[c[k]] > 0.0:
            places = couple(number, places, carriers.entry[c[k]], w[k] * part, couplings)
    return places


@wp.func
def crowd_at(kind: int, s: int, share: float, surface: Surface, carriers: Carriers):
    """Count a contact that pushes at a place with a share of its force; ``kind``: 1 for pairs, else 0."""
    c, w = carriers_of(s, surface)
    for k in range(4):
        if w[k] != 0.0:
            wp.atomic_add(carriers.crowd, kind, c[k], wp.abs(w[k] * share))


@wp.func
def ease_at(kind: int, s: int, share: float, surface: Surface, carriers: Carriers):
    """How far a contact moves with a place that has this share in it, for each unit of force, if all contacts around
    push alike [m/N].
    """
    c, w = carriers_of(s, surface)
    total = float(0.0)
    for k in range(4):
        part = wp.abs(share * w[k])
        if part > 0.0:
            total += part * wp.max(carriers.crowd[kind, c[k]], part) * carriers.compliance[c[k]]
    return total


@wp.func
def is_held_at(s: int, surface: Surface, carriers: Carriers):
    """Whether all carriers of a place are held."""
    c, w = carriers_of(s, surface)
    free = bool(False)
    for k in range(4):
        free = free or (w[k] != 0.0 and carriers.compliance[c[k]] > 0.0)
    return not free


@wp.func
def mark_carriers(s: int, mark: int, surface: Surface, marked: wp.array[wp.int32]):
    """Add a mark to the carriers of a place."""
    c, w = carriers_of(s, surface)
    for k in range(4):
        if w[k] != 0.0:
            wp.atomic_or(marked, c[k], mark)


@wp.kernel(enable_backward=False)
def end_carriers(start: int, are_bearers: int, nodes: Surface, surface: Surface, contact_forces: wp.array[wp.vec4]):
    """Write the forces at a body's carriers, the ``nodes``, for users: those at the places of ``surface``."""
    s = start + wp.tid()
    i = nodes.node[s]
    if i < 0:
        return
    if are_bearers != 0:
        nodes.f[s] = borne_force(s, surface)
    store_node(contact_forces, i, nodes.f[s])
