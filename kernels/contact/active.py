"""Nodes that obstacles hold in an implicit step: which, with what forces, and the friction on them.

Where a node touches, its motion d in the step is given along the obstacle's normal: d = S d + g with a projector S and
g in the direction that it leaves out. The step is solved for with these held (Baraff and Witkin 1998); the push is what
is left of the balance of forces there. A node that is pulled is let go, and one that would pass is held.

Friction is a spring across the normal with a multiplier l, bounded by Coulomb's law: l - k e after a motion e relative
to the obstacle, no larger than the coefficient times the push. The spring joins the matrix. After each step its force
is the multiplier of the next one (augmented Lagrangians, Simo and Laursen 1992), so that what sticks comes to rest on
the obstacle whatever k is.
"""

import warp as wp

from warp_corot.kernels.elements.elements import load_node, store_node
from warp_corot.kernels.implicit.assembled import Couplings
from warp_corot.kernels.implicit.line_search import TRIED
from warp_corot.kernels.stepping.pace import DT, Pace

from .law import Law, held_back, least_motion
from .motion import Motions, Surface
from .shapes import Shapes, carried, distance_to
from .vertices import across

wp.set_module_options({"enable_backward": False})

#: State of a node at an obstacle.
APART, TOUCHES = wp.constant(0), wp.constant(1)
#: The obstacles whose bounds are found.
THOSE_APART, THOSE_TOUCHED = wp.constant(0), wp.constant(1)
#: Number of rounds after which no node is released any more.
LATE = wp.constant(12)
#: Number of rounds after which a node that touches keeps its plane and its bound of friction: a plane that follows the
#: node around an obstacle, or changes by rounding, may never let a step end.
STAYS = wp.constant(24)
#: How often a node may be released in a step.
RELEASED = wp.constant(3)
#: The stiffness of friction over that of the node.
STIFF = wp.constant(32.0)
#: A sliding node has no stiffness in the direction in which it slides. The matrix has only this share of the change,
#: because with all of it the nodes of a sliding patch start and stop in turns. The value is not critical: a block that
#: slides down an incline as a whole takes 6.0 linear iterations a step with 0.97, 6.2 with 0.8 and 6.1 with 1.
LOOSE = wp.constant(0.97)
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
    forces: wp.array2d[wp.vec3]  # of the obstacle on the node [N]
    multipliers: wp.array2d[wp.vec3]  # [N]
    most: wp.array2d[wp.float32]  # of friction [N]
    normals: wp.array2d[wp.vec3]
    least: wp.array2d[wp.float32]  # how far the node must go along the normal beyond the obstacle's own motion [m]
    touched: wp.array[wp.int32]  # by how many obstacles
    stiffness: wp.array[wp.float32]  # of friction [N/m]
    drag: wp.array[wp.mat33]  # the derivative of friction [N/m]
    projectors: wp.array[wp.mat33]
    given: wp.array[wp.vec3]  # the motion in directions that are held [m]


@wp.kernel(enable_backward=False)
def begin_places(
    # In
    start: int,
    inverse_mass: wp.array[wp.float32],
    rest: wp.array[wp.vec4],
    u: wp.array[wp.vec4],
    blocks: wp.array[wp.mat33],
    # Out
    surface: Surface,
    holding: Holding,
):
    """Copy the positions of a body's surface nodes, and the stiffness of their ``blocks`` on the matrix's diagonal."""
    s = start + wp.tid()
    i = surface.node[s]
    surface.f[s] = wp.vec3()
    surface.d[s] = wp.vec3()
    surface.yielding[s] = 0.0
    for o in range(holding.kinds.shape[0]):
        holding.released[o, s] = 0
        holding.multipliers[o, s] = holding.forces[o, s]
        holding.most[o, s] = 0.0
    if i < 0:
        return
    if inverse_mass[i] > 0.0:
        surface.yielding[s] = 1.0
    home = load_node(rest, i)
    surface.rest[s] = home
    surface.x[s] = home + load_node(u, i)
    holding.stiffness[s] = STIFF * wp.trace(blocks[i]) / 3.0


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
    rounds: wp.array[wp.int32],
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
        if is_apart != (which == THOSE_APART) or (not is_apart and rounds[0] > STAYS):
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
        if at_end == 0:
            holding.most[o, s] = shapes.friction[o] * wp.max(wp.dot(holding.forces[o, s], n), 0.0)


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
    holding.drag[s] = wp.mat33()
    if surface.yielding[s] == 0.0:
        return
    world = surface.world[s]
    x = surface.x[s]
    free = wp.identity(n=3, dtype=float)
    given = wp.vec3()
    touched = int(0)
    for o in range(holding.kinds.shape[0]):
        if holding.kinds[o, s] != APART:
            touched += 1
            n = holding.normals[o, s]
            left = free * n
            size = wp.length(left)
            if size > DIFFERENT:
                e = left / size
                moved = carried(motions.now[world, o], motions.later[world, o], x)
                given += ((wp.dot(n, moved) + holding.least[o, s] - wp.dot(n, given)) / wp.dot(n, e)) * e
                free -= wp.outer(e, e)
    holding.touched[s] = touched
    holding.projectors[s] = free
    holding.given[s] = given


