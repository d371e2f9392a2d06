"""Corotated forces of one complete subtree in registers: ten displacements in, ten nodal forces out.

Kernels that read and write their nodes in different ways share this code (``cuda``, ``stepping.block``). Stresses are
computed from displacement gradients, so that small strains keep their digits (``corotated.algebraic.stretch_stress``).
A leaf that is flat, inverted or strained far beyond order one is left out and reported: bit k of the mask stands for
leaf k in tree order.
"""

import functools
import itertools
from collections.abc import Sequence

import warp as wp

from warp_corot.kernels.corotated.algebraic import stretch_stress
from warp_corot.kernels.elements.shapes import columns_of, leaf_forces_of
from warp_corot.kernels.math.rotation import ITERATIONS, column, newton_rotation
from warp_corot.kernels.tables.shapes import VOLUME, fingerprint
from warp_corot.kernels.tables.subtree import FRAMES, LEAVES, POSITIONS

wp.set_module_options({"enable_backward": False})

mat10 = wp.types.matrix(shape=(10, 3), dtype=wp.float32)


@functools.cache
def turns_of(shape: int) -> tuple[wp.Function, wp.Function]:
    """Functions for B^T C and B C, with the frame B of a leaf and a matrix C; the compiler must know the leaf's
    number."""
    columns = FRAMES[shape]
    rows = [list(zip(*frame, strict=True)) for frame in columns]
    return _products(columns), _products(rows)


def _products(matrices: Sequence[Sequence[Sequence[float]]]) -> wp.Function:
    """Code that multiplies by one of these matrices, without its zeros."""
    cases = ""
    for number, matrix in enumerate(matrices):
        entries = []
        for row, j in itertools.product(matrix, range(3)):
            terms = [f"{weight!r}f * c.data[{k}][{j}]" for k, weight in enumerate(row) if abs(weight) > 1e-9]
            entries.append(" + ".join(terms))
        cases += f"case {number}: return wp::mat_t<3, 3, wp::float32>({', '.join(entries)});\n"

    @wp.func_native(f"switch (leaf) {{\n{cases}default: return c;\n}}")
    def product(leaf: int, c: wp.mat33) -> wp.mat33: ...

    return product


@wp.func
def leaf_stress(g: wp.mat33, q: wp.mat33, mu: float, lam: float):
    """First Piola-Kirchhoff stress of one leaf with its own rotation, times Q, and whether it may be trusted."""
    p, trusted = stretch_stress(wp.transpose(q) * g, mu, lam)
    return q * p, trusted


@functools.cache
def turned_forces_of(shape: int, uniform: bool, chosen: range, stress: wp.Function = stretch_stress) -> wp.Function:
    """Forces of the chosen leaves, each on its own, and a mask of those left out; in the subtree's Maubach frame, or in
    a frame that turns with the subtree.

    ``y`` are ten displacements in that frame, in edge lengths h of a leaf; tables hold the leaves' frames B. ``stress``
    is a law of the displacement gradient and Lamé's parameters; it also returns whether its result may be trusted.
    """
    columns, leaf_forces = columns_of(shape), leaf_forces_of(shape)
    leaves, frames = LEAVES[shape], FRAMES[shape]
    into_leaf, out_of_leaf = turns_of(shape)
    begin, end = chosen.start, chosen.stop
    volume = VOLUME[shape]

    @wp.func
    def turned_forces(y: mat10, h: float, mu: wp.array[wp.float32], lam: wp.array[wp.float32], first: int):
        _generated_from = wp.static(fingerprint(leaves, frames, begin, end))
        # P V / h.
        area = wp.static(volume) * h * h
        m = area * mu[first]
        k = area * lam[first]
        g = mat10()
        left_out = int(0)
        for leaf in range(wp.static(begin), wp.static(end)):
            if wp.static(not uniform):
                m = area * mu[first + leaf]
                k = area * lam[first + leaf]
            b0, b1, b2 = columns(
                y[wp.static(leaves[leaf][0])],
                y[wp.static(leaves[leaf][1])],
                y[wp.static(leaves[leaf][2])],
                y[wp.static(leaves[leaf][3])],
            )
            # From the displacement gradient in the leaf's frame.
            sigma, trusted = stress(into_leaf(leaf, wp.matrix_from_cols(b0, b1, b2)), m, k)
            if trusted:
                p = out_of_leaf(leaf, sigma)
                f0, f1, f2, f3 = leaf_forces(column(p, 0), column(p, 1), column(p, 2))
                g[wp.static(leaves[leaf][0])] += f0
                g[wp.static(leaves[leaf][1])] += f1
                g[wp.static(leaves[leaf][2])] += f2
                g[wp.static(leaves[leaf][3])] += f3
            else:
                left_out |= wp.static(1 << leaf)
        return g, left_out

    return turned_forces


