"""All contacts of an implicit step as one table of rows, and what a step asks of them.

A row is an obstacle at a place, an obstacle at a triangle, or a pair of soft surfaces: up to four places with weights,
whose weighted motion opens it. Nodes bear a place, or it is a node itself. See ``law`` for a row's force, with a
stiffness like that of the nodes around it. Each time the step has been solved for, rows are located again and their
forces become their multipliers; see ``implicit_location``. While the step is solved for, a row stays what
it was located as, a plane that nothing passes.
"""

import warp as wp

from warp_corot.kernels.elements.elements import load_node, store_node
from warp_corot.kernels.implicit.assembled import Couplings, add_block, begin_coupling, end_coupling, root_columns
from warp_corot.kernels.implicit.line_search import TRIED
from warp_corot.kernels.modules import WITHOUT_COPIES

from .bearing import (
    Carriers,
    couple_at,
    ease_at,
    is_borne,
    loose_at,
    loose_part,
    mark_carriers,
    motion_at,
    push_at,
)
from .law import bound_of, spring_state
from .motion import Surface
from .rows import Rows, row_count
from .shapes import Rolling, share_of_moment, tilted

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": WITHOUT_COPIES})

#: Lists of rows: obstacles and pairs that may meet, as they were located; those that push; and those that push before
#: or after a change of the motions.
OBSTACLES, PAIRS, PUSHING, REACHED = (wp.constant(k) for k in range(4))
#: When rows are located: at the beginning of the step; again after motions, if that is due; obstacles that are missing
#: then; and pairs once more at the beginning of the step, after another search.
FIRST, AGAIN, MISSING, REPEATED = (wp.constant(k) for k in range(4))
#: The stiffness of an obstacle's row over that of its nodes, and that of a pair.
STIFF, STIFF_PAIR = wp.constant(32.0), wp.constant(16.0)
#: What is marked at nodes that a pair pushes; obstacles have the bits below.
BY_PAIR = wp.constant(29)


mat43 = wp.types.matrix(shape=(4, 3), dtype=wp.float32)


@wp.struct
class ImplicitRows:
    """Contacts, [R]. Numbers: S for each obstacle, then T for each obstacle, and then the pairs."""

    carriers: Carriers
    first_triangle: int  # the first number of a triangle
    first_pair: int  # the first number of a pair
    places: wp.array[wp.vec4i]  # -1 for none
    weights: wp.array[wp.vec4]  # positive on the first side
    normal: wp.array[wp.vec3]  # to the first side
    gap: wp.array[wp.float32]  # where it is located [m]
    moved: wp.array[wp.vec3]  # motion in the step of what has no unknowns, against the first side [m]
    opened: wp.array[wp.float32]  # how much the gap has opened where it is located [m]
    target: wp.array[wp.float32]  # the least gap at the end [m]
    friction: wp.array[wp.float32]  # Coulomb's coefficient
    stiffness: wp.array[wp.float32]  # k [N/m]
    multiplier: wp.array[wp.vec3]  # [N]
    most: wp.array[wp.float32]  # most of friction [N]
    force: wp.array[wp.vec3]  # on the first side [N]
    derivative: wp.array[wp.mat33]  # [N/m]
    listed: wp.array[wp.int32]  # whether it may push
    pushed: wp.array[wp.int32]  # [P] whether a pair pushed when it was last located
    begun: wp.array[wp.int32]  # [P] how often a pair has begun to push in this step
    rolling: wp.array[Rolling]  # of triangles: how the closest point moves
    bend: wp.array[wp.float32]  # of triangles: stiffness against tilts [N m]
    tilt: wp.array[wp.vec3]  # where it is located
    moment: wp.array[wp.vec3]  # against tilting [N m]
    near: wp.array[wp.int32]  # [R] obstacles that may meet, and from ``first_pair`` on pairs
    pushing: wp.array[wp.int32]  # [R]
    reached: wp.array[wp.int32]  # [R]
    counts: wp.array[wp.int32]  # [4] the lengths of the lists
    due: wp.array[wp.int32]  # [1] whether obstacles are to be located
    locates: wp.array[wp.int32]  # [1] whether pairs are
    solves: wp.array[wp.int32]  # [1] how many linear solves the step has had so far


# --- lists -----------------------------------------------------------------------------------------------------------


@wp.func
def near_count(rows: ImplicitRows):
    return rows.counts[OBSTACLES] + rows.counts[PAIRS]


@wp.func
def near_row(k: int, rows: ImplicitRows):
    """The k-th row that may meet."""
    obstacles = rows.counts[OBSTACLES]
    if k < obstacles:
        return rows.near[k]
    return rows.near[rows.first_pair + k - obstacles]


