"""Whole steps of a small body in one thread block: nodes and forces in shared memory, many steps a launch.

A step of a thousand elements takes less time than a launch, so here a block stays with its world for many steps. Each
thread takes a complete subtree, or some of its leaves if there are too few worlds to fill the card, and writes its
nodal forces to slots; then each thread sums up the slots of a node and moves it. There are no atomic additions, so runs
are reproducible bit for bit. Only the final state leaves the multiprocessor.

If the leaves of a subtree share their dilatation, its threads first put their sums of it into shared memory.

CUDA only. ``tables.block_layout`` says which thread does what.
"""

import functools

import warp as wp

from warp_corot.kernels.corotated.corotated import turned_stress
from warp_corot.kernels.elements.constitutive import IsotropicMaterial
from warp_corot.kernels.elements.dilatation import VOLUME as VOLUME_CHANGE
from warp_corot.kernels.elements.dilatation import mean_of
from warp_corot.kernels.elements.elements import Subtrees, load_node, root_of, store_node
from warp_corot.kernels.elements.shapes import columns_of, leaf_forces_of
from warp_corot.kernels.elements.simd8 import law_kernel
from warp_corot.kernels.math.matrices import column
from warp_corot.kernels.subtrees.forces import (
    dilatation_sums_of,
    dilating_leaves,
    mat10,
    maubach_frame,
    own_forces,
    subtree_forces,
    turn_in,
    turn_out,
)
from warp_corot.kernels.tables.block_layout import (
    FIRST_SHIFT,
    FOLLOWING_SHIFT,
    NEIGHBOURS,
    NO_NODE,
    NODE_WORDS,
    NUMBERS,
    WARP,
    Layout,
)
from warp_corot.kernels.tables.shapes import VOLUME, fingerprint
from warp_corot.kernels.tables.subtree import HANDEDNESS, LEAVES, POSITIONS

from .block_memory import LOAD, LOAD_BYTES, STORE, shared_array
from .integrate import Dynamics, add_support_work, is_finite, load_at, symplectic_euler_velocity
from .pace import DONE, DT, Pace, length_before
from .threads import lowest_bit, number_in, shuffle_down, synchronize_block

wp.set_module_options({"enable_backward": False})

#: The number of threads for which a multiprocessor's registers must have room.
BUSY_THREADS = 640

vec3u = wp.types.vector(length=NODE_WORDS, dtype=wp.uint64)


@wp.struct
class BlockBody:
    """A body as a block reads it: the subtrees of one world, and which thread sums which slots."""

    subtrees: Subtrees  # of one world, not in groups
    subtree_count: int
    node_count: int
    element_count: int
    tasks: wp.array[wp.int32]  # [tasks] see ``FOLLOWING_SHIFT``
    nodes: wp.array2d[wp.uint64]  # [3, subtree_count] the ten nodes of each subtree, four to a word, in bytes
    slots: wp.array2d[wp.uint64]  # [2, tasks] four slots each, the zero one past the last, in bytes


def _table(rows: list[list[int]]) -> wp.Function:
    """A function that looks up whole numbers by row and column; a Warp matrix would be copied at every use."""
    numbers = ", ".join(str(number) for row in rows for number in row)
    snippet = f"""
    static const signed char numbers[{len(rows) * len(rows[0])}] = {{{numbers}}};
    return numbers[{len(rows[0])} * row + column];
"""

    @wp.func_native(snippet)
    def look_up(row: int, column: int) -> int: ...

    return look_up


def _vectors(rows: list) -> wp.Function:
    """A function that looks up constant vectors by number."""
    numbers = ", ".join(f"{float(c)!r}f" for row in rows for c in row)
    snippet = f"""
    static const float numbers[{3 * len(rows)}] = {{{numbers}}};
    return wp::vec_t<3, wp::float32>(numbers[3 * i], numbers[3 * i + 1], numbers[3 * i + 2]);
"""

    @wp.func_native(snippet)
    def look_up(i: int) -> wp.vec3: ...

    return look_up