@functools.cache
def own_forces(shape: int, uniform: bool, chosen: range = range(8)) -> wp.Function:
    """Forces of the chosen leaves from ten displacements, each leaf with its own rotation, and a mask of those left
    out.

    ``q`` is the subtree's frame, ``h`` a leaf's edge length, ``first`` the place of the first leaf's material; unless
    ``uniform``, those of the other leaves follow.
    """
    turned_forces = turned_forces_of(shape, uniform, chosen)

    @wp.func
    def own_forces(
        x: mat10, q: wp.mat33, h: float, mirror: float, mu: wp.array[wp.float32], lam: wp.array[wp.float32], first: int
    ):
        q0 = column(q, 0)
        q1 = column(q, 1)
        q2 = column(q, 2) * mirror
        inv_h = 1.0 / h
        h0 = inv_h * q0
        h1 = inv_h * q1
        h2 = inv_h * q2
        origin = x[0]
        y = mat10()
        for n in range(1, 10):
            d = x[n] - origin
            y[n] = wp.vec3(wp.dot(h0, d), wp.dot(h1, d), wp.dot(h2, d))
        g, left_out = turned_forces(y, h, mu, lam, first)
        for n in range(10):
            force = g[n]
            g[n] = force[0] * q0 + force[1] * q1 + force[2] * q2
        return g, left_out

    return own_forces


@functools.cache
def turned_back_of(shape: int) -> wp.Function:
    """Displacements R^T x - x0 in the subtree's Maubach frame q, in edge lengths of a leaf; r = R q.

    They are R^T u + (R^T - I) x0. Let D = R - I, which is small for small rotations. Because R is a rotation,
    sym(R^T - I) = -D^T D / 2. So R^T - I keeps the digits of D, and the strain keeps the digits of the displacements.
    """
    at = [[2.0 * c for c in point] for point in POSITIONS[shape]]

    @wp.func
    def turned_back(
        x: mat10, inv_h: float, q0: wp.vec3, q1: wp.vec3, q2: wp.vec3, r0: wp.vec3, r1: wp.vec3, r2: wp.vec3
    ):
        _generated_from = wp.static(fingerprint(at))
        d0 = r0 - q0
        d1 = r1 - q1
        d2 = r2 - q2
        # The skew part, and half of the symmetric one.
        w01 = 0.5 * (wp.dot(d0, q1) - wp.dot(d1, q0))
        w02 = 0.5 * (wp.dot(d0, q2) - wp.dot(d2, q0))
        w12 = 0.5 * (wp.dot(d1, q2) - wp.dot(d2, q1))
        s01 = -0.5 * wp.dot(d0, d1)
        s02 = -0.5 * wp.dot(d0, d2)
        s12 = -0.5 * wp.dot(d1, d2)
        t0 = wp.vec3(-0.5 * wp.dot(d0, d0), s01 - w01, s02 - w02)
        t1 = wp.vec3(s01 + w01, -0.5 * wp.dot(d1, d1), s12 - w12)
        t2 = wp.vec3(s02 + w02, s12 + w12, -0.5 * wp.dot(d2, d2))
        origin = x[0]
        y = mat10()
        for n in range(10):
            d = (x[n] - origin) * inv_h
            y[n] = wp.vec3(wp.dot(r0, d), wp.dot(r1, d), wp.dot(r2, d)) + (
                wp.static(at[n][0]) * t0 + wp.static(at[n][1]) * t1 + wp.static(at[n][2]) * t2
            )
        return y

    return turned_back


