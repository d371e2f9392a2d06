"""A small body's steps whole in one thread block: nodes and forces in shared memory, many steps a launch.

A body of a thousand elements is done before the next launch has begun, so here a block stays with its world. Each
thread takes a complete subtree, or a part of its leaves where there are too few worlds to fill the card, and writes its
nodal forces to slots; then each thread sums up the slots of a node and moves it. Nothing is added atomically, so runs
are reproducible bit by bit, and nothing leaves the multiprocessor but the state at the end.

CUDA only. ``block_layout`` says which thread does what.
"""

import functools

import warp as wp

from .algebraic import algebraic_rotation, turned_stress
from .block_layout import FIRST_SHIFT, FOLLOWING_SHIFT, NEIGHBOURS, NO_NODE, NODE_WORDS, NUMBERS, WARP, Layout
from .constitutive import hooke, symmetric
from .elements import FRAME_SHIFT, LEVEL_MASK, Subtrees, load_node, mirror_sign, store_node
from .integrate import add_support_work, is_finite, symplectic_euler_velocity, vector_at
from .matrices import column, identity3
from .pace import DONE, DT, Pace
from .shapes import VOLUME, fingerprint
from .subtree import FRAMES, HANDEDNESS, LEAVES, POSITIONS
from .subtree_forces import columns_of, leaf_forces_of, mat10, near_forces, shared_forces

wp.set_module_options({"enable_backward": False})

#: Threads of a multiprocessor that the registers of a whole subtree's forces leave room for.
BUSY_THREADS = 512

LOAD, STORE, LOAD_BYTES = 0, 1, 2

vec3u = wp.types.vector(length=NODE_WORDS, dtype=wp.uint64)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncthreads();
#endif
""")
def synchronize_block(): ...


@wp.func
def number_in(word: wp.uint64, k: int):
    """The k-th of the four 16-bit numbers in a word."""
    return int((word >> wp.uint64(16 * k)) & wp.uint64(0xFFFF))


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __ffs(bits) - 1;
#else
    return __builtin_ctz(bits);
#endif
""")
def lowest_bit(bits: int) -> int: ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return wp::vec_t<3, wp::float32>(
        __shfl_down_sync(0xffffffff, value[0], distance),
        __shfl_down_sync(0xffffffff, value[1], distance),
        __shfl_down_sync(0xffffffff, value[2], distance));
#else
    return value;
#endif
""")
def shuffle_down(value: wp.vec3, distance: int) -> wp.vec3: ...


def shared_vectors(count: int, tag: str) -> wp.Function:
    """An array of vectors in shared memory, as one function that reads or writes it; ``LOAD_BYTES`` counts in bytes."""

    snippet = f"""
#if defined(__CUDA_ARCH__)
    // {tag}
    __shared__ float memory[{3 * count}];
    if (access == {STORE}) {{
        memory[3 * i] = value[0]; memory[3 * i + 1] = value[1]; memory[3 * i + 2] = value[2];
        return value;
    }}
    const float* at = access == {LOAD_BYTES} ? (const float*)((const char*)memory + i) : memory + 3 * i;
    return wp::vec_t<3, wp::float32>(at[0], at[1], at[2]);
#else
    return value;
#endif
"""

    @wp.func_native(snippet)
    def memory(access: int, i: int, value: wp.vec3) -> wp.vec3: ...

    return memory


@wp.struct
class BlockBody:
    """A body as its block goes through it: one world's subtrees, and who adds up which slots."""

    subtrees: Subtrees  # of one world, one by one
    subtree_count: int
    node_count: int
    element_count: int
    tasks: wp.array[wp.int32]  # [tasks] see ``FOLLOWING_SHIFT``
    nodes: wp.array2d[wp.uint64]  # [3, subtree_count] the ten nodes of each subtree, four to a word, in bytes
    slots: wp.array2d[wp.uint64]  # [2, tasks] four slots each, the zero one past the last, in bytes


def _table(rows: list[list[int]]) -> wp.Function:
    """Whole numbers by row and column. A matrix that is indexed so would be copied for every use."""
    numbers = ", ".join(str(number) for row in rows for number in row)
    snippet = f"""
    static const signed char numbers[{len(rows) * len(rows[0])}] = {{{numbers}}};
    return numbers[{len(rows[0])} * row + column];
"""

    @wp.func_native(snippet)
    def look_up(row: int, column: int) -> int: ...

    return look_up


def _vectors(rows: list) -> wp.Function:
    """Constant vectors by number."""
    numbers = ", ".join(f"{float(c)!r}f" for row in rows for c in row)
    snippet = f"""
    static const float numbers[{3 * len(rows)}] = {{{numbers}}};
    return wp::vec_t<3, wp::float32>(numbers[3 * i], numbers[3 * i + 1], numbers[3 * i + 2]);
"""

    @wp.func_native(snippet)
    def look_up(i: int) -> wp.vec3: ...

    return look_up


