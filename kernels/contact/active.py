"""Nodes held by obstacles in an implicit step: which nodes, in which directions, and with what forces.

A node that touches has a given motion along the obstacle's normal, and in all directions if it sticks: d = S d + g,
where the projector S removes the given directions and g lies in them. The step is solved with these directions held
(Baraff and Witkin 1998); the contact force is the residual there. Then a node that is pulled is released, a node that
would pass is held, and a node that friction cannot hold slips. This repeats until nothing changes.
"""

import warp as wp

from warp_corot.kernels.elements.elements import load_node, store_node
from warp_corot.kernels.stepping.pace import DT, Pace

from .law import Law, least_motion
from .motion import Motions, Surface
from .shapes import Shapes, carried, distance_to
from .vertices import across

wp.set_module_options({"enable_backward": False})

#: State of a node at an obstacle. A slipping node has a force against its motion; a dragged node has a drag instead,
#: which cannot reverse the motion.
APART, SLIPS, STICKS, DRAGGED = (wp.constant(k) for k in range(4))
#: The obstacles whose bounds are found.
THOSE_APART, THOSE_TOUCHED = wp.constant(0), wp.constant(1)
#: Number of rounds after which no node is released any more, and maximum number of rounds.
LATE, ROUNDS = wp.constant(8), wp.constant(16)
#: A friction force that changes by more than this fraction of its bound causes another round.
SETTLED = wp.constant(1.0e-3)
#: How often a node may be released in a step.
RELEASED = wp.constant(3)
#: Least slip with which a drag is computed, in multiples of the least slip of a friction force.
LOOSE = wp.constant(100.0)
#: How often friction may reverse a node's motion in a step; after that the node is dragged until the end.
CAUGHT = wp.constant(4)
#: A motion of up to this fraction of half the obstacle's thickness is checked at its end.
NEAR_END = wp.constant(0.5)
#: Sine of the angle beyond which the normals of two obstacles hold a node in different directions.
DIFFERENT = wp.constant(0.05)
#: A bound that no motion violates [m].
NO_BOUND = wp.constant(-1.0e30)


@wp.struct
class Holding:
    """Contact of surface places in a step, [O, S] of obstacles and places, or [S] of places."""

    kinds: wp.array2d[wp.int32]
    released: wp.array2d[wp.int32]  # how often in this step
    caught: wp.array2d[wp.int32]  # how often friction has turned a node round in this step
    drag: wp.array2d[wp.float32]  # friction of a node that slips or is dragged over how far it went [N/m]
    forces: wp.array2d[wp.vec3]  # of the obstacle on the node [N]
    normals: wp.array2d[wp.vec3]
    least: wp.array2d[wp.float32]  # how far the node must go along the normal beyond the obstacle's own motion [m]
    touched: wp.array[wp.int32]
    projectors: wp.array[wp.mat33]
    given: wp.array[wp.vec3]  # the motion in directions that are held [m]


@wp.kernel(enable_backward=False)
def begin_places(
    # In
    start: int,
    inverse_mass: wp.array[wp.float32],
    rest: wp.array[wp.vec4],
    u: wp.array[wp.vec4],
    # Out
    surface: Surface,
    holding: Holding,
):
    """Copy the positions of a body's surface nodes."""
    s = start + wp.tid()
    i = surface.node[s]
    surface.f[s] = wp.vec3()
    surface.d[s] = wp.vec3()
    surface.yielding[s] = 0.0
    for o in range(holding.kinds.shape[0]):
        holding.released[o, s] = 0
        holding.caught[o, s] = 0
    if i < 0:
        return
    if inverse_mass[i] > 0.0:
        surface.yielding[s] = 1.0
    home = load_node(rest, i)
    surface.rest[s] = home
    surface.x[s] = home + load_node(u, i)