@wp.func
def list_row(r: int, rows: ImplicitRows):
    rows.listed[r] = 1
    if r < rows.first_pair:
        rows.near[wp.atomic_add(rows.counts, OBSTACLES, 1)] = r
    else:
        rows.near[rows.first_pair + wp.atomic_add(rows.counts, PAIRS, 1)] = r


@wp.kernel(enable_backward=False)
def begin_location(which: int, d: wp.array[wp.vec4], located: Surface, rows: ImplicitRows):
    """Begin to locate rows, if that is due: forget those that were near, and put the places of pairs where the step
    begins, or after motions d; a thread for each carrier."""
    c = wp.tid()
    carriers = rows.carriers
    surface = carriers.surface
    if which == FIRST or (which == AGAIN and rows.due[0] != 0):
        carriers.crowd[0, c] = 0.0
        if c == 0:
            rows.counts[OBSTACLES] = 0
            rows.due[0] = 1
    if which == FIRST or rows.locates[0] != 0:
        carriers.crowd[1, c] = 0.0
        if c == 0:
            rows.counts[PAIRS] = 0
        if c < located.x.shape[0] and surface.node[c] >= 0:
            x = surface.x[c]
            if which == AGAIN:
                x += motion_at(c, rows.carriers, d)
            located.x[c] = x


# --- one row ---------------------------------------------------------------------------------------------------------


@wp.func
def opened_by(r: int, d: wp.array[wp.vec4], rows: ImplicitRows):
    """How much farther apart the two sides are after motions d of the nodes [m]."""
    p = rows.places[r]
    w = rows.weights[r]
    e = wp.vec3()
    # This loop and those below are not unrolled, so that there is one motion to compile.
    k = int(0)
    while k < 4:
        if w[k] != 0.0:
            e += w[k] * motion_at(p[k], rows.carriers, d)
        k += 1
    return e


@wp.func
def row_state(r: int, e: wp.vec3, most: float, rows: ImplicitRows):
    """A row whose nodes have opened it by e, with friction of at most ``most``."""
    n = rows.normal[r]
    slip = e - rows.moved[r]
    short = rows.gap[r] + wp.dot(n, slip) - rows.opened[r] - rows.target[r]
    return spring_state(short, slip, rows.stiffness[r], rows.multiplier[r], n, most)


@wp.func
def add_to_places(r: int, force: wp.vec3, rows: ImplicitRows, y: wp.array[wp.vec4]):
    p = rows.places[r]
    w = rows.weights[r]
    k = int(0)
    while k < 4:
        if w[k] != 0.0:
            push_at(p[k], w[k] * force, rows.carriers, y)
        k += 1


@wp.func
def bend_of(r: int, rows: ImplicitRows):
    """The stiffness against tilts of a row [N m]; only triangles have one."""
    if r < rows.first_triangle or r >= rows.first_pair:
        return 0.0
    return rows.bend[r - rows.first_triangle]


@wp.func
def corner_weights(r: int, rows: ImplicitRows):
    w = rows.weights[r]
    return wp.vec3(w[0], w[1], w[2])


@wp.func
def tilt_of(r: int, d: wp.array[wp.vec4], rows: ImplicitRows):
    """The tilt of a triangle after motions d."""
    e = wp.mat33()
    for k in range(3):
        e[k] = motion_at(rows.places[r][k], rows.carriers, d)
    return tilted(rows.rolling[r - rows.first_triangle], corner_weights(r, rows), rows.normal[r], e)


@wp.func
def moment_at(r: int, k: int, m: wp.vec3, rows: ImplicitRows):
    """The force at the k-th corner of a moment against tilting."""
    return share_of_moment(k, m, rows.rolling[r - rows.first_triangle], corner_weights(r, rows), rows.normal[r])


@wp.func
def push_corners(r: int, m: wp.vec3, rows: ImplicitRows, y: wp.array[wp.vec4]):
    """Add the forces of a moment against tilting."""
    for k in range(3):
        push_at(rows.places[r][k], moment_at(r, k, m, rows), rows.carriers, y)


# --- all rows --------------------------------------------------------------------------------------------------------


