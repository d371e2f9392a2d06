"""Corotated forces of one complete subtree in registers: ten displacements in, ten nodal forces out.

Kernels that read and write their nodes in different ways share this code (``cuda``, ``stepping.block``). Stresses are
computed from displacement gradients, so that small strains keep their digits (``corotated.corotated.stretch_stress``).
A leaf that is flat, inverted or strained far beyond order one is left out and reported: bit k of the mask stands for
leaf k in tree order.
"""

import functools
import itertools
from collections.abc import Sequence
from typing import Any

import warp as wp

from warp_corot.kernels.corotated.corotated import stretch_stress
from warp_corot.kernels.elements.constitutive import IsotropicMaterial, RotatedMaterial
from warp_corot.kernels.elements.dilatation import VOLUME as VOLUME_CHANGE
from warp_corot.kernels.elements.dilatation import Dilatation, mean_of, pressure_stress_of
from warp_corot.kernels.elements.shapes import columns_of, leaf_forces_of
from warp_corot.kernels.math.rotation import ITERATIONS, column, newton_rotation
from warp_corot.kernels.tables.shapes import VOLUME, fingerprint
from warp_corot.kernels.tables.subtree import FRAMES, HANDEDNESS, LEAVES, POSITIONS

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


@functools.cache
def handedness_of(shape: int) -> wp.Function:
    """A function for the determinant of a leaf's frame."""
    numbers = ", ".join(f"{float(number)!r}f" for number in HANDEDNESS[shape])

    @wp.func_native(f"static const float numbers[8] = {{{numbers}}};\nreturn numbers[leaf];")
    def handedness(leaf: int) -> float: ...

    return handedness


@wp.func
def leaf_stress(g: wp.mat33, q: wp.mat33, mu: float, lam: float):
    """First Piola-Kirchhoff stress of one leaf with its own rotation, times Q, and whether it may be trusted."""
    p, trusted = stretch_stress(wp.transpose(q) * g, mu, lam)
    return q * p, trusted


@functools.cache
def always_trusted(stress: wp.Function) -> wp.Function:
    @wp.func
    def trusted_stress(a: wp.mat33, mu: float, lam: float):
        return stress(a, mu, lam), True

    return trusted_stress


@wp.func
def lame_of(material: IsotropicMaterial, t: int):
    return material.mu[t], material.lam[t]


@wp.func
def lame_of(material: RotatedMaterial, t: int):
    return material.isotropic.mu[t], material.isotropic.lam[t]


@functools.cache
def isotropic_leaves(shape: int, stress: wp.Function) -> wp.Function:
    """The law of leaves of a ``stress`` of A and Lamé's parameters, which also says whether it may be trusted."""
    into_leaf, out_of_leaf = turns_of(shape)

    @wp.func
    def isotropic_leaf(material: Any, extra: float, leaf: int, t: int, area: float, g: wp.mat33):
        mu, lam = lame_of(material, t)
        p, trusted = stress(into_leaf(leaf, g), area * mu, area * lam)
        return out_of_leaf(leaf, p), trusted, trusted

    return isotropic_leaf


@functools.cache
def subtree_forces(shape: int, uniform: bool, law: wp.Function, chosen: range = range(8)) -> wp.Function:
    """Forces of the chosen leaves under a law of leaves, and a mask of those that may not be trusted.

    ``y`` are ten displacements in the subtree's Maubach frame, or one that turns with it, in edge lengths h of a leaf;
    ``first`` is the place of the first leaf's material; unless ``uniform``, those of the other leaves follow.
    """
    columns, leaf_forces = columns_of(shape), leaf_forces_of(shape)
    leaves, volume, begin, end = LEAVES[shape], VOLUME[shape], chosen.start, chosen.stop

    @wp.func
    def subtree_forces(y: mat10, h: float, material: Any, extra: Any, first: int):
        _generated_from = wp.static(fingerprint(leaves, FRAMES[shape], begin, end))
        # P V / h is the stress times this.
        area = wp.static(volume) * h * h
        g = mat10()
        degenerate = int(0)
        for leaf in range(wp.static(begin), wp.static(end)):
            b0, b1, b2 = columns(
                y[wp.static(leaves[leaf][0])],
                y[wp.static(leaves[leaf][1])],
                y[wp.static(leaves[leaf][2])],
                y[wp.static(leaves[leaf][3])],
            )
            t = first + wp.static(0 if uniform else leaf)
            p, counts, trusted = law(material, extra, leaf, t, area, wp.matrix_from_cols(b0, b1, b2))
            if counts:
                f0, f1, f2, f3 = leaf_forces(column(p, 0), column(p, 1), column(p, 2))
                g[wp.static(leaves[leaf][0])] += f0
                g[wp.static(leaves[leaf][1])] += f1
                g[wp.static(leaves[leaf][2])] += f2
                g[wp.static(leaves[leaf][3])] += f3
            if not trusted:
                degenerate |= wp.static(1 << leaf)
        return g, degenerate

    return subtree_forces