@functools.cache
def shared_forces(shape: int, uniform: bool, given: bool, chosen: range = range(8)) -> wp.Function:
    """Forces of the chosen leaves from ten displacements, all with one rotation, and a mask of those left out: none or
    all.

    The rotation is that of the subtree's root, or a given one; ``turn`` is the given one times the subtree's frame
    ``q``. The ten displacements are turned back once; then the leaves are linear elements in the subtree's own frame.
    """
    columns, leaf_forces = columns_of(shape), leaf_forces_of(shape)
    leaves, frames, at = LEAVES[shape], FRAMES[shape], POSITIONS[shape]
    into_leaf, out_of_leaf = turns_of(shape)
    turned_back = turned_back_of(shape)
    begin, end = chosen.start, chosen.stop
    volume = VOLUME[shape]

    @wp.func
    def shared_forces(
        x: mat10,
        q: wp.mat33,
        h: float,
        mirror: float,
        turn: wp.mat33,
        mu: wp.array[wp.float32],
        lam: wp.array[wp.float32],
        first: int,
    ):
        _generated_from = wp.static(fingerprint(leaves, frames, at, begin, end))
        left_out = int(0)
        q0 = column(q, 0)
        q1 = column(q, 1)
        q2 = column(q, 2) * mirror
        inv_h = 1.0 / h
        r0 = wp.vec3()
        r1 = wp.vec3()
        r2 = wp.vec3()
        if wp.static(given):
            r0 = column(turn, 0)
            r1 = column(turn, 1)
            r2 = column(turn, 2) * mirror
        else:
            # The subtree's edge is two of a leaf's.
            c0, c1, c2 = columns(x[0], x[1], x[2], x[3])
            half = 0.5 * inv_h
            z0, z1, z2, trusted = newton_rotation(q0 + half * c0, q1 + half * c1, q2 + half * c2, mirror)
            r0 = wp.static(0.5**ITERATIONS) * z0
            r1 = wp.static(0.5**ITERATIONS) * z1
            r2 = wp.static(0.5**ITERATIONS) * z2
            if not trusted:
                left_out = wp.static(sum(1 << leaf for leaf in chosen))
        y = turned_back(x, inv_h, q0, q1, q2, r0, r1, r2)
        m = mu[first]
        k = lam[first]
        area = wp.static(volume) * h * h
        g = mat10()
        for leaf in range(wp.static(begin), wp.static(end)):
            if wp.static(not uniform):
                m = mu[first + leaf]
                k = lam[first + leaf]
            b0, b1, b2 = columns(
                y[wp.static(leaves[leaf][0])],
                y[wp.static(leaves[leaf][1])],
                y[wp.static(leaves[leaf][2])],
                y[wp.static(leaves[leaf][3])],
            )
            e = into_leaf(leaf, wp.matrix_from_cols(b0, b1, b2))
            double_mu = 2.0 * m * area
            pressure = k * area * (e[0, 0] + e[1, 1] + e[2, 2])
            s01 = m * area * (e[0, 1] + e[1, 0])
            s02 = m * area * (e[0, 2] + e[2, 0])
            s12 = m * area * (e[1, 2] + e[2, 1])
            sigma = wp.mat33(
                double_mu * e[0, 0] + pressure,
                s01,
                s02,
                s01,
                double_mu * e[1, 1] + pressure,
                s12,
                s02,
                s12,
                double_mu * e[2, 2] + pressure,
            )
            p = out_of_leaf(leaf, sigma)
            f0, f1, f2, f3 = leaf_forces(column(p, 0), column(p, 1), column(p, 2))
            g[wp.static(leaves[leaf][0])] += f0
            g[wp.static(leaves[leaf][1])] += f1
            g[wp.static(leaves[leaf][2])] += f2
            g[wp.static(leaves[leaf][3])] += f3
        for n in range(10):
            force = g[n]
            g[n] = force[0] * r0 + force[1] * r1 + force[2] * r2
        if left_out != 0:
            g = mat10()
        return g, left_out

    return shared_forces