@wp.kernel(enable_backward=False)
def find_bounds(
    # In
    start: int,
    at_end: int,
    which: int,
    shapes: Shapes,
    thickness: wp.array[wp.float32],
    motions: Motions,
    law: Law,
    pace: Pace,
    surface: Surface,
    d: wp.array[wp.vec4],
    # Out
    holding: Holding,
):
    """Find the plane of each obstacle that a node must not pass, at the beginning or at the end of the node's motion.

    The obstacles are those that the node does not touch, or those that it touches.
    """
    s = start + wp.tid()
    if surface.yielding[s] == 0.0:
        return
    i = surface.node[s]
    world = surface.world[s]
    x = surface.x[s]
    step = load_node(d, i)
    dt = float(pace.seconds[DT])
    for o in range(holding.kinds.shape[0]):
        is_apart = holding.kinds[o, s] == APART
        if is_apart != (which == THOSE_APART):
            continue
        now = motions.now[world, o]
        moved = carried(now, motions.later[world, o], x)
        relative = step - moved
        way = wp.length(relative)
        far = 2.0 * way + wp.length(moved) + 2.0 * law.tolerance
        gap, n = distance_to(shapes, o, now, x, far)
        least = least_motion(gap, law, dt)
        if gap > far and is_apart:
            least = NO_BOUND
        elif at_end != 0 and way <= NEAR_END * thickness[o]:
            wanted = gap + least
            end_gap, end_normal = distance_to(shapes, o, motions.later[world, o], x + step, far)
            n = end_normal
            least = wp.dot(n, relative) + wanted - end_gap
        holding.normals[o, s] = n
        holding.least[o, s] = least


@wp.kernel(enable_backward=False)
def hold_places(
    # In
    start: int,
    motions: Motions,
    surface: Surface,
    # Out
    holding: Holding,
):
    """Find the projector of each node and its motion in the held directions."""
    s = start + wp.tid()
    holding.touched[s] = 0
    if surface.yielding[s] == 0.0:
        return
    world = surface.world[s]
    x = surface.x[s]
    free = wp.identity(n=3, dtype=float)
    given = wp.vec3()
    for o in range(holding.kinds.shape[0]):
        kind = holding.kinds[o, s]
        if kind != APART:
            holding.touched[s] = 1
            n = holding.normals[o, s]
            moved = carried(motions.now[world, o], motions.later[world, o], x)
            least = holding.least[o, s]
            if kind == STICKS:
                given = moved + least * n
                free = wp.mat33()
            else:
                left = free * n
                size = wp.length(left)
                if size > DIFFERENT:
                    e = left / size
                    given += ((wp.dot(n, moved) + least - wp.dot(n, given)) / wp.dot(n, e)) * e
                    free -= wp.outer(e, e)
    holding.projectors[s] = free
    holding.given[s] = given


@wp.kernel(enable_backward=False)
def leave_free(start: int, surface: Surface, holding: Holding, v: wp.array[wp.vec4]):
    """v = S v."""
    s = start + wp.tid()
    if holding.touched[s] != 0:
        i = surface.node[s]
        store_node(v, i, holding.projectors[s] * load_node(v, i))


@wp.kernel(enable_backward=False)
def impose(start: int, surface: Surface, holding: Holding, d: wp.array[wp.vec4]):
    """d = S d + g."""
    s = start + wp.tid()
    if holding.touched[s] != 0:
        i = surface.node[s]
        store_node(d, i, holding.projectors[s] * load_node(d, i) + holding.given[s])


@wp.func
def drag_of(o: int, s: int, holding: Holding, x: wp.vec3):
    """D x: the part across the motion of a slipping node, because its force turns with the motion; all of it for a
    dragged node.
    """
    n = holding.normals[o, s]
    sideways = across(x, n)
    if holding.kinds[o, s] == SLIPS:
        along = across(holding.forces[o, s], n)
        square = wp.dot(along, along)
        if square > 0.0:
            sideways -= (wp.dot(sideways, along) / square) * along
    return holding.drag[o, s] * sideways