@wp.func
def maubach_frame(q: wp.mat33, mirror: float):
    """The columns of a subtree's Maubach frame, whose third one is turned round if it is left-handed."""
    return column(q, 0), column(q, 1), column(q, 2) * mirror


@wp.func
def turn_in(x: mat10, q0: wp.vec3, q1: wp.vec3, q2: wp.vec3, inv_h: float):
    """Displacements relative to the first node's, in the frame with columns q and in edge lengths of a leaf."""
    h0 = inv_h * q0
    h1 = inv_h * q1
    h2 = inv_h * q2
    origin = x[0]
    y = mat10()
    for n in range(1, 10):
        d = x[n] - origin
        y[n] = wp.vec3(wp.dot(h0, d), wp.dot(h1, d), wp.dot(h2, d))
    return y


@wp.func
def turn_out(g: mat10, q0: wp.vec3, q1: wp.vec3, q2: wp.vec3):
    """Turn vectors from the frame with columns q into world space."""
    x = mat10()
    for n in range(10):
        x[n] = g[n, 0] * q0 + g[n, 1] * q1 + g[n, 2] * q2
    return x


@functools.cache
def own_forces(
    shape: int, uniform: bool, stress: wp.Function = stretch_stress, chosen: range = range(8)
) -> wp.Function:
    """Forces of the chosen leaves from ten displacements under an isotropic law, and a mask of those left out.

    ``q`` is the subtree's frame, ``h`` a leaf's edge length, ``first`` the place of the first leaf's material.
    """
    forces = subtree_forces(shape, uniform, isotropic_leaves(shape, stress), chosen)

    @wp.func
    def own_forces(x: mat10, q: wp.mat33, h: float, mirror: float, material: IsotropicMaterial, first: int):
        q0, q1, q2 = maubach_frame(q, mirror)
        g, degenerate = forces(turn_in(x, q0, q1, q2, 1.0 / h), h, material, 0.0, first)
        return turn_out(g, q0, q1, q2), degenerate

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


@wp.func
def own_turn(material: Any, s: int, x: mat10, q: wp.mat33, h: float, mirror: float):
    """A rotation policy: displacements of the ten nodes for the leaves' laws, in edge lengths of a leaf; the columns by
    which forces return to world space; and whether these may be trusted. Here leaves have their own rotations."""
    q0, q1, q2 = maubach_frame(q, mirror)
    return turn_in(x, q0, q1, q2, 1.0 / h), q0, q1, q2, True


@functools.cache
def shared_turn(shape: int, given: bool) -> wp.Function:
    """The policy of leaves that all have one rotation, that of the subtree's root or a given one: the ten displacements
    are turned back once; then the leaves are linear elements in the subtree's own frame."""
    columns, turned_back = columns_of(shape), turned_back_of(shape)

    @wp.func
    def shared_turn(material: RotatedMaterial, s: int, x: mat10, q: wp.mat33, h: float, mirror: float):
        q0, q1, q2 = maubach_frame(q, mirror)
        r0, r1, r2 = q0, q1, q2
        inv_h = 1.0 / h
        is_good = bool(True)
        if wp.static(given):
            r0, r1, r2 = maubach_frame(material.rotations[material.unit[s]] * q, mirror)
        else:
            # The subtree's edge is two of a leaf's.
            c0, c1, c2 = columns(x[0], x[1], x[2], x[3])
            half = 0.5 * inv_h
            r0, r1, r2, is_good = newton_rotation(q0 + half * c0, q1 + half * c1, q2 + half * c2, mirror)
            r0 = wp.static(0.5**ITERATIONS) * r0
            r1 = wp.static(0.5**ITERATIONS) * r1
            r2 = wp.static(0.5**ITERATIONS) * r2
        return turned_back(x, inv_h, q0, q1, q2, r0, r1, r2), r0, r1, r2, is_good

    return shared_turn


