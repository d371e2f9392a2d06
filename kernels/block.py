"""A small body's steps whole in one thread block: nodes and forces in shared memory, many steps a launch.

A body of a thousand elements is done before the next launch has begun, so here a block stays with its world. Each
thread is one complete subtree and writes ten nodal forces to slots; then each sums up the slots of some nodes and moves
them. Nothing is added atomically, so runs are reproducible bit by bit, and nothing leaves the multiprocessor but
the state at the end.

CUDA only. ``SHARED_BYTES`` is what a block may have without asking.
"""

import functools

import warp as wp

from .constitutive import corotated_strain, hooke
from .elements import (
    FRAME_SHIFT,
    LEVEL_MASK,
    ForestElements,
    Subtrees,
    frame,
    gradient_of,
    load_node,
    mirror_sign,
    nodal_forces,
    store_node,
)
from .integrate import is_finite, symplectic_euler_velocity
from .rotation import byers_xu
from .subtree import LEAVES
from .subtree_forces import deformed_of, mat10, own_forces, shared_forces

wp.set_module_options({"enable_backward": False})

SHARED_BYTES = 48 * 1024
#: Displacement and velocity of a node, ten forces of a subtree [B].
NODE_BYTES, SUBTREE_BYTES = 24, 120
#: Nodes and subtrees are rounded up to whole warps.
WARP = 32
MAX_THREADS = 512

LOAD, STORE = 0, 1

mat84i = wp.types.matrix(shape=(8, 4), dtype=wp.int32)


