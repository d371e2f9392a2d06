"""Corotated forces of complete subtrees on CUDA: one thread a subtree, eight leaves in registers.

Three things make it fast. Forces are summed over the eight leaves in registers, and over a group of eight subtrees in
shared memory, where a table tells each lane which slots to add up; so each node of a group takes one atomic addition.
Sums go to global memory as 16-byte vector reductions if the card has them. The stress comes from a root of one
polynomial (``corotated.corotated``), in the same way for small strains and large ones.

A leaf that is flat, inverted or strained far beyond order one adds nothing. Its bit is set in its subtree's byte, and
the subtree is put on a list; ``degenerate`` computes those leaves. A body whose subtrees are all of one type has a
kernel for that type; any other body is one launch, in which each thread block looks up its work.
"""

import functools
from typing import Any

import warp as wp

from warp_corot.kernels.corotated.corotated import stretch_stress
from warp_corot.kernels.elements.constitutive import IsotropicMaterial, RotatedMaterial, law_functions
from warp_corot.kernels.elements.dilatation import Dilatation
from warp_corot.kernels.elements.elements import (
    ForestElements,
    Subtrees,
    add_four_forces,
    frame,
    local_gradient,
    nodal_forces,
    root_of,
)
from warp_corot.kernels.elements.simd8 import law_kernel

from .degenerate import DegenerateList, append, list_of, reserve
from .forces import (
    always_trusted,
    isotropic_leaves,
    leaf_stress,
    mat10,
    own_forces,
    own_turn,
    pressure_leaves,
    shared_pressure,
    shared_turn,
    subtree_forces,
    turn_out,
)
from .memory import BLOCK, add_single, group_memory, load_single, memory_of

wp.set_module_options({"enable_backward": False})

#: The number of blocks for which a multiprocessor's registers must have room, by type.
RESIDENT = (5, 5, 5)
#: ``WorkRange.shape`` of leaves in no subtree.
FLAT = 3


@wp.struct
class WorkRange:
    """Subtrees of one type, or leaves in none, that neighbouring thread blocks compute."""

    begin: int  # the first of these blocks
    count: int
    shape: int
    grouped: int
    subtrees: Subtrees
    flagged: wp.array[wp.uint8]


@wp.func
def nothing_shared(material: Any, y: mat10, first: int, q0: wp.vec3, q1: wp.vec3, q2: wp.vec3):
    return 0.0