@wp.kernel(enable_backward=False)
def leave_yielding(start: int, surface: Surface, holding: Holding, v: wp.array[wp.vec4]):
    """v = S T v, where T makes the directions in which friction is stiff as small as that makes them."""
    s = start + wp.tid()
    if holding.touched[s] != 0:
        i = surface.node[s]
        x = load_node(v, i)
        drag = holding.drag[s]
        trace = wp.trace(drag)
        if trace > 0.0:
            stiffness = wp.ddot(drag, drag) / trace
            left = wp.sqrt(1.0 / (1.0 + STIFF * stiffness / holding.stiffness[s]))
            x -= ((1.0 - left) / stiffness) * (drag * x)
        store_node(v, i, holding.projectors[s] * x)


@wp.kernel(enable_backward=False)
def impose(start: int, surface: Surface, holding: Holding, d: wp.array[wp.vec4]):
    """d = S d + g."""
    s = start + wp.tid()
    if holding.touched[s] != 0:
        i = surface.node[s]
        store_node(d, i, holding.projectors[s] * load_node(d, i) + holding.given[s])


@wp.func
def trial_of(o: int, s: int, relative: wp.vec3, holding: Holding):
    """Friction without a bound, after a motion relative to the obstacle [N]."""
    return across(holding.multipliers[o, s] - holding.stiffness[s] * relative, holding.normals[o, s])


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
    """r = S (r + the friction at the motion d), and the derivative of friction there.

    A node that touches several obstacles has no friction.
    """
    s = start + wp.tid()
    if holding.touched[s] == 0:
        return
    i = surface.node[s]
    world = surface.world[s]
    total = load_node(r, i)
    drag = wp.mat33()
    if holding.touched[s] == 1:
        for o in range(holding.kinds.shape[0]):
            most = holding.most[o, s]
            if holding.kinds[o, s] != APART and most > 0.0:
                n = holding.normals[o, s]
                moved = carried(motions.now[world, o], motions.later[world, o], surface.x[s])
                trial = trial_of(o, s, load_node(d, i) - moved, holding)
                size = wp.length(trial)
                share = float(1.0)
                plane = wp.identity(n=3, dtype=float) - wp.outer(n, n)
                if size > most:
                    share = most / size
                    plane -= (LOOSE / (size * size)) * wp.outer(trial, trial)
                total += share * trial
                drag = (share * holding.stiffness[s]) * plane
    holding.drag[s] = drag
    store_node(r, i, holding.projectors[s] * total)


@wp.kernel(enable_backward=False)
def add_slopes(
    # In
    start: int,
    only_world: int,
    apart: int,
    motions: Motions,
    surface: Surface,
    holding: Holding,
    d: wp.array[wp.vec4],
    change: wp.array[wp.vec4],
    search: wp.array2d[wp.float64],
    # Out
    slopes: wp.array[wp.float64],
):
    """Add the power of friction along a change of motions, at the share that is tried. If ``apart`` is not zero, each
    place has its own slope."""
    k = wp.tid()
    s = start + k
    if holding.touched[s] != 1:
        return
    world = surface.world[s]
    at = wp.where(only_world != 0, 0, world)
    i = surface.node[s]
    for o in range(holding.kinds.shape[0]):
        most = holding.most[o, s]
        if holding.kinds[o, s] != APART and most > 0.0:
            along = load_node(change, i)
            moved = carried(motions.now[world, o], motions.later[world, o], surface.x[s])
            e = load_node(d, i) + float(search[at, TRIED]) * along - moved
            trial = trial_of(o, s, e, holding)
            size = wp.length(trial)
            if size > most:
                trial *= most / size
            wp.atomic_add(slopes, wp.where(apart != 0, k, at), wp.dot(wp.vec3d(trial), wp.vec3d(along)))