@wp.kernel(enable_backward=False)
def add_friction(
    # In
    start: int,
    motions: Motions,
    surface: Surface,
    holding: Holding,
    d: wp.array[wp.vec4],
    # In and out
    r: wp.array[wp.vec4],
):
    """r = S (r + the friction at the motion d)."""
    s = start + wp.tid()
    if holding.touched[s] != 0:
        i = surface.node[s]
        world = surface.world[s]
        total = load_node(r, i)
        for o in range(holding.kinds.shape[0]):
            kind = holding.kinds[o, s]
            if kind == SLIPS or kind == DRAGGED:
                moved = carried(motions.now[world, o], motions.later[world, o], surface.x[s])
                total -= drag_of(o, s, holding, load_node(d, i) - moved)
                if kind == SLIPS:
                    total += across(holding.forces[o, s], holding.normals[o, s])
        store_node(r, i, holding.projectors[s] * total)


@wp.kernel(enable_backward=False)
def add_drag(start: int, surface: Surface, holding: Holding, x: wp.array[wp.vec4], y: wp.array[wp.vec4]):
    """y = S (y + D x), x in the range of S."""
    s = start + wp.tid()
    if holding.touched[s] != 0:
        i = surface.node[s]
        total = load_node(y, i)
        for o in range(holding.kinds.shape[0]):
            kind = holding.kinds[o, s]
            if kind == SLIPS or kind == DRAGGED:
                total += drag_of(o, s, holding, load_node(x, i))
        store_node(y, i, holding.projectors[s] * total)


@wp.func
def release(o: int, s: int, holding: Holding):
    holding.kinds[o, s] = APART
    holding.forces[o, s] = wp.vec3()
    holding.drag[o, s] = 0.0
    holding.released[o, s] = holding.released[o, s] + 1


@wp.func
def judge_single(
    o: int, s: int, force: wp.vec3, slip: wp.vec3, friction: float, least_slip: float, is_late: bool, holding: Holding
) -> bool:
    """Find the force on a node that touches one obstacle, and whether its state changes.

    When friction first reverses a node's motion, the node sticks; later it is dragged for a round.
    """
    n = holding.normals[o, s]
    normal_force = wp.dot(force, n)
    if normal_force < 0.0:
        holding.forces[o, s] = wp.vec3()
        holding.drag[o, s] = 0.0
        if not is_late and holding.released[o, s] < RELEASED:
            release(o, s, holding)
            return True
        was = holding.kinds[o, s]
        holding.kinds[o, s] = SLIPS
        return was == STICKS
    bound = friction * normal_force
    if holding.kinds[o, s] == STICKS:
        sideways = across(force, n)
        size = wp.length(sideways)
        holding.forces[o, s] = force
        if size > bound:
            holding.forces[o, s] = normal_force * n + sideways * (bound / size)
            holding.kinds[o, s] = SLIPS
            holding.drag[o, s] = 0.0
            return True
        return False
    way = across(slip, n)
    length = wp.length(way)
    used = -drag_of(o, s, holding, slip)
    if holding.kinds[o, s] == SLIPS:
        before = across(holding.forces[o, s], n)
        used += before
        if bound == 0.0 or (length > least_slip and wp.dot(way, before) < 0.0):
            holding.drag[o, s] = bound / wp.max(length, least_slip)
            now = -holding.drag[o, s] * way
            holding.forces[o, s] = normal_force * n + now
            return wp.length(now - used) > SETTLED * bound
        holding.forces[o, s] = normal_force * n + before
        if is_late:
            return False
        if holding.caught[o, s] == 0:
            holding.kinds[o, s] = STICKS
            holding.caught[o, s] = 1
        else:
            holding.kinds[o, s] = DRAGGED
            holding.drag[o, s] = bound / wp.max(length, LOOSE * least_slip)
            holding.caught[o, s] = holding.caught[o, s] + 1
        return True
    holding.forces[o, s] = normal_force * n + used
    drag = bound / wp.max(length, LOOSE * least_slip)
    off = wp.abs(drag - holding.drag[o, s]) * length
    holding.drag[o, s] = drag
    if holding.caught[o, s] < CAUGHT and not is_late:
        holding.forces[o, s] = normal_force * n - drag * way
        holding.kinds[o, s] = wp.where(length > least_slip, SLIPS, STICKS)
        return True
    return off > SETTLED * bound


