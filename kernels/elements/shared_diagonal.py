"""Diagonal blocks of the stiffness of a dilatation that elements share; see ``shared_dilatation``."""

import functools
from typing import Any

import warp as wp

from warp_corot.kernels.math.rotation import identity3
from warp_corot.kernels.modules import unique_kernel

from .constitutive import IsotropicMaterial
from .dilatation import Dilatation, mean_of
from .elements import gradient_of, rest_volume
from .forces import in_local_frame, own_gradient
from .shared_dilatation import is_live, place_of, range_of

wp.set_module_options({"enable_backward": False})


@wp.func
def hat_gradient(elements: Any, t: int, n: int):
    """The gradient of the n-th node's hat function in the frame of ``own_gradient`` (columns)."""
    x = wp.vec3(1.0, 0.0, 0.0)
    o = wp.vec3()
    unit = gradient_of(
        elements, t, wp.where(n == 0, x, o), wp.where(n == 1, x, o), wp.where(n == 2, x, o), wp.where(n == 3, x, o)
    )
    return wp.vec3(unit[0, 0], unit[0, 1], unit[0, 2])


@wp.func
def row_of(elements: Any, t: int, slope: wp.mat33, hat: wp.vec3):
    """d theta_e / d u of a node: (d theta_e / dF) grad N, in world space."""
    return in_local_frame(elements, t, slope) * hat


@functools.cache
def turning_block(Elements: type, of: Dilatation) -> wp.Function:
    """The part of a diagonal block that comes from the change of d theta / dF, over lambda V w'."""
    turning_of = of.turning

    @wp.func
    def turning_block(elements: Elements, t: int, a: wp.mat33, hat: wp.vec3):
        block = wp.mat33()
        axis = int(0)
        while axis < 3:
            e = wp.vec3(float(axis == 0), float(axis == 1), float(axis == 2))
            d = turning_of(a, wp.transpose(in_local_frame(elements, t, identity3())) * wp.outer(e, hat))
            block += wp.outer(in_local_frame(elements, t, d) * hat, e)
            axis += 1
        return block

    return turning_block


@functools.cache
def add_diagonal(Elements: type, of: Dilatation) -> wp.Kernel:
    """Add upper bounds of K's diagonal blocks: each element's block as if it did not share its dilatation."""
    measure, turning_of, holding = of.measure, turning_block(Elements, of), of.holding

    @unique_kernel()
    def add_diagonal(
        # In
        elements: Elements,
        places: wp.array[wp.int32],
        live: wp.array[wp.int32],
        material: IsotropicMaterial,
        u: wp.array[wp.vec4],
        shared: wp.array[wp.vec4],
        turning: float,
        # In and out
        blocks: wp.array[wp.mat33],
    ):
        t = wp.tid()
        if not is_live(live, t):
            return
        place = place_of(places, t)
        law = shared[place]
        a = own_gradient(elements, t, u)
        theta, slope = measure(a)
        pressure = turning * (law[1] + holding(theta)[1])
        curvature = law[3] + holding(theta)[2]
        weight = material.lam[place * material.stride] * rest_volume(elements, t)
        n = int(0)
        while n < 4:
            hat = hat_gradient(elements, t, n)
            row = row_of(elements, t, slope, hat)
            block = curvature * wp.outer(row, row) + pressure * turning_of(elements, t, a, hat)
            wp.atomic_add(blocks, elements.nodes[t][n], weight * block)
            n += 1

    return add_diagonal


@functools.cache
def add_diagonal_of_groups(Elements: type, of: Dilatation) -> wp.Kernel:
    """Add the diagonal blocks of K; a thread a group."""
    measure, turning_of, holding = of.measure, turning_block(Elements, of), of.holding

    @wp.func
    def weight_of(elements: Elements, t: int, material: IsotropicMaterial):
        return material.lam[t * material.stride] * rest_volume(elements, t)

    @wp.func
    def row_at(
        elements: Elements,
        material: IsotropicMaterial,
        u: wp.array[wp.vec4],
        members: wp.array[wp.int32],
        begin: int,
        end: int,
        node: int,
    ):
        """The sum of lambda V d theta_e / du of a node over the group."""
        row = wp.vec3()
        for i in range(begin, end):
            t = place_of(members, i)
            n = int(0)
            while n < 4:
                if elements.nodes[t][n] == node:
                    _theta, slope = measure(own_gradient(elements, t, u))
                    row += weight_of(elements, t, material) * row_of(elements, t, slope, hat_gradient(elements, t, n))
                n += 1
        return row

    @unique_kernel()
    def add_diagonal_of_groups(
        # In
        starts: wp.array[wp.int32],
        members: wp.array[wp.int32],
        live: wp.array[wp.int32],
        elements: Elements,
        material: IsotropicMaterial,
        u: wp.array[wp.vec4],
        shared: wp.array[wp.vec4],
        turning: float,
        # In and out
        blocks: wp.array[wp.mat33],
    ):
        g = wp.tid()
        if not is_live(live, g):
            return
        begin, end = range_of(starts, members, g)
        total = float(0.0)
        for i in range(begin, end):
            total += weight_of(elements, place_of(members, i), material)
        share = mean_of(1.0, total)
        for i in range(begin, end):
            t = place_of(members, i)
            law = shared[t]
            a = own_gradient(elements, t, u)
            theta, slope = measure(a)
            held = holding(theta)
            weight = weight_of(elements, t, material)
            n = int(0)
            while n < 4:
                node = elements.nodes[t][n]
                hat = hat_gradient(elements, t, n)
                row = row_of(elements, t, slope, hat)
                whole = row_at(elements, material, u, members, begin, end, node)
                block = weight * wp.outer(row, law[3] * share * whole + held[2] * row)
                if turning != 0.0:
                    block += (turning * weight * (law[1] + held[1])) * turning_of(elements, t, a, hat)
                wp.atomic_add(blocks, node, block)
                n += 1

    return add_diagonal_of_groups
