"""Forces of complete subtrees on the CPU: eight subtrees side by side in the lanes of vector registers.

What a CPU core lacks is vectorisation. So the ten nodes of eight subtrees of one type are gathered into arrays of
lanes, one loop goes over the eight leaves, and forces are scattered once at the end. The laws are those of
``elements.law_lanes``; leaves, or subtrees, that the corotated law leaves out are flagged by a bit each.

Native code: see ``elements.lanes`` for why, and ``lanes`` for what is generated of it.
"""

import functools

import warp as wp

from warp_corot.kernels.elements.elements import Subtrees
from warp_corot.kernels.elements.lanes import COMPILER_FLAGS, native, on_cpu
from warp_corot.kernels.elements.law_lanes import LAWS, ROTATION

from .lanes import begin, near_test, product

wp.set_module_options({"enable_backward": False})


def _own(shape: int, law: str) -> str:
    """Every leaf by itself."""
    flags = ["left_out_leaves"] if law == "corotated" else []
    return on_cpu(LAWS[law], begin(shape), "const masks8 done = {};\n", native("leaves", "subtree_forces", *flags))


def _shared(shape: int, given: bool) -> str:
    """All leaves with one rotation, the root's or a given one."""
    rotation = "given_rotation" if given else "root_rotation"
    forces = native("shared_rotation", rotation, "shared_leaves", "subtree_forces", "left_out_leaves")
    return on_cpu(ROTATION, begin(shape), product(shape), forces)


def _near(shape: int) -> str:
    """All leaves with the root's rotation where that is near theirs, otherwise every leaf by itself."""
    return on_cpu(
        LAWS["corotated"],
        native("rotation"),
        begin(shape),
        product(shape),
        near_test(shape),
        native("shared_rotation", "near_leaves"),
        f"if (any(~done)) {{\n{native('leaves')}}}\n",
        native("subtree_forces", "left_out_leaves"),
    )


@functools.cache
def scatter_subtrees_own(shape: int) -> wp.Kernel:
    """Corotated forces of subtrees, every leaf with its own rotation; a thread is eight subtrees."""

    @wp.func_native(_own(shape, "corotated"))
    def eight_subtrees(
        subtrees: Subtrees,
        block: int,
        count: int,
        mu: wp.array[wp.float32],
        lam: wp.array[wp.float32],
        stride: int,
        u: wp.array[wp.vec4],
        f: wp.array[wp.vec4],
        flagged: wp.array[wp.uint8],
    ): ...

    @wp.kernel(module="unique", enable_backward=False, module_options={"cpu_compiler_flags": COMPILER_FLAGS})
    def scatter_subtrees_own(
        # In
        subtrees: Subtrees,
        count: int,
        mu: wp.array[wp.float32],
        lam: wp.array[wp.float32],
        stride: int,
        u: wp.array[wp.vec4],
        # Out
        f: wp.array[wp.vec4],
        flagged: wp.array[wp.uint8],
    ):
        eight_subtrees(subtrees, wp.tid(), count, mu, lam, stride, u, f, flagged)

    return scatter_subtrees_own


@functools.cache
def scatter_law_subtrees(shape: int, law: str) -> wp.Kernel:
    """Forces of subtrees under a law of ``elements.law_lanes`` that needs no rotation; a thread is eight subtrees."""

    @wp.func_native(_own(shape, law))
    def eight_subtrees(
        subtrees: Subtrees,
        block: int,
        count: int,
        mu: wp.array[wp.float32],
        lam: wp.array[wp.float32],
        stride: int,
        u: wp.array[wp.vec4],
        f: wp.array[wp.vec4],
    ): ...

    @wp.kernel(module="unique", enable_backward=False, module_options={"cpu_compiler_flags": COMPILER_FLAGS})
    def scatter_law_subtrees(
        # In
        subtrees: Subtrees,
        mu: wp.array[wp.float32],
        lam: wp.array[wp.float32],
        stride: int,
        count: int,
        u: wp.array[wp.vec4],
        # Out
        f: wp.array[wp.vec4],
    ):
        eight_subtrees(subtrees, wp.tid(), count, mu, lam, stride, u, f)

    return scatter_law_subtrees


@functools.cache
def scatter_subtrees_shared(shape: int, given: bool) -> wp.Kernel:
    """Corotated forces of subtrees with their root's rotation or a given one; a thread is eight subtrees."""

    @wp.func_native(_shared(shape, given))
    def eight_subtrees(
        subtrees: Subtrees,
        block: int,
        count: int,
        mu: wp.array[wp.float32],
        lam: wp.array[wp.float32],
        stride: int,
        u: wp.array[wp.vec4],
        rotations: wp.array[wp.mat33],
        unit: wp.array[wp.int32],
        f: wp.array[wp.vec4],
        flagged: wp.array[wp.uint8],
    ): ...

    @wp.kernel(module="unique", enable_backward=False, module_options={"cpu_compiler_flags": COMPILER_FLAGS})
    def scatter_subtrees_shared(
        # In
        subtrees: Subtrees,
        count: int,
        mu: wp.array[wp.float32],
        lam: wp.array[wp.float32],
        stride: int,
        u: wp.array[wp.vec4],
        rotations: wp.array[wp.mat33],
        unit: wp.array[wp.int32],
        # Out
        f: wp.array[wp.vec4],
        flagged: wp.array[wp.uint8],
    ):
        eight_subtrees(subtrees, wp.tid(), count, mu, lam, stride, u, rotations, unit, f, flagged)

    return scatter_subtrees_shared


@functools.cache
def scatter_subtrees_near(shape: int) -> wp.Kernel:
    """Corotated forces of subtrees; a thread is eight subtrees.

    With their root's rotation where it is near those of the leaves: where the displacement gradient E that it leaves
    in each has |skew E| <= tolerance [rad] and |sym E| <= 1/2, and the subtree as one element is strained by no more
    either. The stress is then wrong by no more than ``forces.shared_forces`` says. Elsewhere every leaf has its
    own rotation, and the forces are those of ``scatter_subtrees_own`` to the bit.
    """

    @wp.func_native(_near(shape))
    def eight_subtrees(
        subtrees: Subtrees,
        block: int,
        count: int,
        mu: wp.array[wp.float32],
        lam: wp.array[wp.float32],
        stride: int,
        u: wp.array[wp.vec4],
        tolerance: float,
        f: wp.array[wp.vec4],
        flagged: wp.array[wp.uint8],
    ): ...

    @wp.kernel(module="unique", enable_backward=False, module_options={"cpu_compiler_flags": COMPILER_FLAGS})
    def scatter_subtrees_near(
        # In
        subtrees: Subtrees,
        count: int,
        mu: wp.array[wp.float32],
        lam: wp.array[wp.float32],
        stride: int,
        u: wp.array[wp.vec4],
        tolerance: float,
        # Out
        f: wp.array[wp.vec4],
        flagged: wp.array[wp.uint8],
    ):
        eight_subtrees(subtrees, wp.tid(), count, mu, lam, stride, u, tolerance, f, flagged)

    return scatter_subtrees_near
