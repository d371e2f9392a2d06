"""Contact forces of an explicit step: projected Jacobi iterations over all contacts, with split masses.

A contact is a place and an obstacle, a triangle and an obstacle, or a pair of soft surfaces. Contacts that push one
node divide its mass in proportion to their weights there. Then the iterations converge and add no energy for any
number of contacts (mass splitting; the bound is the sum of each row of J M^-1 J^T; Tonge, Benevolenski and Voroshilov
2012).

Forces are summed at nodes as integers, so that the order of threads does not matter. An iteration reads the sums of one
buffer and writes those of the other: so it ends with one barrier. On CUDA resident blocks of threads make all
iterations of a step in one launch.
"""

# ruff: noqa: SIM102, SIM108 (Warp leaves out a branch if its whole condition is static; a struct is chosen by one.)
import functools
from types import SimpleNamespace

import warp as wp

from warp_corot.kernels.elements.simd8 import on_cpu
from warp_corot.kernels.modules import INLINED, unique_kernel
from warp_corot.kernels.stepping.pace import DT, Pace
from warp_corot.kernels.stepping.threads import spread_thread, synchronize_blocks, synchronize_grid

from .bearing import MOSTLY, is_borne, left_between, loose_share
from .explicit_rows import ACTS, BEGINS, ENDS, OUT, WAITS, Rigid, anchor, begin_place, find_touch
from .law import Law, across, held_back, least_motion, left_to_held
from .locate import is_apart, list_by_warp, locate_row
from .motion import Surface
from .rows import Rows, row_count
from .watch import BESIDE, Near

wp.set_module_options({"enable_backward": False})

#: Number of threads of a block on CUDA: few, because the work of few contacts takes its time in the exchange of one
#: multiprocessor with memory.
BLOCK = wp.constant(64)
#: Weights are summed in multiples of one over this.
SHARES = wp.constant(1048576.0)
#: The first phase of a step. Iterations follow, and then the end.
LOCATE = wp.constant(0)
#: Threads of a warp.
WARP = wp.constant(32)


@wp.struct
class Sums:
    """What contacts add up at places that are nodes, [S], and after these at bearers, [B]; zero between steps."""

    touched: wp.array[wp.int32]  # [S + B] whether anything was added
    weights: wp.array2d[wp.int32]  # [2, S + B] of the contacts that act, in multiples of one over SHARES
    forces: wp.array2d[wp.vec3l]  # [2, S + B] in multiples of ``Law.grain``
    live: wp.array[wp.int32]  # contacts that may act in this step, by their numbers
    live_count: wp.array[wp.int32]  # [2] how many in this step while forces are found, and in the last one
    is_shared: int  # whether several threads of the CPU add at the same time
    arrived: wp.array[wp.uint32]  # [2 LINE] the barriers of all blocks, and of those with contacts that may act


@wp.struct
class Parents:
    """The nodes that move a place, by their numbers in ``Sums``: those that bear it, or itself."""

    nodes: wp.vec4i
    weights: wp.vec4  # zero for none
    inverse_masses: wp.vec4  # as ``Surface.yielding`` [m/N]


@wp.struct
class Contact:
    """A contact: up to four places with weights, whose weighted motion opens it."""

    places: wp.vec4i  # -1 for none
    weights: wp.vec4
    parents: Parents  # of the first place
    normal: wp.vec3
    gap: float  # [m]
    moved: wp.vec3  # motion of the obstacle's point in this step [m]
    friction: float
    loose: float  # the sum of the places' shares of free nodes
    opens: wp.vec3  # its motion in this step without contact forces [m]
    free: wp.vec3  # the part of this that free nodes have
    least: float  # how much it must open [m]
    force: wp.vec3  # on the side with positive weights [N]
    more: wp.vec3  # its change in the last iteration [N]
    acts: int


@wp.struct
class Contacts:
    """All that there may be: the rows of obstacles, and then the pairs."""

    first_pair: int  # the first number of a pair
    rigid: Rigid
    searched: wp.array[wp.vec3]  # [S] positions at the last search for pairs [m]
    pairs: Rows


@wp.func
def parents_of(s: int, surface: Surface):
    """The nodes that move a place."""
    found = Parents()
    if is_borne(s, surface):
        b = surface.bearing.bearers[s]
        nodes = surface.node.shape[0]
        found.nodes = b + wp.vec4i(nodes, nodes, nodes, nodes)
        found.weights = surface.bearing.weights[s]
        found.inverse_masses = wp.vec4(
            surface.bearing.yielding[b[0]],
            surface.bearing.yielding[b[1]],
            surface.bearing.yielding[b[2]],
            surface.bearing.yielding[b[3]],
        )
    else:
        found.nodes = wp.vec4i(s, s, s, s)
        found.weights = wp.vec4(1.0, 0.0, 0.0, 0.0)
        found.inverse_masses = wp.vec4(surface.yielding[s], 0.0, 0.0, 0.0)
    return found