# --- the dilatation that the eight leaves of a subtree share ---------------------------------------------------------
#
# The dilatation that the eight leaves of a complete subtree share; see ``elements.dilatation``.
#
# This is the fast kernel for its forces on CUDA, where a thread takes a subtree, with ten displacements in and ten
# forces out; ``cpu`` has that for the CPU. ``elements.dilatation`` computes everything else leaf by leaf.


@functools.cache
def dilatation_sums_of(shape: int, uniform: bool, of: Dilatation, chosen: range = range(8)) -> wp.Function:
    """The sums of lambda theta and of lambda over the chosen leaves, which have equal volumes.

    The ten displacements are in the frame of ``forces.turn_in``.
    """
    measure, columns = of.measure, columns_of(shape)
    leaves, begin, end = LEAVES[shape], chosen.start, chosen.stop
    into_leaf, _out_of_leaf = turns_of(shape)

    @wp.func
    def dilatation_sums(y: mat10, lam: wp.array[wp.float32], first: int):
        _generated_from = wp.static(fingerprint(leaves, begin, end))
        k = lam[first]
        sum = float(0.0)
        weight = float(0.0)
        for leaf in range(wp.static(begin), wp.static(end)):
            if wp.static(not uniform):
                k = lam[first + leaf]
            b0, b1, b2 = columns(
                y[wp.static(leaves[leaf][0])],
                y[wp.static(leaves[leaf][1])],
                y[wp.static(leaves[leaf][2])],
                y[wp.static(leaves[leaf][3])],
            )
            theta, _slope = measure(into_leaf(leaf, wp.matrix_from_cols(b0, b1, b2)))
            sum += k * theta
            weight += k
        return sum, weight

    return dilatation_sums


@functools.cache
def pressure_leaves(shape: int, of: Dilatation) -> wp.Function:
    """The law of leaves (``forces``) of the pressure alone; the leaves of a subtree share the pressure."""
    stress = pressure_stress_of(of)
    into_leaf, out_of_leaf = turns_of(shape)

    @wp.func
    def pressure_leaf(material: IsotropicMaterial, pressure: float, leaf: int, t: int, area: float, g: wp.mat33):
        return out_of_leaf(leaf, stress(into_leaf(leaf, g), pressure, area * material.lam[t])), True, True

    return pressure_leaf


@functools.cache
def dilating_leaves(shape: int) -> wp.Function:
    """The corotated law of leaves with the pressure, which a leaf has even if its corotated stress may not be trusted.
    ``lam`` is that of the pressure.
    """
    pressure_stress = pressure_stress_of(VOLUME_CHANGE)
    into_leaf, out_of_leaf = turns_of(shape)

    @wp.func
    def dilating_leaf(material: IsotropicMaterial, pressure: float, leaf: int, t: int, area: float, g: wp.mat33):
        a = into_leaf(leaf, g)
        sigma, trusted = stretch_stress(a, area * material.mu[t], 0.0)
        return out_of_leaf(leaf, sigma + pressure_stress(a, pressure, area * material.lam[t])), True, trusted

    return dilating_leaf


@functools.cache
def shared_pressure(shape: int, uniform: bool, of: Dilatation) -> wp.Function:
    """w' of the dilatation that a subtree's leaves share."""
    sums, slope_of = dilatation_sums_of(shape, uniform, of), of.slope

    @wp.func
    def shared_pressure(material: IsotropicMaterial, y: mat10, first: int, q0: wp.vec3, q1: wp.vec3, q2: wp.vec3):
        sum, weight = sums(y, material.lam, first)
        return slope_of(mean_of(sum, weight))

    return shared_pressure