def rounded(count: int) -> int:
    """Up to a multiple of a warp's threads."""
    return -(-count // WARP) * WARP


def fits(nodes: int, subtrees: int) -> bool:
    """Whether a block can hold a body."""
    size = NODE_BYTES * rounded(nodes) + SUBTREE_BYTES * rounded(subtrees)
    return size <= SHARED_BYTES and subtrees <= MAX_THREADS


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncthreads();
#endif
""")
def synchronize_block(): ...


def _memory(count: int, tag: str) -> wp.Function:
    """An array of vectors in shared memory, as one function that reads or writes it."""

    snippet = f"""
#if defined(__CUDA_ARCH__)
    // {tag}
    __shared__ float memory[{3 * count}];
    if (access == {STORE}) {{
        memory[3 * i] = value[0]; memory[3 * i + 1] = value[1]; memory[3 * i + 2] = value[2];
        return value;
    }}
    return wp::vec_t<3, wp::float32>(memory[3 * i], memory[3 * i + 1], memory[3 * i + 2]);
#else
    return value;
#endif
"""

    @wp.func_native(snippet)
    def memory(access: int, i: int, value: wp.vec3) -> wp.vec3: ...

    return memory


@wp.struct
class BlockBody:
    """A body as its block goes through it: one world's subtrees, and nodes by how many subtrees meet there."""

    subtrees: Subtrees  # of one world, one by one; nodes are places in ``order``
    elements: ForestElements  # the leaves
    roots: ForestElements  # the subtrees' roots, where these give the rotation
    subtree_count: int
    node_count: int
    element_count: int
    order: wp.array[wp.int32]  # [N] node at each place, those where most subtrees meet first
    degree: wp.array[wp.int32]  # [N] subtrees at each place
    slots: wp.array2d[wp.int32]  # [most, N] their slots, subtree + local node * capacity


@functools.cache
def step_block(shape: int, shared: bool, uniform: bool, nodes: int, subtrees: int) -> wp.Kernel:
    """Symplectic Euler steps of the corotated model, a block a world; launch with ``subtrees`` threads a block.

    Args:
        shape: Type of the subtrees.
        shared: Whether leaves use their subtree root's rotation; otherwise their own.
        uniform: Whether all of a world is of one material.
        nodes, subtrees: Room for nodes, and for subtrees, which is the number of threads; multiples of ``WARP``.
    """
    deformed = deformed_of(shape)
    fast_own, fast_shared = own_forces(shape, uniform), shared_forces(shape, uniform, False)
    displacement, velocity = _memory(nodes, "displacements"), _memory(nodes, "velocities")
    slot = _memory(10 * subtrees, "forces")
    leaf_nodes = mat84i(*(node for leaf in LEAVES[shape] for node in leaf))

    @wp.func
    def node_at(body: BlockBody, s: int, local: int):
        return displacement(wp.static(LOAD), body.subtrees.nodes[local, s], wp.vec3())

    @wp.func(inline=False)
    def repair(
        body: BlockBody, s: int, material: int, mu: wp.array[wp.float32], lam: wp.array[wp.float32], stride: int
    ):
        """Forces of a subtree that the fast iteration does not turn, leaf by leaf with the robust rotation."""
        for_all = wp.mat33()
        if wp.static(shared):
            g = gradient_of(
                body.roots, s, node_at(body, s, 0), node_at(body, s, 1), node_at(body, s, 2), node_at(body, s, 3)
            )
            q = frame(body.roots, s)
            for_all = byers_xu(q + g) * wp.transpose(q)
        places = wp.static(leaf_nodes)
        leaf = int(0)
        while leaf < 8:
            t = body.subtrees.first[s] + leaf
            g = gradient_of(
                body.elements,
                t,
                node_at(body, s, places[leaf, 0]),
                node_at(body, s, places[leaf, 1]),
                node_at(body, s, places[leaf, 2]),
                node_at(body, s, places[leaf, 3]),
            )
            q = frame(body.elements, t)
            r = for_all * q
            if wp.static(not shared):
                r = byers_xu(q + g)
            i = material + leaf * stride
            f0, f1, f2, f3 = nodal_forces(body.elements, t, r * hooke(corotated_strain(g, q, r), mu[i], lam[i]))
            for n in range(4):
                force = f0
                if n == 1:
                    force = f1
                if n == 2:
                    force = f2
                if n == 3:
                    force = f3
                at = s + places[leaf, n] * wp.static(subtrees)
                slot(wp.static(STORE), at, slot(wp.static(LOAD), at, force) + force)
            leaf += 1

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def step_block(
        # In
        body: BlockBody,
        steps: int,
        dt: float,
        damping: float,
        gravity: wp.vec3,
        mu: wp.array[wp.float32],
        lam: wp.array[wp.float32],
        stride: int,
        mass: wp.array[wp.float32],
        inverse_mass: wp.array[wp.float32],
        has_load: int,
        load: wp.array[wp.vec4],
        clock: wp.array[wp.int64],
        # In and out
        u: wp.array[wp.vec4],
        v: wp.array[wp.vec4],
        # Out
        reactions: wp.array[wp.vec4],
        bad_step: wp.array[wp.int64],
    ):
        world = wp.tid() // wp.static(subtrees)
        s = wp.tid() % wp.static(subtrees)
        base = world * body.node_count
        place = s
        while place < body.node_count:
            i = base + body.order[place]
            displacement(wp.static(STORE), place, load_node(u, i))
            velocity(wp.static(STORE), place, load_node(v, i))
            place += wp.static(subtrees)
        synchronize_block()
        mine = wp.min(s, body.subtree_count - 1)
        code = body.subtrees.code[mine]
        h = 0.5 * body.subtrees.size[(code & LEVEL_MASK) // 3]
        mirror = mirror_sign(code)
        q = body.subtrees.frames[code >> FRAME_SHIFT]
        material = (world * body.element_count + body.subtrees.first[mine]) * stride
        step = int(0)
        while step < steps:
            if s < body.subtree_count:
                x = mat10()
                for k in range(10):
                    x[k] = node_at(body, s, k)
                y = deformed(x, q, 1.0 / h, mirror)
                g = mat10()
                trusted = bool(True)
                if wp.static(shared):
                    g, trusted = fast_shared(y, h, mirror, wp.mat33(), mu, lam, material)
                else:
                    g, trusted = fast_own(y, h, mirror, mu, lam, material)
                for k in range(10):
                    slot(wp.static(STORE), s + k * wp.static(subtrees), g[k])
                if not trusted:
                    repair(body, s, material, mu, lam, stride)
            synchronize_block()
            place = s
            while place < body.node_count:
                i = base + body.order[place]
                force = wp.vec3()
                for m in range(body.degree[place]):
                    force += slot(wp.static(LOAD), body.slots[m, place], force)
                if has_load != 0:
                    force += load_node(load, i)
                w = inverse_mass[i]
                moving = velocity(wp.static(LOAD), place, force)
                if w > 0.0:
                    moving = symplectic_euler_velocity(moving, force, w, gravity, dt, damping)
                    velocity(wp.static(STORE), place, moving)
                elif step == steps - 1:
                    store_node(reactions, i, -(force + mass[i] * gravity))
                moved = displacement(wp.static(LOAD), place, force) + dt * moving
                displacement(wp.static(STORE), place, moved)
                if not is_finite(moved):
                    wp.atomic_min(bad_step, 0, clock[0] + wp.int64(step + 1))
                place += wp.static(subtrees)
            synchronize_block()
            step += 1
        place = s
        while place < body.node_count:
            i = base + body.order[place]
            store_node(u, i, displacement(wp.static(LOAD), place, wp.vec3()))
            store_node(v, i, velocity(wp.static(LOAD), place, wp.vec3()))
            place += wp.static(subtrees)

    return step_block