@wp.kernel(enable_backward=False)
def stiffen_rows(threads: int, which: int, changed: wp.array[wp.int32], rows: ImplicitRows):
    """Stiffness of rows that have been located: those that share nodes share it. A row whose nodes are all held does
    nothing.

    Where most of them are, it is no stiffer than where half are: it would amplify rounding.
    """
    k = wp.tid()
    if k == 0:
        rows.counts[PUSHING] = 0
    count = near_count(rows)
    if which == AGAIN and rows.due[0] == 0 and rows.locates[0] == 0 and changed[0] == 0:
        count = 0
    while k < count:
        r = near_row(k, rows)
        p = rows.places[r]
        w = rows.weights[r]
        of_pairs = int(r >= rows.first_pair)
        yielding = float(0.0)
        m = int(0)
        while m < 4:
            if w[m] != 0.0:
                yielding += ease_at(of_pairs, p[m], w[m], rows.carriers)
            m += 1
        stiff = wp.where(of_pairs != 0, STIFF_PAIR, STIFF)
        part = loose_part(loose_at(p, w, rows.carriers.surface))
        rows.stiffness[r] = wp.where(yielding > 0.0, part * stiff / yielding, 0.0)
        k += threads


@wp.kernel(enable_backward=False)
def update_rows(threads: int, is_solved: int, d: wp.array[wp.vec4], rows: ImplicitRows):
    """Forces and derivatives after motions d, with the friction that the push there allows, and the rows that push,
    whose list the launch before has emptied.

    ``is_solved`` says that a solve has ended with d, which is when bounds of friction change.
    """
    k = wp.tid()
    if k == 0:
        rows.counts[REACHED] = 0
    while k < near_count(rows):
        r = near_row(k, rows)
        e = opened_by(r, d, rows)
        push = row_state(r, e, 0.0, rows).push
        most = bound_of(rows.most[r], push, rows.friction[r], is_solved != 0, rows.solves[0])
        rows.most[r] = most
        rows.force[r] = wp.vec3()
        rows.derivative[r] = wp.mat33()
        if push > 0.0:
            made = row_state(r, e, most, rows)
            rows.force[r] = made.force
            rows.derivative[r] = made.derivative
        bend = bend_of(r, rows)
        if bend > 0.0:
            t = r - rows.first_triangle
            rows.moment[t] = bend * (rows.tilt[t] - tilt_of(r, d, rows))
        if push > 0.0 or bend > 0.0:
            rows.pushing[wp.atomic_add(rows.counts, PUSHING, 1)] = r
        k += threads


@wp.kernel(enable_backward=False)
def find_reached(
    threads: int,
    d: wp.array[wp.vec4],
    change: wp.array[wp.vec4],
    rows: ImplicitRows,
):
    """The rows that push after motions d or with the change: as gaps change in proportion, no others push between."""
    k = wp.tid()
    if k == 0:
        rows.counts[PUSHING] = 0
    while k < near_count(rows):
        r = near_row(k, rows)
        e = opened_by(r, d, rows)
        after = e + opened_by(r, change, rows)
        push = wp.max(row_state(r, e, 0.0, rows).push, row_state(r, after, 0.0, rows).push)
        if push > 0.0 or bend_of(r, rows) > 0.0:
            rows.reached[wp.atomic_add(rows.counts, REACHED, 1)] = r
        k += threads


@wp.kernel(enable_backward=False)
def add_row_forces(threads: int, rows: ImplicitRows, y: wp.array[wp.vec4]):
    """Add the forces of rows on nodes that are free [N]."""
    k = wp.tid()
    while k < rows.counts[PUSHING]:
        r = rows.pushing[k]
        add_to_places(r, rows.force[r], rows, y)
        if bend_of(r, rows) > 0.0:
            push_corners(r, rows.moment[r - rows.first_triangle], rows, y)
        k += threads


@wp.kernel(enable_backward=False)
def add_row_products(
    # In
    threads: int,
    rows: ImplicitRows,
    x: wp.array[wp.vec4],
    # Out
    y: wp.array[wp.vec4],
):
    """Add the derivative times x."""
    k = wp.tid()
    while k < rows.counts[PUSHING]:
        r = rows.pushing[k]
        product = rows.derivative[r] * opened_by(r, x, rows)
        add_to_places(r, product, rows, y)
        bend = bend_of(r, rows)
        if bend > 0.0:
            push_corners(r, bend * tilt_of(r, x, rows), rows, y)
        k += threads


@wp.func
def couple_parts(parts: mat43, r: int, rows: ImplicitRows, to: Couplings):
    """Add c c^T to a matrix, with the rows of ``parts`` as c at a row's places."""
    c = begin_coupling(to)
    if c < 0:
        return
    places = int(0)
    k = int(0)
    while k < 4:
        if wp.length_sq(parts[k]) > 0.0:
            places = couple_at(c, places, rows.places[r][k], parts[k], rows.carriers, to)
        k += 1
    end_coupling(c, places, to)