@wp.kernel(enable_backward=False)
def judge_places(
    # In
    start: int,
    shapes: Shapes,
    motions: Motions,
    law: Law,
    surface: Surface,
    b: wp.array[wp.vec4],
    q: wp.array[wp.vec4],
    d: wp.array[wp.vec4],
    least_slip: float,
    rounds: wp.array[wp.int32],
    # In and out
    holding: Holding,
    # Out
    changed: wp.array[wp.int32],
):
    """Find the contact forces q - b, q = A d, at held nodes, and the nodes that are held from now on."""
    s = start + wp.tid()
    if surface.yielding[s] == 0.0:
        return
    i = surface.node[s]
    world = surface.world[s]
    x = surface.x[s]
    step = load_node(d, i)
    is_late = rounds[0] >= LATE
    count = holding.kinds.shape[0]
    touching = int(0)
    first = int(0)
    for o in range(count):
        if holding.kinds[o, s] != APART:
            touching += 1
            first = o
    changes = bool(False)
    force = load_node(q, i) - load_node(b, i)
    if touching == 1:
        slip = step - carried(motions.now[world, first], motions.later[world, first], x)
        changes = judge_single(first, s, force, slip, shapes.friction[first], least_slip, is_late, holding)
    elif touching > 1:
        # Without friction, find the force along each normal in turn.
        for o in range(count):
            holding.forces[o, s] = wp.vec3()
            holding.drag[o, s] = 0.0
        for _ in range(16):
            for o in range(count):
                if holding.kinds[o, s] != APART:
                    rest = force
                    for other in range(count):
                        if other != o:
                            rest -= holding.forces[other, s]
                    n = holding.normals[o, s]
                    holding.forces[o, s] = wp.dot(rest, n) * n
        for o in range(count):
            if holding.kinds[o, s] != APART:
                if holding.kinds[o, s] == STICKS:
                    holding.kinds[o, s] = SLIPS
                    changes = True
                if wp.dot(holding.forces[o, s], holding.normals[o, s]) < 0.0:
                    if not is_late and holding.released[o, s] < RELEASED:
                        release(o, s, holding)
                        changes = True
                    else:
                        holding.forces[o, s] = wp.vec3()
    for o in range(count):
        least = holding.least[o, s]
        if holding.kinds[o, s] == APART and least > NO_BOUND:
            n = holding.normals[o, s]
            relative = step - carried(motions.now[world, o], motions.later[world, o], x)
            if wp.dot(n, relative) < least - 0.5 * law.tolerance:
                holding.kinds[o, s] = wp.where(
                    shapes.friction[o] > 0.0 and touching == 0 and holding.released[o, s] == 0, STICKS, SLIPS
                )
                holding.forces[o, s] = wp.vec3()
                holding.drag[o, s] = 0.0
                touching += 1
                changes = True
    if changes:
        changed[0] = 1


@wp.kernel(enable_backward=False)
def count_round(rounds: wp.array[wp.int32], changed: wp.array[wp.int32]):
    rounds[0] = rounds[0] + 1
    if rounds[0] >= ROUNDS:
        changed[0] = 0


@wp.kernel(enable_backward=False)
def end_places(
    # In
    start: int,
    d: wp.array[wp.vec4],
    holding: Holding,
    # Out
    surface: Surface,
    contact_forces: wp.array[wp.vec4],
):
    """Write the motions and forces of the step."""
    s = start + wp.tid()
    i = surface.node[s]
    if i < 0:
        return
    total = wp.vec3()
    for o in range(holding.kinds.shape[0]):
        if holding.kinds[o, s] != APART:
            total += holding.forces[o, s]
        else:
            holding.forces[o, s] = wp.vec3()
    surface.d[s] = load_node(d, i)
    surface.f[s] = total
    store_node(contact_forces, i, total)
