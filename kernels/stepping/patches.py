"""Many steps of an organ in one launch of resident thread blocks, each of which keeps a patch of nodes.

A block computes every element that touches one of its nodes, including those between patches. So blocks do not exchange
forces, and no block waits for all others. Blocks exchange displacements: each publishes those of its nodes and waits
for those of its halo, the other corners of its elements. A displacement is one word of 16 bytes, and its last four
bytes are the step's number. A reader that sees the number has the value, without fences or counters. Two buffers
alternate: a block publishes step n + 1 only after it has seen step n of all its neighbours, which have then read its
step n - 1.

If elements share their dilatation, a block also measures the other elements of its elements' groups. Each element
writes its dilatation to the row of its group, one thread for each group sums the row, and a second pass adds the forces
of the pressure.

All blocks of a launch, those of all worlds, must be resident at the same time, one on each multiprocessor. Sums have a
fixed order, so runs are reproducible bit for bit. CUDA only; ``solvers.explicit.patches`` divides the work among
blocks.
"""

import functools
from dataclasses import dataclass

import warp as wp

from warp_corot.kernels.corotated.corotated import stretch_stress, turned_stress
from warp_corot.kernels.elements.dilatation import VOLUME, pressure_stress_of
from warp_corot.kernels.elements.elements import load_node, store_node
from warp_corot.kernels.elements.simd8 import law_kernel
from warp_corot.kernels.math.matrices import column, identity3
from warp_corot.kernels.tables.shapes import fingerprint

from .block_memory import LOAD, STORE, array_at
from .integrate import Dynamics, add_support_work, is_finite, load_at, symplectic_euler_velocity
from .pace import DONE, DT, Pace, length_before, time_after
from .threads import lowest_bit, number_in, shuffle_down, synchronize_any, synchronize_block

wp.set_module_options({"enable_backward": False})


#: A column of ``PatchBody.rest`` has the inverse of the matrix of rest edges, row by row, then the volume.
VOLUME_ROW = 9


@dataclass(frozen=True)
class Layout:
    """The numbers for which a kernel is generated.

    Attributes:
        threads: Threads of a block.
        elements, halo: Number of elements that a thread computes, and of halo nodes that it waits for.
        lanes: Threads that sum the forces on one node.
        nodes, slots: Room for displacements and for forces in shared memory; one more slot takes forces that are not
            used.
        groups, members: Room for groups that share a dilatation and for the elements of each; zero if none do.
        overlaps: Whether a block computes the elements that need no halo before it waits for the halo.
    """

    threads: int
    elements: int
    halo: int
    lanes: int
    nodes: int
    slots: int
    groups: int = 0
    members: int = 0
    overlaps: bool = True

    @property
    def vectors(self) -> int:
        return self.nodes + self.slots + 1

    @property
    def floats(self) -> int:
        """The shared memory of a block, in float32 numbers."""
        return 3 * self.vectors + self.groups * (2 * self.members + 2)


@wp.struct
class PatchBody:
    """The patches of each world of a body; see ``solvers.explicit.patches.Patches``."""

    element_count: int  # of the mesh
    own: wp.array[wp.int32]  # [N] of one world, as all that is not said to be of others
    own_start: wp.array[wp.int32]  # [patches + 1], as the other starts
    halo: wp.array[wp.int32]
    halo_start: wp.array[wp.int32]
    elements: wp.array[wp.int32]  # [E]
    element_start: wp.array[wp.int32]
    interior: wp.array[wp.int32]  # [patches] number of a patch's elements that need no halo; they come first
    computed: wp.array[wp.int32]  # [patches] number of elements that it computes; it only measures the others
    measures: wp.array[wp.int32]  # [E] where an element's dilatation goes: group by group, one row a member
    corners: wp.array[wp.uint64]  # [E] the four corners' places among the patch's nodes, 16 bits each
    slots: wp.array[wp.uint64]  # [E] the places of the corners' forces in the same form
    bases: wp.array[wp.int32]
    base_start: wp.array[wp.int32]
    rest: wp.array2d[wp.float32]  # [10, E] see ``VOLUME_ROW``
    # Keyframes of all trajectories, one after another.
    trajectory: wp.array[wp.int32]  # [worlds N] the trajectory that a node follows, or -1
    place: wp.array[wp.int32]  # [worlds N] the node's column there
    key_start: wp.array[wp.int32]  # [trajectories + 1] into ``times``
    value_start: wp.array[wp.int32]  # [trajectories] into ``values``, whose rows have ``columns`` entries
    columns: wp.array[wp.int32]  # [trajectories]
    times: wp.array[wp.float64]
    values: wp.array[wp.vec3]