@wp.func
def read_row(r: int, rows: Rows):
    """A row that has been located in this step, without its places."""
    found = Contact()
    found.weights = rows.weights[r]
    found.normal = rows.normal[r]
    found.gap = rows.gap[r]
    found.moved = rows.moved[r]
    found.friction = rows.friction[r]
    found.force = rows.force[r]
    found.more = rows.more[r]
    found.acts = rows.acts[r]
    return found


@wp.func
def keep_row(r: int, contact: Contact, rows: Rows):
    """Store what an iteration changes."""
    rows.force[r] = contact.force
    rows.more[r] = contact.more
    rows.acts[r] = contact.acts


# --- sums at nodes ---------------------------------------------------------------------------------------------------


@wp.func
def grains_of(force: wp.vec3, grain: float):
    g = force / grain
    return wp.vec3l(wp.int64(g[0]), wp.int64(g[1]), wp.int64(g[2]))


@wp.func
def force_of(grains: wp.vec3l, grain: float):
    return grain * wp.vec3(float(grains[0]), float(grains[1]), float(grains[2]))


@wp.func
def share_of(weight: float):
    """A weight in multiples of one over ``SHARES``."""
    return wp.max(int(SHARES * wp.abs(weight)), 1)


_ADD_INTEGERS = on_cpu(
    """
    auto* to = reinterpret_cast<Integer*>(&wp::index(a, i, j));
    const auto* from = reinterpret_cast<const Integer*>(&value);
    for (int k = 0; k < sizeof(value) / sizeof(Integer); ++k)
        if (is_shared) __atomic_fetch_add(to + k, from[k], __ATOMIC_RELAXED);
        else to[k] += from[k];
""",
    otherwise="wp::atomic_add(a, i, j, value);\n",
)


@wp.func_native(_ADD_INTEGERS.replace("Integer", "int"))
def add_integers(a: wp.array2d[wp.int32], i: int, j: int, value: int, is_shared: int): ...


@wp.func_native(_ADD_INTEGERS.replace("Integer", "long long"))
def add_integers(a: wp.array2d[wp.vec3l], i: int, j: int, value: wp.vec3l, is_shared: int): ...


@wp.func
def add_at(n: int, weight: float, times: int, force: wp.vec3, buffer: int, grain: float, sums: Sums):
    """Add a contact's part at a node; see ``add``."""
    if times != 0:
        sums.touched[n] = 1
        add_integers(sums.weights, buffer, n, times * share_of(weight), sums.is_shared)
    if wp.dot(force, force) > 0.0:
        add_integers(sums.forces, buffer, n, grains_of(weight * force, grain), sums.is_shared)


@wp.func
def take_force(n: int, buffer: int, grain: float, sums: Sums):
    """The force at a node at the end of a step [N], of which the sums become zero."""
    force = force_of(sums.forces[buffer, n], grain)
    sums.touched[n] = 0
    for other in range(2):
        sums.weights[other, n] = 0
        sums.forces[other, n] = wp.vec3l()
    return force


@wp.func
def pushed(parents: Parents, buffer: int, grain: float, sums: Sums):
    """How far the forces of a buffer move a place in this step [m]; and how far it moves for each unit of force if all
    contacts at its nodes push in proportion to their weights [m/N].
    """
    d = wp.vec3()
    compliance = float(0.0)
    # Without branches, so that CUDA loads all at once.
    for m in range(4):
        n = parents.nodes[m]
        mobility = parents.inverse_masses[m]
        d += (parents.weights[m] * mobility) * force_of(sums.forces[buffer, n], grain)
        compliance += wp.abs(parents.weights[m]) * mobility * float(sums.weights[buffer, n])
    return d, compliance / SHARES


# --- the phases of a step --------------------------------------------------------------------------------------------