def _repair_of(layout: Layout, displacement: wp.Function, slot: wp.Function) -> wp.Function:
    """What does the leaves of a part that the fast iteration left out.

    It takes numbers, not the body: a struct that a function which is not inlined takes is copied for every call.
    """
    shape, leaves_each = layout.shape, 8 // layout.parts
    node_of, place_of = _table([list(leaf) for leaf in LEAVES[shape]]), _table(layout.places)
    handed = _table([[int(h)] for h in HANDEDNESS[shape]])
    rest_of = _vectors([[2.0 * c for c in point] for point in POSITIONS[shape]])
    frame_of = _vectors([column for leaf in FRAMES[shape] for column in leaf])
    columns, leaf_forces = columns_of(shape), leaf_forces_of(shape)

    @wp.func
    def position(words: vec3u, k: int, q: wp.mat33, inv_h: float):
        """Of node k, relative to the first's displacement, in edge lengths of a leaf."""
        moved = displacement(wp.static(LOAD_BYTES), number_in(words[k // NUMBERS], k % NUMBERS), wp.vec3())
        origin = displacement(wp.static(LOAD_BYTES), number_in(words[0], 0), wp.vec3())
        return (moved - origin) * inv_h + q * rest_of(k)

    @wp.func(inline=False)
    def repair(
        words: vec3u,
        s: int,
        part: int,
        left_out: int,
        maubach: wp.mat33,
        h: float,
        mirror: float,
        mu: wp.array[wp.float32],
        lam: wp.array[wp.float32],
        material: int,
        stride: int,
    ):
        """Add the forces of the leaves that were left out, one by one with the robust rotation, to the part's slots.

        ``maubach`` is the subtree's frame, left-handed if ``mirror`` is -1; ``material`` is the first leaf's place.
        """
        inv_h = 1.0 / h
        area = wp.static(VOLUME[shape]) * h * h
        turned = wp.mat33()
        if wp.static(layout.shared):
            c0, c1, c2 = columns(
                position(words, 0, maubach, inv_h),
                position(words, 1, maubach, inv_h),
                position(words, 2, maubach, inv_h),
                position(words, 3, maubach, inv_h),
            )
            r = algebraic_rotation(wp.matrix_from_cols(c0, c1, c2 * mirror))
            turned = wp.matrix_from_cols(column(r, 0), column(r, 1), column(r, 2) * mirror)
        left = left_out & (wp.static((1 << leaves_each) - 1) << (part * wp.static(leaves_each)))
        while left != 0:
            leaf = lowest_bit(left)
            left = left & (left - 1)
            c0, c1, c2 = columns(
                position(words, node_of(leaf, 0), maubach, inv_h),
                position(words, node_of(leaf, 1), maubach, inv_h),
                position(words, node_of(leaf, 2), maubach, inv_h),
                position(words, node_of(leaf, 3), maubach, inv_h),
            )
            i = material + leaf * stride
            m = area * mu[i]
            k = area * lam[i]
            p = wp.mat33()
            if wp.static(layout.shared):
                # R times the leaf's Maubach frame.
                z = turned * wp.matrix_from_cols(frame_of(3 * leaf), frame_of(3 * leaf + 1), frame_of(3 * leaf + 2))
                p = z * hooke(symmetric(wp.transpose(z) * wp.matrix_from_cols(c0, c1, c2)) - identity3(), m, k)
            else:
                hand = mirror * float(handed(leaf, 0))
                p = turned_stress(wp.matrix_from_cols(c0, c1, c2 * hand), m, k)
                p = wp.matrix_from_cols(column(p, 0), column(p, 1), hand * column(p, 2))
            f0, f1, f2, f3 = leaf_forces(column(p, 0), column(p, 1), column(p, 2))
            for n in range(4):
                force = f0
                if n == 1:
                    force = f1
                if n == 2:
                    force = f2
                if n == 3:
                    force = f3
                at = s + place_of(part, node_of(leaf, n)) * wp.static(layout.subtrees)
                slot(wp.static(STORE), at, slot(wp.static(LOAD), at, force) + force)

    return repair


@functools.cache
def step_block(layout: Layout, load_vectors: type) -> wp.Kernel:
    """Symplectic Euler steps of the corotated model, a block a world; launch with ``layout.threads`` a block.

    Args:
        load_vectors: What loads are an array of, vec3 or vec4.
    """
    shape, shared, uniform, parts = layout.shape, layout.shared, layout.uniform, layout.parts
    capacity, threads, zero_slot = layout.subtrees, layout.threads, layout.slot_count
    own = [near_forces(shape, uniform, layout.tolerance, layout.leaves(part)) for part in range(parts)]
    turned = [shared_forces(shape, uniform, False, layout.leaves(part)) for part in range(parts)]
    needs, places = [layout.needs(part) for part in range(parts)], layout.places
    displacement, velocity = shared_vectors(layout.nodes, "displacements"), shared_vectors(layout.nodes, "velocities")
    slot = shared_vectors(zero_slot + 1, "forces")
    repair = _repair_of(layout, displacement, slot)

    @wp.kernel(
        module="unique",
        enable_backward=False,
        grid_stride=False,
        launch_bounds=(threads, max(BUSY_THREADS // threads, 1)),
    )
    def step_block(
        # In
        body: BlockBody,
        steps: int,
        damping: float,
        gravity: wp.vec3,
        mu: wp.array[wp.float32],
        lam: wp.array[wp.float32],
        stride: int,
        mass: wp.array[wp.float32],
        inverse_mass: wp.array[wp.float32],
        has_load: int,
        load: wp.array[load_vectors],
        pace: Pace,
        # In and out
        u: wp.array[wp.vec4],
        v: wp.array[wp.vec4],
        # Out
        reactions: wp.array[wp.vec4],
        support_work: wp.array[wp.float64],
        bad_step: wp.array[wp.int64],
    ):
        _generated_from = wp.static(fingerprint(needs, places))
        dt = float(pace.seconds[DT])
        world = wp.tid() // wp.static(threads)
        thread = wp.tid() % wp.static(threads)
        base = world * body.node_count
        place = thread
        while place < body.node_count:
            displacement(wp.static(STORE), place, load_node(u, base + place))
            velocity(wp.static(STORE), place, load_node(v, base + place))
            place += wp.static(threads)
        if thread == 0:
            slot(wp.static(STORE), wp.static(zero_slot), wp.vec3())
        synchronize_block()
        warp = thread // wp.static(WARP)
        part = warp % wp.static(parts)
        s = (warp // wp.static(parts)) * wp.static(WARP) + thread % wp.static(WARP)
        mine = wp.min(s, body.subtree_count - 1)
        code = body.subtrees.code[mine]
        h = 0.5 * body.subtrees.size[(code & LEVEL_MASK) // 3]
        mirror = mirror_sign(code)
        q = body.subtrees.frames[code >> FRAME_SHIFT]
        material = (world * body.element_count + body.subtrees.first[mine]) * stride
        damped = 1.0 / (1.0 + dt * damping)
        # In registers from here on, two nodes each.
        words = vec3u()
        for word in range(wp.static(NODE_WORDS)):
            words[word] = body.nodes[word, mine]
        task = wp.min(thread, wp.static(layout.tasks - 1))
        about = body.tasks[task]
        numbers0 = body.slots[0, task]
        numbers1 = body.slots[1, task]
        step = int(0)
        while step < steps:
            if s < body.subtree_count:
                left_out = int(0)
                for p in range(wp.static(parts)):
                    if part == p:
                        x = mat10()
                        for k in range(10):
                            if wp.static(needs[p][k]):
                                x[k] = displacement(
                                    wp.static(LOAD_BYTES),
                                    number_in(words[k // wp.static(NUMBERS)], k % wp.static(NUMBERS)),
                                    wp.vec3(),
                                )
                        g = mat10()
                        if wp.static(shared):
                            g, left_out = wp.static(turned[p])(x, q, h, mirror, wp.mat33(), mu, lam, material)
                        else:
                            g, left_out = wp.static(own[p])(x, q, h, mirror, mu, lam, material)
                        for k in range(10):
                            if wp.static(places[p][k] >= 0):
                                slot(wp.static(STORE), s + wp.static(places[p][k] * capacity), g[k])
                if left_out != 0:
                    maubach = wp.matrix_from_cols(column(q, 0), column(q, 1), column(q, 2) * mirror)
                    repair(words, s, part, left_out, maubach, h, mirror, mu, lam, material, stride)
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
                    if has_load != 0:
                        force += vector_at(load, i)
                    w = inverse_mass[i]
                    moving = velocity(wp.static(LOAD), place, force)
                    if w > 0.0:
                        moving = symplectic_euler_velocity(moving, force, w, gravity, dt, damped)
                        velocity(wp.static(STORE), place, moving)
                    else:
                        add_support_work(elastic, dt * moving, support_work)
                        if step == steps - 1:
                            store_node(reactions, i, -(force + mass[i] * gravity))
                    moved = displacement(wp.static(LOAD), place, force) + dt * moving
                    displacement(wp.static(STORE), place, moved)
                    if not is_finite(moved):
                        wp.atomic_min(bad_step, 0, pace.counts[DONE] + wp.int64(step + 1))
                task += wp.static(threads)
            synchronize_block()
            step += 1
        place = thread
        while place < body.node_count:
            store_node(u, base + place, displacement(wp.static(LOAD), place, wp.vec3()))
            store_node(v, base + place, velocity(wp.static(LOAD), place, wp.vec3()))
            place += wp.static(threads)

    return step_block