# --- the exchange of displacements between blocks that run at the same time ------------------------------------------


#: How often a block polls for a displacement before it gives up; this takes some seconds.
MOST_LOOKS = 1 << 22


@wp.struct
class Exchange:
    """The arrays through which blocks exchange displacements."""

    nodes: int  # of all worlds
    published: wp.array[
        wp.vec4
    ]  # [2 nodes] displacements of even and of odd steps; w holds the bits of the step's number
    begun: wp.array[wp.uint32]  # [worlds patches] the number of the next launch's first state


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const unsigned long long low = ((unsigned long long)__float_as_uint(value[1]) << 32) | __float_as_uint(value[0]);
    const unsigned long long high = ((unsigned long long)number << 32) | __float_as_uint(value[2]);
    asm volatile("{ .reg .b128 all; mov.b128 all, {%1, %2}; st.relaxed.gpu.global.b128 [%0], all; }"
        :: "l"(&wp::index(published, i)), "l"(low), "l"(high) : "memory");
#endif
""")
def publish(published: wp.array[wp.vec4], i: int, value: wp.vec3, number: wp.uint32):
    """Write a displacement and its number in one access."""
    ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    unsigned long long low = 0, high = 0;
    for (int look = 0; look < {MOST_LOOKS}; ++look) {{
        asm volatile("{{ .reg .b128 all; ld.relaxed.gpu.global.b128 all, [%2]; mov.b128 {{%0, %1}}, all; }}"
            : "=l"(low), "=l"(high) : "l"(&wp::index(published, i)) : "memory");
        if ((unsigned)(high >> 32) == number)
            return wp::vec_t<4, wp::float32>(__uint_as_float((unsigned)low), __uint_as_float((unsigned)(low >> 32)),
                                             __uint_as_float((unsigned)high), 0.0f);
    }}
#endif
    return wp::vec_t<4, wp::float32>(0.0f, 0.0f, 0.0f, 1.0f);
""")
def await_displacement(published: wp.array[wp.vec4], i: int, number: wp.uint32) -> wp.vec4:
    """Wait for the displacement of the step ``number``; the last component is 0, or 1 if it did not arrive."""
    ...


WARP = 32
#: The numbers that a thread keeps for an element: the inverse rest edges, the volume times mu and the volume times
#: lambda.
CONSTANTS = 11

row = wp.types.vector(length=CONSTANTS, dtype=wp.float32)


@wp.func
def rest_inverse(c: row):
    return wp.mat33(c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7], c[8])


@wp.func
def key_from(times: wp.array[wp.float64], key: int, last: int, t: wp.float64):
    """The same as ``pace.key_before``, but the search starts at an earlier key; ``last`` is the last key but
    one."""
    found = key
    while found < last and times[found + 1] <= t:
        found += 1
    share = (t - times[found]) / (times[found + 1] - times[found])
    return found, float(wp.clamp(share, wp.float64(0.0), wp.float64(1.0)))