@wp.kernel(enable_backward=False)
def couple_rows(
    # In
    threads: int,
    rows: ImplicitRows,
    # In and out
    couplings: Couplings,
):
    """Add the derivative to an assembled matrix."""
    i = wp.tid()
    while i < rows.counts[PUSHING]:
        r = rows.pushing[i]
        w = rows.weights[r]
        s = rows.places[r][0]
        if r < rows.first_triangle and not is_borne(s, rows.carriers.surface):
            if rows.carriers.compliance[s] > 0.0:
                add_block(rows.carriers.entry[s], rows.derivative[r], couplings)
        else:
            roots = root_columns(rows.derivative[r])
            for axis in range(3):
                g = wp.vec3(roots[0, axis], roots[1, axis], roots[2, axis])
                if wp.length_sq(g) > 0.0:
                    couple_parts(wp.outer(w, g), r, rows, couplings)
        bend = bend_of(r, rows)
        if bend > 0.0:
            along = rows.rolling[r - rows.first_triangle].along
            is_along = wp.length_sq(along) > 0.0
            for axis in range(wp.where(is_along, 1, 3)):
                m = wp.vec3()
                m[axis] = wp.sqrt(bend)
                if is_along:
                    m = wp.sqrt(bend) * along
                parts = mat43()
                for k in range(3):
                    parts[k] = moment_at(r, k, m, rows)
                couple_parts(parts, r, rows, couplings)
        i += threads


@wp.kernel(enable_backward=False)
def add_row_slopes(
    # In
    threads: int,
    only_world: int,
    apart: int,
    rows: ImplicitRows,
    d: wp.array[wp.vec4],
    change: wp.array[wp.vec4],
    search: wp.array2d[wp.float64],
    # Out
    slopes: wp.array[wp.float64],
):
    """Add the power of rows along a change of motions, at the share that is tried.

    Args:
        only_world: Whether all bodies and worlds are solved for together.
        apart: The first place of a body whose places have slopes of their own; -1: worlds have.
    """
    k = wp.tid()
    total = wp.float64(0.0)
    while k < rows.counts[REACHED]:
        r = rows.reached[k]
        s = rows.places[r][0]
        world = wp.where(only_world != 0, 0, rows.carriers.surface.world[s])
        share = float(search[world, TRIED])
        along = opened_by(r, change, rows)
        e = opened_by(r, d, rows) + share * along
        power = wp.dot(wp.vec3d(row_state(r, e, rows.most[r], rows).force), wp.vec3d(along))
        bend = bend_of(r, rows)
        if bend > 0.0:
            tilts = tilt_of(r, change, rows)
            tilt = tilt_of(r, d, rows) + share * tilts - rows.tilt[r - rows.first_triangle]
            power -= wp.float64(bend) * wp.dot(wp.vec3d(tilt), wp.vec3d(tilts))
        if only_world != 0 and apart < 0:
            total += power
        elif power != wp.float64(0.0):
            wp.atomic_add(slopes, wp.where(apart < 0, world, s - apart), power)
        k += threads
    if total != wp.float64(0.0):
        wp.atomic_add(slopes, 0, total)


@wp.kernel(enable_backward=False)
def judge_rows(
    # In
    changed: wp.array[wp.int32],
    rounds: wp.array[wp.int32],
    most: int,
    # In and out
    rows: ImplicitRows,
    going: wp.array[wp.int32],
):
    """Locate obstacles before the next solve if contacts are to be located. The step is solved for only if they had
    just been located, or there are none.
    """
    rows.solves[0] = rounds[0]
    rows.counts[PUSHING] = 0
    if changed[0] != 0 or (rows.due[0] == 0 and rows.counts[OBSTACLES] > 0):
        going[0] = 1
    rows.due[0] = rows.locates[0]
    if going[0] == 0 or rounds[0] >= most:
        rows.solves[0] = 0


# --- the preconditioner ----------------------------------------------------------------------------------------------


@wp.kernel(enable_backward=False)
def gather_stiffness(threads: int, rows: ImplicitRows, stiffness: wp.array[wp.mat33]):
    """The stiffness of obstacles at places: their own, and the shares of those at triangles."""
    i = wp.tid()
    while i < rows.counts[PUSHING]:
        r = rows.pushing[i]
        if r < rows.first_pair:
            bend = bend_of(r, rows)
            for k in range(3):
                w = rows.weights[r][k]
                own = w * rows.derivative[r]
                if bend > 0.0:
                    slope = rows.rolling[r - rows.first_triangle].slopes[k]
                    own += (bend * wp.length_sq(slope)) * wp.outer(rows.normal[r], rows.normal[r])
                if w != 0.0 or bend > 0.0:
                    wp.atomic_add(stiffness, rows.places[r][k], own)
        i += threads


