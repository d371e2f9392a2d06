"""Soft surfaces against one another in an implicit step: the pairs of ``pairs`` as springs with multipliers.

See ``springs`` for the force of a pair, with a stiffness like that of the nodes around it. Each time the step has been
solved for, forces become the multipliers, and pairs are located again where they have come to. Multipliers begin with
the forces of the last step. While a step is solved for, a pair stays what it was located as, a plane that nothing
passes.
"""

import warp as wp

from warp_corot.kernels.implicit.assembled import Couplings, begin_coupling, end_coupling, root_columns
from warp_corot.kernels.implicit.line_search import TRIED

from .carriers import Carriers, couple_at, motion_at, push_at
from .motion import Surface
from .rows import Rows, row_count
from .springs import bound_of, spring_state

wp.set_module_options({"enable_backward": False})

#: The stiffness of a pair over that of its nodes.
STIFF = wp.constant(16.0)
#: A pair that has begun to push so often in a step is no longer located again.
OFTEN = wp.constant(3)
#: Lists of pairs.
NEAR, PUSHING, REACHED = (wp.constant(k) for k in range(3))


@wp.struct
class Joined:
    """The places [S] and pairs [P] of an implicit step. Entries number the nodes of all bodies in one vector."""

    start: wp.array[wp.vec3]  # [S] where the step begins [m]
    base: wp.array[wp.vec3]  # [P] how much the pair has opened where it is located [m]
    given: wp.array[wp.vec3]  # [P] how much held nodes open it [m]
    target: wp.array[wp.float32]  # [P] the least gap at the end [m]
    stiffness: wp.array[wp.float32]  # [P] k [N/m]
    multiplier: wp.array[wp.vec3]  # [P] [N]
    most: wp.array[wp.float32]  # [P] most of friction [N]
    force: wp.array[wp.vec3]  # [P] on the first [N]
    derivative: wp.array[wp.mat33]  # [P] [N/m]
    locates: wp.array[wp.int32]  # [1] whether pairs are to be located
    solves: wp.array[wp.int32]  # [1] how many linear solves the step has had so far
    pushed: wp.array[wp.int32]  # [P] whether it pushed when it was last located
    begun: wp.array[wp.int32]  # [P] how often it has begun to push in this step
    near: wp.array[wp.int32]  # [P] the pairs that may meet, as they were located
    pushing: wp.array[wp.int32]  # [P] those that push
    reached: wp.array[wp.int32]  # [P] those that push before or after a change of the motions
    counts: wp.array[wp.int32]  # [3] the lengths of these three lists


@wp.func
def opened_by(row: int, d: wp.array[wp.vec4], rows: Rows, surface: Surface, carriers: Carriers):
    """How much farther apart the two are after motions d [m]."""
    p = rows.places[row]
    w = rows.shares[row]
    e = wp.vec3()
    # This loop is not unrolled, so that there is one motion to compile.
    k = int(0)
    while k < 4:
        e += w[k] * motion_at(p[k], surface, carriers, d)
        k += 1
    return e


@wp.func
def row_state(row: int, e: wp.vec3, most: float, rows: Rows, joined: Joined):
    """A pair that has opened by e, with friction of at most ``most``; its force is that on the first side."""
    n = rows.normal[row]
    short = rows.gap[row] + wp.dot(n, e - joined.base[row]) - joined.target[row]
    slip = e + joined.given[row]
    return spring_state(short, slip, joined.stiffness[row], joined.multiplier[row], n, most)


@wp.kernel(enable_backward=False)
def empty_list(which: int, joined: Joined):
    joined.counts[which] = 0


@wp.kernel(enable_backward=False)
def update_rows(
    threads: int,
    is_solved: int,
    friction: float,
    d: wp.array[wp.vec4],
    surface: Surface,
    carriers: Carriers,
    rows: Rows,
    joined: Joined,
):
    """Forces and derivatives after motions d, with the friction that the push there allows, and the pairs that push.

    ``is_solved`` says that a solve has ended with d, which is when bounds of friction change.
    """
    k = wp.tid()
    while k < joined.counts[NEAR]:
        row = joined.near[k]
        e = opened_by(row, d, rows, surface, carriers)
        push = row_state(row, e, 0.0, rows, joined).push
        most = bound_of(joined.most[row], push, friction, is_solved != 0, joined.solves[0])
        joined.most[row] = most
        joined.force[row] = wp.vec3()
        if push > 0.0:
            made = row_state(row, e, most, rows, joined)
            joined.force[row] = made.force
            joined.derivative[row] = made.derivative
            joined.pushing[wp.atomic_add(joined.counts, PUSHING, 1)] = row
        k += threads


@wp.kernel(enable_backward=False)
def find_reached(
    threads: int,
    d: wp.array[wp.vec4],
    change: wp.array[wp.vec4],
    surface: Surface,
    carriers: Carriers,
    rows: Rows,
    joined: Joined,
):
    """The pairs that push after motions d or with the change: as gaps change in proportion, no others push between."""
    k = wp.tid()
    while k < joined.counts[NEAR]:
        row = joined.near[k]
        e = opened_by(row, d, rows, surface, carriers)
        after = e + opened_by(row, change, rows, surface, carriers)
        push = wp.max(row_state(row, e, 0.0, rows, joined).push, row_state(row, after, 0.0, rows, joined).push)
        if push > 0.0:
            joined.reached[wp.atomic_add(joined.counts, REACHED, 1)] = row
        k += threads