@functools.cache
def step_patches(layout: Layout) -> wp.Kernel:
    """Symplectic Euler steps of the corotated model with own rotations; launch ``layout.threads`` threads for each
    patch of each world.

    Args:
    """
    threads, each, halo_each, lanes = layout.threads, layout.elements, layout.halo, layout.lanes
    slot, displacement = array_at(0), array_at(3 * (layout.slots + 1))
    # Weighted dilatations and weights of elements, inverse weights of groups, and pressures of groups.
    shares, groups, members = layout.groups > 0, layout.groups, layout.members
    first_number = 3 * layout.vectors
    measured = array_at(first_number, float)
    weight_of = array_at(first_number + groups * members, float)
    inverse_weight = array_at(first_number + groups * 2 * members, float)
    pressure_of = array_at(first_number + groups * (2 * members + 1), float)
    measure, slope_of, pressure_stress = VOLUME.measure, VOLUME.slope, pressure_stress_of(VOLUME)
    words = wp.types.vector(length=each, dtype=wp.uint64)
    numbers = wp.types.matrix(shape=(each, CONSTANTS), dtype=wp.float32)
    places = wp.types.vector(length=halo_each, dtype=wp.int32)
    group_places = wp.types.vector(length=each, dtype=wp.int32)

    @wp.func
    def displacement_gradient(corners: wp.uint64, c: row):
        x0 = displacement(wp.static(LOAD), number_in(corners, 0), wp.vec3())
        x1 = displacement(wp.static(LOAD), number_in(corners, 1), wp.vec3())
        x2 = displacement(wp.static(LOAD), number_in(corners, 2), wp.vec3())
        x3 = displacement(wp.static(LOAD), number_in(corners, 3), wp.vec3())
        return wp.matrix_from_cols(x1 - x0, x2 - x0, x3 - x0) * rest_inverse(c)

    @wp.func
    def law_lam(c: row):
        """Lambda times the volume in the element's own law: zero if elements share their dilatation."""
        return wp.static(0.0 if shares else 1.0) * c[10]

    @wp.func
    def corner_forces(c: row, p: wp.mat33):
        """The forces on the last three corners."""
        h = p * wp.transpose(rest_inverse(c))
        return -column(h, 0), -column(h, 1), -column(h, 2)

    @wp.func
    def add_to_slot(i: int, force: wp.vec3):
        slot(wp.static(STORE), i, slot(wp.static(LOAD), i, force) + force)

    @wp.func
    def add_forces(targets: wp.uint64, c: row, p: wp.mat33):
        f1, f2, f3 = corner_forces(c, p)
        add_to_slot(number_in(targets, 0), -(f1 + f2 + f3))
        add_to_slot(number_in(targets, 1), f1)
        add_to_slot(number_in(targets, 2), f2)
        add_to_slot(number_in(targets, 3), f3)

    @wp.func
    def sum_of_group(group: int):
        sum = float(0.0)
        for member in range(wp.static(members)):
            sum += measured(wp.static(LOAD), wp.static(member * groups) + group, sum)
        return sum

    @wp.func
    def store_forces(targets: wp.uint64, c: row, p: wp.mat33):
        f1, f2, f3 = corner_forces(c, p)
        slot(wp.static(STORE), number_in(targets, 0), -(f1 + f2 + f3))
        slot(wp.static(STORE), number_in(targets, 1), f1)
        slot(wp.static(STORE), number_in(targets, 2), f2)
        slot(wp.static(STORE), number_in(targets, 3), f3)

    @law_kernel(grid_stride=False, launch_bounds=(threads, 1))
    def step_patches(
        # In
        body: PatchBody,
        steps: int,
        dynamics: Dynamics,
        mu: wp.array[wp.float32],
        lam: wp.array[wp.float32],
        stride: int,
        mass: wp.array[wp.float32],
        pace: Pace,
        world_starts: wp.array[wp.float64],
        # In and out
        exchange: Exchange,
        # Out
        reactions: wp.array[wp.vec4],
        support_work: wp.array[wp.float64],
        bad_step: wp.array[wp.int64],
    ):
        _generated_from = wp.static(fingerprint(layout))
        block = wp.tid() // wp.static(threads)
        thread = wp.tid() % wp.static(threads)
        patches = body.own_start.shape[0] - 1
        world = block // patches
        patch = block % patches
        first_node = world * body.own.shape[0]
        dt = float(pace.seconds[DT])
        before = float(length_before(pace))
        damped = 1.0 / (1.0 + dt * dynamics.damping)
        number = exchange.begun[block]

        # The node whose forces the thread sums together with its neighbours; the first of them moves the node.
        first_own = body.own_start[patch]
        own_count = body.own_start[patch + 1] - first_own
        place = thread // wp.static(lanes)
        moves = place < own_count and thread % wp.static(lanes) == 0
        i = first_node + body.own[first_own + wp.min(place, own_count - 1)]
        x = load_node(dynamics.u, i)
        velocity = load_node(dynamics.v, i)
        w = dynamics.inverse_mass[i]
        load_here = load_at(i, dynamics)
        trajectory = body.trajectory[i]
        key = int(0)
        last_key = int(0)
        if trajectory >= 0:
            key = body.key_start[trajectory]
            last_key = body.key_start[trajectory + 1] - 2
        warp = thread // wp.static(WARP)
        bases = body.base_start[patch]
        warps = body.base_start[patch + 1] - bases - 1
        first_slot = body.bases[bases + wp.min(warp, warps)] + thread % wp.static(WARP)
        rows = (body.bases[bases + wp.min(warp + 1, warps)] - first_slot + thread % wp.static(WARP)) // wp.static(WARP)

        halo_count = body.halo_start[patch + 1] - body.halo_start[patch]
        halo = places()
        for k in range(wp.static(halo_each)):
            at = thread + k * wp.static(threads)
            if at < halo_count:
                halo[k] = first_node + body.halo[body.halo_start[patch] + at]

        first_element = body.element_start[patch]
        element_count = body.element_start[patch + 1] - first_element
        computed_count = body.computed[patch]
        interior_count = int(0)
        if wp.static(layout.overlaps):
            interior_count = body.interior[patch]
        corners = words()
        targets = words()
        constants = numbers()
        group_place = group_places()
        first_material = world * body.element_count
        for k in range(wp.static(each)):
            at = thread + k * wp.static(threads)
            if at < computed_count:
                e = first_element + at
                corners[k] = body.corners[e]
                targets[k] = body.slots[e]
                for j in range(9):
                    constants[k, j] = body.rest[j, e]
                volume = body.rest[wp.static(VOLUME_ROW), e]
                t = (first_material + body.elements[e]) * stride
                constants[k, 9] = volume * mu[t]
                constants[k, 10] = volume * lam[t]
                if wp.static(shares):
                    group_place[k] = body.measures[e]

        # Reserve the memory of ``slot`` and ``displacement``. Places without a corner are read, too, and stay zero.
        _memory = wp.tile_zeros(shape=wp.static(layout.floats), dtype=wp.float32, storage="shared")
        synchronize_block()
        if moves:
            displacement(wp.static(STORE), place, x)
            publish(exchange.published, int(number & wp.uint32(1)) * exchange.nodes + i, x, number)
        if wp.static(shares):
            at = thread
            while at < element_count:
                e = first_element + at
                t = (first_material + body.elements[e]) * stride
                weight = body.rest[wp.static(VOLUME_ROW), e] * lam[t]
                measured(wp.static(STORE), body.measures[e], weight)
                weight_of(wp.static(STORE), body.measures[e], weight)
                at += wp.static(threads)
            synchronize_block()
            if thread < wp.static(groups):
                weight = sum_of_group(thread)
                inverse = float(0.0)
                if weight != 0.0:
                    inverse = 1.0 / weight
                inverse_weight(wp.static(STORE), thread, inverse)

        gave_up = int(0)
        step = int(0)
        while step < steps:
            buffer = int(number & wp.uint32(1)) * exchange.nodes
            # First the elements between own nodes, while the halo arrives, then the others.
            begin = int(0)
            end = int(interior_count)
            phase = int(wp.static(0 if layout.overlaps else 1))
            left_out = int(0)
            while phase < 2:
                if phase == 0:
                    synchronize_block()
                else:
                    begin = interior_count
                    end = computed_count
                    for k in range(wp.static(halo_each)):
                        at = thread + k * wp.static(threads)
                        if at < halo_count:
                            told = await_displacement(exchange.published, buffer + halo[k], number)
                            displacement(wp.static(STORE), own_count + at, wp.vec3(told[0], told[1], told[2]))
                            if told[3] != 0.0:
                                gave_up = 1
                    gave_up = synchronize_any(gave_up)
                for k in range(wp.static(each)):
                    at = thread + k * wp.static(threads)
                    if at >= begin and at < end:
                        c = constants[k]
                        gradient = displacement_gradient(corners[k], c)
                        if wp.static(shares):
                            theta, _slope = measure(gradient)
                            measured(wp.static(STORE), group_place[k], c[10] * theta)
                        p, trusted = stretch_stress(gradient, c[9], law_lam(c))
                        if trusted:
                            store_forces(targets[k], c, p)
                        else:
                            left_out |= wp.static(1 << k)
                phase += 1
            if gave_up != 0:
                break
            # Compute the elements that were left out once a step and in one place, so that the threads of a warp do it
            # together.
            while left_out != 0:
                chosen = lowest_bit(left_out)
                left_out = left_out & (left_out - 1)
                its_corners = corners[0]
                its_targets = targets[0]
                c = constants[0]
                for k in range(1, wp.static(each)):
                    if chosen == k:
                        its_corners = corners[k]
                        its_targets = targets[k]
                        c = constants[k]
                f = identity3() + displacement_gradient(its_corners, c)
                store_forces(its_targets, c, turned_stress(f, c[9], law_lam(c)))
            if wp.static(shares):
                # The elements that are only measured; their data come from the cache.
                at = computed_count + thread
                while at < element_count:
                    e = first_element + at
                    c = row()
                    for j in range(9):
                        c[j] = body.rest[j, e]
                    theta, _slope = measure(displacement_gradient(body.corners[e], c))
                    weight = weight_of(wp.static(LOAD), body.measures[e], 0.0)
                    measured(wp.static(STORE), body.measures[e], weight * theta)
                    at += wp.static(threads)
            synchronize_block()
            if wp.static(shares):
                if thread < wp.static(groups):
                    mean = sum_of_group(thread) * inverse_weight(wp.static(LOAD), thread, 0.0)
                    pressure_of(wp.static(STORE), thread, slope_of(mean))
                synchronize_block()
                for k in range(wp.static(each)):
                    if thread + k * wp.static(threads) < computed_count:
                        c = constants[k]
                        pressure = pressure_of(wp.static(LOAD), group_place[k] % wp.static(groups), 0.0)
                        p = pressure_stress(displacement_gradient(corners[k], c), pressure, c[10])
                        add_forces(targets[k], c, p)
                synchronize_block()

            elastic = wp.vec3()
            r = int(0)
            while r < rows:
                elastic += slot(wp.static(LOAD), first_slot + r * wp.static(WARP), elastic)
                r += 1
            distance = int(wp.static(lanes // 2))
            while distance > 0:
                elastic += shuffle_down(elastic, distance)
                distance = distance // 2
            number = number + wp.uint32(1)
            if moves:
                if trajectory >= 0:
                    t_end = time_after(pace, step + 1) - world_starts[world]
                    key, share = key_from(body.times, key, last_key, t_end)
                    columns = body.columns[trajectory]
                    at = body.value_start[trajectory] + (key - body.key_start[trajectory]) * columns
                    at += wp.min(body.place[i], columns - 1)
                    value = body.values[at]
                    target = value + share * (body.values[at + columns] - value)
                    towards = (target - x) / dt
                    # As in ``follow_trajectory``, each force does work along half of the motion before it and half of
                    # the motion after it.
                    add_support_work(elastic, 0.5 * before * (velocity - towards), support_work)
                    velocity = towards
                force = elastic + load_here
                if w > 0.0:
                    velocity = symplectic_euler_velocity(
                        velocity, force, w, dynamics.gravity, 0.5 * (before + dt), damped
                    )
                else:
                    add_support_work(elastic, 0.5 * (before + dt) * velocity, support_work)
                    if step == steps - 1:
                        store_node(reactions, i, -(force + mass[i] * dynamics.gravity))
                x = x + dt * velocity
                displacement(wp.static(STORE), place, x)
                publish(exchange.published, int(number & wp.uint32(1)) * exchange.nodes + i, x, number)
                if not is_finite(x):
                    wp.atomic_min(bad_step, 0, pace.counts[DONE] + wp.int64(step + 1))
            before = dt
            step += 1

        if gave_up != 0:
            # A block that gave up must not leave something that looks like a valid state.
            x = wp.vec3(wp.nan, wp.nan, wp.nan)
            wp.atomic_min(bad_step, 0, pace.counts[DONE] + wp.int64(step + 1))
        if moves:
            store_node(dynamics.u, i, x)
            store_node(dynamics.v, i, velocity)
        if thread == 0:
            exchange.begun[block] = exchange.begun[block] + wp.uint32(steps + 1)

    return step_patches