def _displacements_of(layout: Layout, part: int, displacement: wp.Function) -> wp.Function:
    """A function that reads those of a subtree's ten displacements that a part of its leaves needs."""
    needs = layout.needs(part)

    @wp.func
    def displacements(words: vec3u):
        _generated_from = wp.static(fingerprint(needs))
        x = mat10()
        for k in range(10):
            if wp.static(needs[k]):
                number = number_in(words[k // wp.static(NUMBERS)], k % wp.static(NUMBERS))
                x[k] = displacement(wp.static(LOAD_BYTES), number, wp.vec3())
        return x

    return displacements


def _left_out_of(layout: Layout, displacement: wp.Function, slot: wp.Function) -> wp.Function:
    """A function that adds the forces of leaves that the closed form leaves out to the slots of their thread."""
    shape = layout.shape
    node_of, place_of = _table([list(leaf) for leaf in LEAVES[shape]]), _table(layout.places)
    handed = _table([[int(h)] for h in HANDEDNESS[shape]])
    rest_of = _vectors([[2.0 * c for c in point] for point in POSITIONS[shape]])
    columns, leaf_forces = columns_of(shape), leaf_forces_of(shape)

    @wp.func
    def position(words: vec3u, k: int, q: wp.mat33, inv_h: float):
        """Position of node k relative to the first node's displacement, in edge lengths of a leaf."""
        # Indexing the words with k would put them into local memory.
        word = wp.where(k < NUMBERS, words[0], wp.where(k < wp.static(2 * NUMBERS), words[1], words[2]))
        moved = displacement(wp.static(LOAD_BYTES), number_in(word, k % NUMBERS), wp.vec3())
        origin = displacement(wp.static(LOAD_BYTES), number_in(words[0], 0), wp.vec3())
        return (moved - origin) * inv_h + q * rest_of(k)

    @wp.func
    def add_to_slot(s: int, part: int, node: int, force: wp.vec3):
        at = s + place_of(part, node) * wp.static(layout.subtrees)
        slot(wp.static(STORE), at, slot(wp.static(LOAD), at, force) + force)

    @wp.func
    def add_left_out(
        body: BlockBody, s: int, part: int, degenerate: int, material: IsotropicMaterial, first_of_world: int
    ):
        """Add these forces, for any F; everything is read again, so that nothing is kept for this."""
        h, q, mirror = root_of(body.subtrees, s)
        words = vec3u(body.nodes[0, s], body.nodes[1, s], body.nodes[2, s])
        first = first_of_world + body.subtrees.first[s] * material.stride
        # Left-handed if ``mirror`` is -1.
        maubach = wp.matrix_from_cols(column(q, 0), column(q, 1), column(q, 2) * mirror)
        inv_h = 1.0 / h
        area = wp.static(VOLUME[shape]) * h * h
        left = int(degenerate)
        while left != 0:
            leaf = lowest_bit(left)
            left = left & (left - 1)
            at = first + leaf * material.stride
            m = area * material.mu[at]
            # A dilatation that leaves share has its own forces.
            k = wp.static(0.0 if layout.dilating else 1.0) * area * material.lam[at]
            c0, c1, c2 = columns(
                position(words, node_of(leaf, 0), maubach, inv_h),
                position(words, node_of(leaf, 1), maubach, inv_h),
                position(words, node_of(leaf, 2), maubach, inv_h),
                position(words, node_of(leaf, 3), maubach, inv_h),
            )
            hand = mirror * float(handed(leaf, 0))
            p = turned_stress(wp.matrix_from_cols(c0, c1, c2 * hand), m, k)
            f0, f1, f2, f3 = leaf_forces(column(p, 0), column(p, 1), hand * column(p, 2))
            add_to_slot(s, part, node_of(leaf, 0), f0)
            add_to_slot(s, part, node_of(leaf, 1), f1)
            add_to_slot(s, part, node_of(leaf, 2), f2)
            add_to_slot(s, part, node_of(leaf, 3), f3)

    return add_left_out


@functools.cache
def step_block(layout: Layout) -> wp.Kernel:
    """Symplectic Euler steps of the corotated model, a block a world; launch with blocks of ``layout.threads``.

    Args:
        layout: Which thread does what.
    """
    shape, uniform, parts, dilating = layout.shape, layout.uniform, layout.parts, layout.dilating
    capacity, threads, zero_slot = layout.subtrees, layout.threads, layout.slot_count
    own = [own_forces(shape, uniform, chosen=layout.leaves(part)) for part in range(parts)]
    needs, places = [layout.needs(part) for part in range(parts)], layout.places
    displacement, velocity = shared_array(layout.nodes, "displacements"), shared_array(layout.nodes, "velocities")
    displacements = [_displacements_of(layout, part, displacement) for part in range(parts)]
    slot = shared_array(zero_slot + 1, "forces")
    slope_of = VOLUME_CHANGE.slope
    measure = [dilatation_sums_of(shape, uniform, VOLUME_CHANGE, layout.leaves(part)) for part in range(parts)]
    # Law and pressure are one pass, after a first pass for the sums if two threads share a subtree.
    law = dilating_leaves(shape)
    dilate = [subtree_forces(shape, uniform, law, layout.leaves(part)) for part in range(parts)]
    sums = shared_array(max(layout.sum_count, 1), "sums of dilatations", float)
    add_left_out = _left_out_of(layout, displacement, slot)

    @law_kernel(
        grid_stride=False,
        launch_bounds=(threads, max(BUSY_THREADS // threads, 1)),
    )
    def step_block(
        # In
        body: BlockBody,
        steps: int,
        dynamics: Dynamics,
        material: IsotropicMaterial,
        mass: wp.array[wp.float32],
        pace: Pace,
        # Out
        reactions: wp.array[wp.vec4],
        support_work: wp.array[wp.float64],
        bad_step: wp.array[wp.int64],
    ):
        _generated_from = wp.static(fingerprint(needs, places))
        dt = float(pace.seconds[DT])
        kick = 0.5 * (float(length_before(pace)) + dt)
        world = wp.tid() // wp.static(threads)
        thread = wp.tid() % wp.static(threads)
        base = world * body.node_count
        place = thread
        while place < body.node_count:
            displacement(wp.static(STORE), place, load_node(dynamics.u, base + place))
            velocity(wp.static(STORE), place, load_node(dynamics.v, base + place))
            place += wp.static(threads)
        if thread == 0:
            slot(wp.static(STORE), wp.static(zero_slot), wp.vec3())
        synchronize_block()
        warp = thread // wp.static(WARP)
        part = warp % wp.static(parts)
        s = (warp // wp.static(parts)) * wp.static(WARP) + thread % wp.static(WARP)
        mine = wp.min(s, body.subtree_count - 1)
        h, q, mirror = root_of(body.subtrees, mine)
        first_of_world = world * body.element_count * material.stride
        first = first_of_world + body.subtrees.first[mine] * material.stride
        damped = 1.0 / (1.0 + dt * dynamics.damping)
        # Each thread keeps up to two nodes in registers from here on.
        words = vec3u()
        for word in range(wp.static(NODE_WORDS)):
            words[word] = body.nodes[word, mine]
        task = wp.min(thread, wp.static(layout.tasks - 1))
        about = body.tasks[task]
        numbers0 = body.slots[0, task]
        numbers1 = body.slots[1, task]
        step = int(0)
        while step < steps:
            degenerate = int(0)
            if wp.static(dilating and parts > 1):
                if s < body.subtree_count:
                    for p in range(wp.static(parts)):
                        if part == p:
                            x = wp.static(displacements[p])(words)
                            q0, q1, q2 = maubach_frame(q, mirror)
                            y = turn_in(x, q0, q1, q2, 1.0 / h)
                            sum, weight = wp.static(measure[p])(y, material.lam, first)
                            sums(wp.static(STORE), wp.static(2 * p * capacity) + s, sum)
                            sums(wp.static(STORE), wp.static((2 * p + 1) * capacity) + s, weight)
                synchronize_block()
            if s < body.subtree_count:
                for p in range(wp.static(parts)):
                    if part == p:
                        x = wp.static(displacements[p])(words)
                        g = mat10()
                        if wp.static(dilating):
                            q0, q1, q2 = maubach_frame(q, mirror)
                            y = turn_in(x, q0, q1, q2, 1.0 / h)
                            sum = float(0.0)
                            weight = float(0.0)
                            if wp.static(parts == 1):
                                sum, weight = wp.static(measure[p])(y, material.lam, first)
                            else:
                                for other in range(wp.static(parts)):
                                    sum += sums(wp.static(LOAD), wp.static(2 * other * capacity) + s, sum)
                                    weight += sums(wp.static(LOAD), wp.static((2 * other + 1) * capacity) + s, weight)
                            pressure = slope_of(mean_of(sum, weight))
                            g, degenerate = wp.static(dilate[p])(y, h, material, pressure, first)
                            g = turn_out(g, q0, q1, q2)
                        else:
                            g, degenerate = wp.static(own[p])(x, q, h, mirror, material, first)
                        for k in range(10):
                            if wp.static(places[p][k] >= 0):
                                slot(wp.static(STORE), s + wp.static(places[p][k] * capacity), g[k])
                if degenerate != 0:
                    add_left_out(body, s, part, degenerate, material, first_of_world)
            synchronize_block()
            task = thread
            while task < wp.static(layout.tasks):
                if wp.static(layout.tasks > threads):
                    about = body.tasks[task]
                    numbers0 = body.slots[0, task]
                    numbers1 = body.slots[1, task]
                force = wp.vec3()
                for k in range(wp.static(NUMBERS)):
                    force += slot(wp.static(LOAD_BYTES), number_in(numbers0, k), force)
                for k in range(wp.static(NUMBERS)):
                    force += slot(wp.static(LOAD_BYTES), number_in(numbers1, k), force)
                following = (about >> wp.static(FOLLOWING_SHIFT)) & 255
                distance = int(1)
                while distance < wp.static(NEIGHBOURS):
                    theirs = shuffle_down(force, distance)
                    if distance <= following:
                        force += theirs
                    distance *= 2
                if (about >> wp.static(FIRST_SHIFT)) == 1:
                    place = about & wp.static(NO_NODE)
                    i = base + place
                    elastic = force
                    force += load_at(i, dynamics)
                    w = dynamics.inverse_mass[i]
                    moving = velocity(wp.static(LOAD), place, force)
                    if w > 0.0:
                        moving = symplectic_euler_velocity(moving, force, w, dynamics.gravity, kick, damped)
                        velocity(wp.static(STORE), place, moving)
                    else:
                        add_support_work(elastic, kick * moving, support_work)
                        if step == steps - 1:
                            store_node(reactions, i, -(force + mass[i] * dynamics.gravity))
                    moved = displacement(wp.static(LOAD), place, force) + dt * moving
                    displacement(wp.static(STORE), place, moved)
                    if not is_finite(moved):
                        wp.atomic_min(bad_step, 0, pace.counts[DONE] + wp.int64(step + 1))
                task += wp.static(threads)
            synchronize_block()
            kick = dt
            step += 1
        place = thread
        while place < body.node_count:
            store_node(dynamics.u, base + place, displacement(wp.static(LOAD), place, wp.vec3()))
            store_node(dynamics.v, base + place, velocity(wp.static(LOAD), place, wp.vec3()))
            place += wp.static(threads)

    return step_block