@wp.kernel(enable_backward=False)
def scale_nodes(
    start: int,
    first: int,
    is_after: int,
    carriers: Carriers,
    stiffness: wp.array[wp.mat33],
    v: wp.array[wp.vec4],
):
    """v = G v, or G^T v before a preconditioner that knows no rows, where G makes the directions in which they are
    stiff as small as that makes them: G G^T = (1 + D / k)^-1 with their stiffness D and that of the node, k.

    The vector v has the entries of one body, the first of which is entry ``first`` in vectors of all bodies.
    """
    s = start + wp.tid()
    if carriers.surface.node[s] < 0 or is_borne(s, carriers.surface) or wp.trace(stiffness[s]) <= 0.0:
        return
    g = root_columns(wp.inverse(wp.identity(n=3, dtype=float) + carriers.compliance[s] * stiffness[s]))
    i = carriers.entry[s] - first
    x = load_node(v, i)
    store_node(v, i, wp.where(is_after != 0, g * x, wp.transpose(g) * x))


# --- the end of a step -----------------------------------------------------------------------------------------------


@wp.kernel(enable_backward=False)
def keep_pair_forces(threads: int, rows: ImplicitRows, pairs: Rows, searches: wp.array[wp.int32]):
    """Keep the forces of pairs for another search in the same step."""
    k = wp.tid()
    if k == 0:
        searches[0] = searches[0] + 1
    while k < row_count(pairs):
        r = rows.first_pair + k
        pairs.force[k] = wp.where(rows.listed[r] != 0, rows.force[r], wp.vec3())
        k += threads


@wp.func
def end_row(r: int, own: int, force: wp.vec3, rows: ImplicitRows, kept: Rows):
    """Keep a row of obstacles or a pair, by its number there, for the next step."""
    kept.force[own] = force
    kept.acts[own] = int(wp.length_sq(force) > 0.0)
    if r >= rows.first_triangle and r < rows.first_pair and rows.listed[r] != 0:
        kept.weights[own] = rows.weights[r]
        kept.normal[own] = rows.normal[r]
        kept.gap[own] = rows.gap[r]


@wp.kernel(enable_backward=False)
def end_rows(
    # In
    threads: int,
    rows: ImplicitRows,
    # Out
    beside: Rows,
    pairs: Rows,
    added: wp.array[wp.vec3],
):
    """Keep forces for the next step, and where they are, and gather them at places, held ones too.

    Args:
        beside: The rows of obstacles.
    """
    r = wp.tid()
    while r < rows.first_pair + row_count(pairs):
        force = wp.vec3()
        if rows.listed[r] != 0:
            force = rows.force[r]
        if r < rows.first_pair:
            end_row(r, r, force, rows, beside)
        else:
            end_row(r, r - rows.first_pair, force, rows, pairs)
        if wp.length_sq(force) > 0.0:
            w = rows.weights[r]
            for k in range(4):
                if w[k] != 0.0:
                    wp.atomic_add(added, rows.places[r][k], w[k] * force)
        r += threads


@wp.kernel(enable_backward=False)
def end_places(d: wp.array[wp.vec4], added: wp.array[wp.vec3], carriers: Carriers):
    """What has come of the step at the places: motions and forces."""
    s = wp.tid()
    surface = carriers.surface
    if surface.node[s] < 0:
        return
    surface.d[s] = motion_at(s, carriers, d)
    surface.f[s] = added[s]
    added[s] = wp.vec3()


@wp.kernel(enable_backward=False)
def mark_acting(threads: int, obstacles: int, rows: ImplicitRows, marked: wp.array[wp.int32]):
    """Mark the carriers of the places of rows that push: each obstacle has a bit, and pairs together."""
    k = wp.tid()
    while k < near_count(rows):
        r = near_row(k, rows)
        if wp.length_sq(rows.force[r]) > 0.0:
            bit = int(BY_PAIR)
            if r < rows.first_triangle:
                bit = (r / (rows.first_triangle / obstacles)) % BY_PAIR
            elif r < rows.first_pair:
                bit = ((r - rows.first_triangle) / ((rows.first_pair - rows.first_triangle) / obstacles)) % BY_PAIR
            for m in range(4):
                if rows.weights[r][m] != 0.0:
                    mark_carriers(rows.places[r][m], wp.lshift(1, bit), rows.carriers.surface, marked)
        k += threads