@functools.cache
def scatter_subtrees(
    shape: int,
    grouped: bool,
    uniform: bool,
    leaves: wp.Function,
    Material: type = IsotropicMaterial,
    shared: wp.Function = nothing_shared,
    missed: str = "",
    resident: int = 0,
    turn: wp.Function = own_turn,
) -> wp.Kernel:
    """Forces of subtrees of one type under a law of leaves (``forces``). Launch with block_dim BLOCK.

    Args:
        shape: The type.
        grouped: Whether subtrees are in groups.
        uniform: Whether all leaves have the first one's material.
        leaves: The law; ``shared`` finds what the leaves of a subtree share from the material, the ten displacements,
            the first leaf's place and the columns of the subtree's frame.
        Material: The struct that the law reads.
        missed: "": the law leaves no leaf out; "flags": left-out leaves are flagged; "list": and their subtrees listed.
        resident: The number of blocks for which a multiprocessor's registers must have room; 0: any.
        turn: The policy of rotations (``forces``); with shared ones a subtree is left out whole.
    """
    load, add = memory_of(shape, grouped)
    forces = subtree_forces(shape, uniform, leaves)
    listed, options = missed == "list", {"launch_bounds": (BLOCK, resident)} if resident else {}
    own = turn is own_turn

    @law_kernel(grid_stride=False, **options)
    def scatter_subtrees(
        # In
        subtrees: Subtrees,
        material: Material,
        u: wp.array[wp.vec4],
        # Out
        f: wp.array[wp.vec4],
        flagged: wp.array[wp.uint8],
        degenerate: DegenerateList,
    ):
        s = wp.tid()
        h, q, mirror = root_of(subtrees, s)
        y, r0, r1, r2, is_good = turn(material, s, load(subtrees, s, u), q, h, mirror)
        first = wp.where(wp.static(uniform), 0, subtrees.first[s])
        g, mask = forces(y, h, material, shared(material, y, first, r0, r1, r2), first)
        if wp.static(not own) and not is_good:
            g = mat10()
            mask = 255
        if wp.static(missed != ""):
            flagged[s] = wp.uint8(mask)
        reserved = int(0)
        if wp.static(listed):
            reserved = reserve(degenerate, list_of(s // BLOCK), mask != 0, subtrees.code.shape[0] - s)
        add(subtrees, s, turn_out(g, r0, r1, r2), f)
        if wp.static(listed):
            to_come = subtrees.code.shape[0] - s
            append(degenerate, list_of(s // BLOCK), reserved, subtrees.first[s], mask, to_come)

    return scatter_subtrees


def scatter_subtrees_own(shape: int, grouped: bool, uniform: bool, listed: bool) -> wp.Kernel:
    """Corotated forces, every leaf with its own rotation."""
    leaves, resident = isotropic_leaves(shape, stretch_stress), RESIDENT[shape] if uniform else min(RESIDENT)
    missed = "list" if listed else "flags"
    return scatter_subtrees(shape, grouped, uniform, leaves, missed=missed, resident=resident)


def scatter_law_subtrees(shape: int, grouped: bool, uniform: bool, stress: wp.Function) -> wp.Kernel:
    """Forces of a law of ``elements.constitutive``, which needs no rotation."""
    return scatter_subtrees(shape, grouped, uniform, isotropic_leaves(shape, always_trusted(stress)))


def scatter_dilatation(shape: int, grouped: bool, uniform: bool, of: Dilatation) -> wp.Kernel:
    """Forces of the dilatation that the eight leaves of a subtree share."""
    return scatter_subtrees(
        shape, grouped, uniform, pressure_leaves(shape, of), shared=shared_pressure(shape, uniform, of)
    )


def scatter_subtrees_shared(shape: int, grouped: bool, uniform: bool, given: bool) -> wp.Kernel:
    """Corotated forces of subtrees whose leaves share a rotation: that of the subtree's root, or a given one."""
    leaves, turn = isotropic_leaves(shape, always_trusted(law_functions("linear").stress)), shared_turn(shape, given)
    missed, resident = ("", 0) if given else ("flags", 7)
    options: dict[str, Any] = {"missed": missed, "resident": resident, "turn": turn}
    return scatter_subtrees(shape, grouped, uniform, leaves, RotatedMaterial, **options)


# --- all of a body in one launch ------------------------------------------------------------------------------------


@functools.cache
def _scatter_subtree(shape: int, uniform: bool) -> wp.Function:
    """One subtree of a one; all shapes use the same shared memory for groups."""
    load_group, merge_group = group_memory((0, 1, 2))
    forces = own_forces(shape, uniform)

    @wp.func
    def scatter_subtree(
        subtrees: Subtrees,
        s: int,
        grouped: bool,
        material: IsotropicMaterial,
        u: wp.array[wp.vec4],
        f: wp.array[wp.vec4],
    ):
        h, q, mirror = root_of(subtrees, s)
        x = mat10()
        if grouped:
            x = load_group(subtrees.nodes, s // 8, wp.static(shape), u)
        if not grouped:
            x = load_single(subtrees, s, u)
        first = wp.where(wp.static(uniform), 0, subtrees.first[s])
        g, mask = forces(x, q, h, mirror, material, first)
        if grouped:
            merge_group(subtrees.targets, s // 8, wp.static(shape), g, f)
        else:
            add_single(subtrees, s, g, f)
        return mask

    return scatter_subtree


@functools.cache
def scatter_body(uniform: bool) -> wp.Kernel:
    """Corotated forces of all subtrees and other leaves of a body, every leaf with its own rotation.

    Launch with block_dim BLOCK and whole blocks.
    """
    subtree0, subtree1, subtree2 = (_scatter_subtree(shape, uniform) for shape in range(3))
    add_neighbours = add_four_forces(2)

    @law_kernel(grid_stride=False, launch_bounds=(BLOCK, min(RESIDENT)))
    def scatter_body(
        # In
        ranges: wp.array[WorkRange],
        elements: ForestElements,
        flat_leaves: wp.array[wp.int32],
        material: IsotropicMaterial,
        u: wp.array[wp.vec4],
        # Out
        f: wp.array[wp.vec4],
        degenerate: DegenerateList,
    ):
        block = wp.tid() // BLOCK
        k = int(ranges.shape[0] - 1)
        while ranges[k].begin > block:
            k -= 1
        s = wp.tid() - ranges[k].begin * BLOCK
        if s >= ranges[k].count:
            return
        shape = ranges[k].shape
        if shape == FLAT:
            t = flat_leaves[s]
            m = wp.where(wp.static(uniform), 0, t)
            p, trusted = leaf_stress(
                local_gradient(elements, t, u), frame(elements, t), material.mu[m], material.lam[m]
            )
            if not trusted:
                p = wp.mat33()
            reserved = reserve(degenerate, list_of(block), not trusted, ranges[k].count - s)
            f0, f1, f2, f3 = nodal_forces(elements, t, p)
            add_neighbours(f, elements.targets[t], f0, f1, f2, f3)
            append(degenerate, list_of(block), reserved, t, wp.where(trusted, 0, 1), ranges[k].count - s)
            return
        subtrees = ranges[k].subtrees
        grouped = ranges[k].grouped != 0
        mask = int(0)
        if shape == 0:
            mask = subtree0(subtrees, s, grouped, material, u, f)
        elif shape == 1:
            mask = subtree1(subtrees, s, grouped, material, u, f)
        else:
            mask = subtree2(subtrees, s, grouped, material, u, f)
        ranges[k].flagged[s] = wp.uint8(mask)
        to_come = ranges[k].count - s
        reserved = reserve(degenerate, list_of(block), mask != 0, to_come)
        append(degenerate, list_of(block), reserved, subtrees.first[s], mask, to_come)

    return scatter_body