@functools.cache
def phases(has_triangles: bool, has_pairs: bool) -> SimpleNamespace:
    """The functions of a step with obstacles at places and, if so, at triangles, and with soft pairs. What is not there
    is not compiled: most of the code is, as each contact there has up to four places.
    """
    most = 4 if has_pairs else 3 if has_triangles else 1

    @wp.func
    def contact_of(number: int, dt: float, all: Contacts):
        """The contact with a number, which has been located in this step."""
        found = Contact()
        surface = all.rigid.surface
        if number < all.first_pair:
            found = read_row(number, all.rigid.rows)
            found.places = wp.vec4i(number % all.rigid.surface.node.shape[0], -1, -1, -1)
            if wp.static(most == 1):
                found.weights = wp.vec4(1.0, 0.0, 0.0, 0.0)
            if wp.static(has_triangles):
                if number >= all.rigid.first_triangle:
                    c = surface.triangles[(number - all.rigid.first_triangle) % surface.triangles.shape[0]]
                    found.places = wp.vec4i(c[0], c[1], c[2], -1)
        if wp.static(has_pairs):
            if number >= all.first_pair:
                found = read_row(number - all.first_pair, all.pairs)
                found.places = all.pairs.places[number - all.first_pair]
        found.parents = parents_of(found.places[0], surface)
        found.opens = -found.moved
        for k in range(most):
            weight = found.weights[k]
            if weight != 0.0:
                s = found.places[k]
                share = loose_share(s, surface)
                found.loose += wp.abs(weight) * share
                found.opens += weight * surface.d[s]
                if share > 0.0:
                    found.free += weight * surface.d[s]
        gap = found.gap
        if found.loose < MOSTLY:
            gap += left_between(found.places, found.weights, gap, found.loose, found.normal, surface)
        found.least = least_motion(gap, all.rigid.law, dt)
        return found

    @wp.func
    def keep(number: int, contact: Contact, all: Contacts):
        if number < all.first_pair:
            keep_row(number, contact, all.rigid.rows)
        if wp.static(has_pairs):
            if number >= all.first_pair:
                keep_row(number - all.first_pair, contact, all.pairs)

    @wp.func
    def add(contact: Contact, times: int, force: wp.vec3, buffer: int, grain: float, surface: Surface, sums: Sums):
        """Add a contact's weights at the nodes of its places so many times, 1 if it begins to act and -1 if it ends;
        and a force."""
        for k in range(most):
            weight = contact.weights[k]
            if weight != 0.0:
                parents = contact.parents
                if k > 0:
                    parents = parents_of(contact.places[k], surface)
                for m in range(4):
                    w = parents.weights[m]
                    if w != 0.0:
                        add_at(parents.nodes[m], weight * w, times, force, buffer, grain, sums)

    @wp.func
    def locate(number: int, dt: float, all: Contacts, sums: Sums):
        """Find a contact in this step, with the force with which it begins. Returns whether it may act."""
        surface = all.rigid.surface
        law = all.rigid.law
        is_near = bool(False)
        if number < all.rigid.first_triangle:
            is_near = begin_place(number, dt, all.rigid)
        if wp.static(has_triangles):
            if number >= all.rigid.first_triangle and number < all.first_pair:
                is_near = find_touch(number, all.rigid)
        if wp.static(has_pairs):
            if number >= all.first_pair:
                is_near = locate_row(number - all.first_pair, law, surface, all.pairs)
        if not is_near:
            return 0
        contact = contact_of(number, dt, all)
        pushes = wp.dot(contact.force, contact.force) > 0.0
        if pushes or contact.least > wp.dot(contact.opens, contact.normal):
            contact.acts = ACTS
            # A loop that is not unrolled: less code to fetch.
            buffer = int(0)
            while buffer < 2:
                add(contact, 1, contact.force, buffer, law.grain, surface, sums)
                buffer += 1
            keep(number, contact, all)
        return 1

    @wp.func
    def iterate(contact: Contact, before: int, law: Law, surface: Surface, sums: Sums):
        """Correct the force of a contact, with the sums of the buffer ``before`` and into the other one."""
        opens = contact.opens
        free = contact.free
        compliance = float(0.0)
        for k in range(most):
            weight = contact.weights[k]
            if weight != 0.0:
                parents = contact.parents
                if k > 0:
                    parents = parents_of(contact.places[k], surface)
                motion, own = pushed(parents, before, law.grain, sums)
                opens += weight * motion
                free += weight * motion
                compliance += wp.abs(weight) * own
        n = contact.normal
        wanted = contact.least - wp.dot(opens, n)
        # The other buffer has not got the last changes yet.
        added = contact.more
        contact.more = wp.vec3()
        counted = int(0)
        if contact.acts == BEGINS:
            counted += 1
            contact.acts = ACTS
        elif contact.acts == ENDS:
            counted -= 1
            contact.acts = WAITS
        if contact.acts == ACTS:
            force = wp.vec3()
            if compliance > 0.0:
                wanted -= left_to_held(wanted + wp.dot(free, n), contact.loose)
                normal_force = wp.max(wp.dot(contact.force, n) + wanted / compliance, 0.0)
                sideways = across(contact.force, n) - across(opens, n) / compliance
                force = normal_force * n + held_back(sideways, normal_force, contact.friction)
            contact.more = force - contact.force
            contact.force = force
            added += contact.more
            if wp.dot(force, force) == 0.0:
                counted -= 1
                contact.acts = ENDS
        elif wanted > 0.0:
            counted += 1
            contact.acts = BEGINS
        add(contact, counted, added, 1 - before, law.grain, surface, sums)
        return contact

    @wp.func
    def contact_count(near: Near, all: Contacts):
        """How many contacts there may be in this step."""
        count = near.count[0] * all.rigid.shapes.kind.shape[0]
        if wp.static(has_triangles):
            count += near.touch_count[0]
        if wp.static(has_pairs):
            count += row_count(all.pairs)
        return count

    @wp.func
    def number_of(k: int, near: Near, all: Contacts):
        """The number of the k-th of them; -1 for a place that no obstacle is near."""
        obstacles = all.rigid.shapes.kind.shape[0]
        beside = near.count[0] * obstacles
        if k < beside:
            s = near.nodes[k // obstacles]
            if (near.flags[s] & BESIDE) != 0:
                return (k % obstacles) * all.rigid.surface.node.shape[0] + s
            return -1
        touches = int(beside)
        if wp.static(has_triangles):
            touches += near.touch_count[0]
            if k < touches:
                return all.rigid.first_triangle + near.touches[k - beside]
        if wp.static(has_pairs):
            if k < touches + row_count(all.pairs):
                return all.first_pair + k - touches
        return -1

    return SimpleNamespace(
        contact_of=contact_of,
        keep=keep,
        locate=locate,
        iterate=iterate,
        contact_count=contact_count,
        number_of=number_of,
    )


@wp.func
def end_place(s: int, buffer: int, near: Near, all: Contacts, sums: Sums):
    """Find where a place goes in this step, and update its anchors."""
    surface = all.rigid.surface
    d, _compliance = pushed(parents_of(s, surface), buffer, all.rigid.law.grain, sums)
    surface.d[s] = surface.d[s] + d
    if (near.flags[s] & BESIDE) != 0:
        anchor(s, all.rigid)


@wp.func
def clear_lists(sums: Sums):
    sums.live_count[1] = sums.live_count[0]
    sums.live_count[0] = 0


@wp.func
def is_pushed(contact: Contact, surface: Surface, sums: Sums):
    """Whether any contact has acted on a place of this one, which otherwise goes on waiting."""
    pushed = int(0)
    for k in range(4):
        if contact.weights[k] != 0.0:
            parents = contact.parents
            if k > 0:
                parents = parents_of(contact.places[k], surface)
            for m in range(4):
                pushed |= sums.touched[parents.nodes[m]]
    return pushed != 0


@functools.cache
def solver(has_triangles: bool, has_pairs: bool, on_cpu: bool) -> wp.Kernel:
    """The kernel of these contacts; see ``phases``. A thread of the CPU takes one contact after another."""
    of = phases(has_triangles, has_pairs)
    contact_of, keep, locate, iterate = of.contact_of, of.keep, of.locate, of.iterate
    contact_count, number_of = of.contact_count, of.number_of
    # Loops over the four places and their four nodes would be 16 times their code, which the CPU's compiler takes
    # twice as long to compile and which is no faster.
    max_unroll = 1 if on_cpu else None

    @wp.func
    def correct(number: int, before: int, dt: float, all: Contacts, sums: Sums):
        """Correct the force of a contact in memory; see ``iterate``."""
        contact = contact_of(number, dt, all)
        if contact.acts != OUT:
            keep(number, iterate(contact, before, all.rigid.law, all.rigid.surface, sums), all)

    @wp.func
    def correct_listed(
        k: int, phase: int, iterations: int, dt: float, all: Contacts, records: wp.array[Contact], sums: Sums
    ):
        """Correct the force of the k-th contact that may act; between iterations it is in a record, if there is one."""
        contact = Contact()
        if phase == LOCATE + 1 or k >= records.shape[0]:
            contact = contact_of(sums.live[k], dt, all)
        else:
            contact = records[k]
        if contact.acts != WAITS or is_pushed(contact, all.rigid.surface, sums):
            contact = iterate(contact, (phase - 1) % 2, all.rigid.law, all.rigid.surface, sums)
        if phase < iterations and k < records.shape[0]:
            records[k] = contact
        else:
            keep(sums.live[k], contact, all)

    @unique_kernel(INLINED, fast_math=True, max_unroll=max_unroll, grid_stride=False, launch_bounds=(64, 4))
    def solve_contacts(
        # In
        threads: int,
        part: int,
        first: int,
        last: int,
        iterations: int,
        are_separate: int,
        awake: wp.array[wp.int32],
        near: Near,
        listed: wp.array[wp.int32],
        listed_count: wp.array[wp.int32],
        pace: Pace,
        # In and out
        all: Contacts,
        records: wp.array[Contact],
        sums: Sums,
    ):
        """Make some phases of a step: the first one finds all contacts, then there are the iterations, and the last
        one finds where places go and updates anchors.

        Args:
            threads: The number of threads, of blocks that are all resident; on the CPU each has a launch of its own.
            part: The number of this launch among those.
            first, last: The phases, from 0 to ``iterations`` + 1.
            awake: Whether contact is awake, [1]; there are no contacts if it is not.
            are_separate: Whether no two contacts share a node: places that are nodes, and one obstacle. Then a thread
                goes through all phases of a place by itself.
            listed, listed_count: On the CPU the contacts of places that may act, and how many there are; empty: any.
            records: On the CPU memory for as many contacts as there usually are.
        """
        thread = part + wp.tid()
        if awake[0] == 0:
            return
        dt = float(pace.seconds[DT])
        start = int(thread)
        if wp.static(not on_cpu):
            start = spread_thread(thread, threads, BLOCK)
        k = int(start)
        if first == LOCATE:
            beyond = contact_count(near, all)
            if wp.static(not on_cpu):
                # Warps stay together.
                beyond += wp.where(threads > 1, thread % WARP, 0)
            elif listed.shape[0] > 0:
                beyond = listed_count[0] + near.touch_count[0]
            while k < beyond:
                number = int(-1)
                if listed.shape[0] == 0:
                    number = number_of(k, near, all)
                elif k < listed_count[0]:
                    number = listed[k]
                else:
                    number = all.rigid.first_triangle + near.touches[k - listed_count[0]]
                if wp.static(on_cpu and has_pairs):
                    row = number - all.first_pair
                    if row >= 0 and is_apart(row, all.rigid.law, all.rigid.surface, all.searched, all.pairs):
                        number = -1
                may_act = int(0)
                if number >= 0:
                    may_act = locate(number, dt, all, sums)
                if wp.static(on_cpu):
                    if may_act != 0 and are_separate != 0:
                        for iteration in range(iterations):
                            correct(number, iteration % 2, dt, all, sums)
                list_by_warp(sums.live, sums.live_count, number, wp.where(are_separate != 0, 0, may_act))
                k += threads
        phase = wp.max(first, LOCATE + 1)
        if wp.static(on_cpu):
            while phase <= wp.min(last, iterations) and are_separate == 0:
                k = int(start)
                while k < sums.live_count[0]:
                    correct_listed(k, phase, iterations, dt, all, records, sums)
                    k += threads
                phase += 1
        else:
            live = int(0)
            own = int(-1)
            mine = Contact()
            blocks = int(1)
            while phase <= wp.min(last, iterations):
                if phase > first and are_separate == 0:
                    if phase == LOCATE + 1:
                        synchronize_grid(sums.arrived)
                    else:
                        synchronize_blocks(sums.arrived, 1, blocks)
                if own < 0:
                    live = wp.where(are_separate != 0, near.count[0], sums.live_count[0])
                    # Only blocks that have any of them wait for one another.
                    blocks = wp.clamp((live + WARP - 1) // WARP, 1, wp.max(threads // BLOCK, 1))
                k = int(start)
                if thread // BLOCK >= blocks:
                    phase = iterations
                    live = 0
                while k < live:
                    number = own
                    contact = mine
                    if k != start or own < 0:
                        number = sums.live[k]
                        if are_separate != 0:
                            number = near.nodes[k]
                        contact = contact_of(number, dt, all)
                    if contact.acts != OUT:
                        contact = iterate(contact, (phase - 1) % 2, all.rigid.law, all.rigid.surface, sums)
                    # A thread's first contact stays in registers.
                    if k == start:
                        own = number
                        mine = contact
                    else:
                        keep(number, contact, all)
                    k += threads
                phase += 1
            if own >= 0:
                keep(own, mine, all)
        if last > iterations:
            if first < last and are_separate == 0:
                synchronize_grid(sums.arrived)
            if thread == 0:
                clear_lists(sums)
            k = int(start)
            while k < near.count[0]:
                end_place(near.nodes[k], iterations % 2, near, all, sums)
                k += threads

    return solve_contacts