@wp.func
def add_to_entries(row: int, force: wp.vec3, rows: Rows, surface: Surface, carriers: Carriers, y: wp.array[wp.vec4]):
    p = rows.places[row]
    w = rows.shares[row]
    k = int(0)
    while k < 4:
        push_at(p[k], w[k] * force, surface, carriers, y)
        k += 1


@wp.kernel(enable_backward=False)
def add_row_forces(
    threads: int, surface: Surface, carriers: Carriers, rows: Rows, joined: Joined, y: wp.array[wp.vec4]
):
    """Add the forces of pairs on nodes that are free [N]."""
    k = wp.tid()
    while k < joined.counts[PUSHING]:
        row = joined.pushing[k]
        add_to_entries(row, joined.force[row], rows, surface, carriers, y)
        k += threads


@wp.kernel(enable_backward=False)
def add_row_products(
    # In
    threads: int,
    surface: Surface,
    carriers: Carriers,
    rows: Rows,
    joined: Joined,
    x: wp.array[wp.vec4],
    # Out
    y: wp.array[wp.vec4],
):
    """Add the derivative times x."""
    k = wp.tid()
    while k < joined.counts[PUSHING]:
        row = joined.pushing[k]
        product = joined.derivative[row] * opened_by(row, x, rows, surface, carriers)
        add_to_entries(row, product, rows, surface, carriers, y)
        k += threads


@wp.kernel(enable_backward=False)
def couple_rows(threads: int, surface: Surface, carriers: Carriers, rows: Rows, joined: Joined, couplings: Couplings):
    """Add the derivative to an assembled matrix."""
    i = wp.tid()
    while i < joined.counts[PUSHING]:
        row = joined.pushing[i]
        p = rows.places[row]
        w = rows.shares[row]
        roots = root_columns(joined.derivative[row])
        for axis in range(3):
            g = wp.vec3(roots[0, axis], roots[1, axis], roots[2, axis])
            if wp.length_sq(g) > 0.0:
                c = begin_coupling(couplings)
                if c >= 0:
                    places = int(0)
                    k = int(0)
                    while k < 4:
                        places = couple_at(c, places, p[k], w[k] * g, surface, carriers, couplings)
                        k += 1
                    end_coupling(c, places, couplings)
        i += threads


@wp.kernel(enable_backward=False)
def add_row_slopes(
    # In
    threads: int,
    surface: Surface,
    carriers: Carriers,
    rows: Rows,
    joined: Joined,
    d: wp.array[wp.vec4],
    change: wp.array[wp.vec4],
    search: wp.array2d[wp.float64],
    # Out
    slopes: wp.array[wp.float64],
):
    """Add the power of pairs along a change of motions, at the share that is tried; all bodies are one world."""
    k = wp.tid()
    share = float(search[0, TRIED])
    total = wp.float64(0.0)
    while k < joined.counts[REACHED]:
        row = joined.reached[k]
        along = opened_by(row, change, rows, surface, carriers)
        e = opened_by(row, d, rows, surface, carriers) + share * along
        made = row_state(row, e, joined.most[row], rows, joined)
        total += wp.dot(wp.vec3d(made.force), wp.vec3d(along))
        k += threads
    if total != wp.float64(0.0):
        wp.atomic_add(slopes, 0, total)


@wp.kernel(enable_backward=False)
def end_rows(threads: int, rows: Rows, joined: Joined, added: wp.array[wp.vec3]):
    """Keep forces for the next step, and gather them at places, held ones too."""
    row = wp.tid()
    count = row_count(rows)
    while row < count:
        force = wp.vec3()
        if joined.stiffness[row] > 0.0:
            force = joined.force[row]
        rows.force[row] = force
        acts = int(0)
        if wp.dot(force, force) > 0.0:
            acts = 1
            p = rows.places[row]
            w = rows.shares[row]
            for k in range(4):
                wp.atomic_add(added, p[k], w[k] * force)
        rows.acts[row] = acts
        row += threads


@wp.kernel(enable_backward=False)
def keep_row_forces(threads: int, rows: Rows, joined: Joined, searches: wp.array[wp.int32]):
    """Keep forces for another search in the same step."""
    row = wp.tid()
    if row == 0:
        searches[0] = searches[0] + 1
    while row < row_count(rows):
        rows.force[row] = wp.where(joined.stiffness[row] > 0.0, joined.force[row], wp.vec3())
        row += threads


@wp.kernel(enable_backward=False)
def end_places(
    # In
    d: wp.array[wp.vec4],
    joined: Joined,
    carriers: Carriers,
    # In and out
    added: wp.array[wp.vec3],
    # Out
    surface: Surface,
):
    """What has come of the step at the places: where they began, motions and forces."""
    s = wp.tid()
    if surface.node[s] < 0:
        return
    surface.x[s] = joined.start[s]
    surface.d[s] = motion_at(s, surface, carriers, d)
    surface.f[s] = surface.f[s] + added[s]
    added[s] = wp.vec3()