@wp.kernel(enable_backward=False)
def add_drag(start: int, surface: Surface, holding: Holding, x: wp.array[wp.vec4], y: wp.array[wp.vec4]):
    """y = S (y + D x) with the derivative D of friction, x in the range of S."""
    s = start + wp.tid()
    if holding.touched[s] != 0:
        i = surface.node[s]
        store_node(y, i, holding.projectors[s] * (load_node(y, i) + holding.drag[s] * load_node(x, i)))


@wp.kernel(enable_backward=False)
def couple_places(start: int, surface: Surface, holding: Holding, couplings: Couplings):
    """Write S and D for an assembled matrix."""
    s = start + wp.tid()
    if holding.touched[s] != 0:
        i = couplings.first + surface.node[s]
        couplings.projected[i] = 1
        couplings.projectors[i] = holding.projectors[s]
        couplings.drag[i] = holding.drag[s]


@wp.func
def let_go(o: int, s: int, is_late: bool, holding: Holding) -> bool:
    """A node that is pulled: whether it is let go."""
    holding.forces[o, s] = wp.vec3()
    holding.multipliers[o, s] = wp.vec3()
    holding.most[o, s] = 0.0
    if is_late or holding.released[o, s] >= RELEASED:
        return False
    holding.kinds[o, s] = APART
    holding.released[o, s] = holding.released[o, s] + 1
    return True


@wp.func
def judge_single(o: int, s: int, force: wp.vec3, slip: wp.vec3, friction: float, rounds: int, holding: Holding) -> bool:
    """A node that touches one obstacle: its force, and whether it changes."""
    n = holding.normals[o, s]
    push = wp.dot(force, n)
    if push < 0.0:
        return let_go(o, s, rounds >= LATE, holding)
    most = friction * push
    if rounds >= STAYS:
        most = holding.most[o, s]
    sideways = wp.vec3()
    if most > 0.0:
        sideways = held_back(trial_of(o, s, slip, holding), most, 1.0)
    holding.forces[o, s] = push * n + sideways
    holding.most[o, s] = most
    return False


@wp.func
def judge_several(s: int, force: wp.vec3, is_late: bool, holding: Holding) -> bool:
    """A node that touches several obstacles: the force along each normal, in turn, and whether anything changes."""
    count = holding.kinds.shape[0]
    for o in range(count):
        holding.forces[o, s] = wp.vec3()
        holding.multipliers[o, s] = wp.vec3()
        holding.most[o, s] = 0.0
    for _ in range(16):
        for o in range(count):
            if holding.kinds[o, s] != APART:
                rest = force
                for other in range(count):
                    if other != o:
                        rest -= holding.forces[other, s]
                n = holding.normals[o, s]
                holding.forces[o, s] = wp.dot(rest, n) * n
    changes = bool(False)
    for o in range(count):
        is_pulled = wp.dot(holding.forces[o, s], holding.normals[o, s]) < 0.0
        if holding.kinds[o, s] != APART and is_pulled and let_go(o, s, is_late, holding):
            changes = True
    return changes


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
        changes = judge_single(first, s, force, slip, shapes.friction[first], rounds[0], holding)
    elif touching > 1:
        changes = judge_several(s, force, rounds[0] >= LATE, holding)
    for o in range(count):
        least = holding.least[o, s]
        if holding.kinds[o, s] == APART and least > NO_BOUND:
            n = holding.normals[o, s]
            relative = step - carried(motions.now[world, o], motions.later[world, o], x)
            if wp.dot(n, relative) < least - 0.5 * law.tolerance:
                holding.kinds[o, s] = TOUCHES
                holding.forces[o, s] = wp.vec3()
                holding.multipliers[o, s] = wp.vec3()
                holding.most[o, s] = 0.0
                changes = True
    if changes:
        changed[0] = 1


@wp.kernel(enable_backward=False)
def count_round(rounds: wp.array[wp.int32]):
    rounds[0] = rounds[0] + 1


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
