"""Anisotropic materials and active stress of changing elements: conversion between carried data and kernel input."""

from typing import Any

import warp as wp

from warp_corot.kernels.corotated.anisotropic import vec9
from warp_corot.kernels.math.rotation import identity3
from warp_corot.kernels.plan.plan import Plan, extent, leaf_row

from .pools import LEAVES, Pools

wp.set_module_options({"enable_backward": False})


@wp.func
def gathered_axes(plan: Plan, row: int, i: int):
    return wp.mat33(
        plan.values[row, i], plan.values[row + 1, i], plan.values[row + 2, i],
        plan.values[row + 3, i], plan.values[row + 4, i], plan.values[row + 5, i],
        plan.values[row + 6, i], plan.values[row + 7, i], plan.values[row + 8, i],
    )  # fmt: skip


@wp.kernel(enable_backward=False)
def assemble_materials(
    # In
    threads: int,
    pools: Pools,
    plan: Plan,
    axes_row: int,
    stiffness_row: int,
    # Out
    axes: wp.array[wp.mat33],
    stiffness: wp.array[vec9],
):
    """Axes and stiffness of each leaf, each from nine rows of values from a first row on; a negative row: none.

    Padding has the identity and zero.
    """
    for i in range(wp.tid(), extent(leaf_row(plan), plan), threads):
        is_leaf = i < pools.counts[LEAVES]
        if axes_row >= 0:
            m = identity3()
            if is_leaf:
                m = gathered_axes(plan, axes_row, i)
            axes[i] = m
        if stiffness_row >= 0:
            c = vec9()
            for n in range(9):
                c[n] = plan.values[stiffness_row + n, i]
            stiffness[i] = c


@wp.kernel(enable_backward=False)
def write_leaves(
    # In
    leaves: wp.array[wp.int32],
    given: wp.array[Any],
    column: int,
    # Out
    columns: wp.array2d[Any],
):
    """Write values given by places in the list into the leaves' data."""
    i = wp.tid()
    columns[leaves[i], column] = given[i]


@wp.kernel(enable_backward=False)
def read_leaves(
    # In
    leaves: wp.array[wp.int32],
    columns: wp.array2d[Any],
    column: int,
    # Out
    found: wp.array[Any],
):
    i = wp.tid()
    found[i] = columns[leaves[i], column]


def _by_type(kernel: wp.Kernel, of_leaves: str) -> dict[type, wp.Kernel]:
    """The kernel for values and for whole numbers, chosen once and not at every launch."""
    return {
        kind: wp.overload(kernel, {of_leaves: wp.array(dtype=kind), "columns": wp.array2d(dtype=kind)})
        for kind in (wp.float32, wp.int32)
    }


WRITE_LEAVES = _by_type(write_leaves, "given")
READ_LEAVES = _by_type(read_leaves, "found")
