"""Corotated forces of one complete subtree in registers: ten displacements in, ten nodal forces out.

What kernels share that read and write their nodes each in its own way (``subtree_cuda``, ``block``). Rotations are
found by four unscaled iterations (``rotation.newton_rotation``); a subtree with a leaf that these do not turn, strongly
stretched, flat or inverted, gets no force and is reported.
"""

import functools

import warp as wp

from .elements import ROOT2
from .rotation import ITERATIONS, column, newton_rotation
from .shapes import VOLUME, fingerprint
from .subtree import FRAMES, HANDEDNESS, LEAVES, POSITIONS

wp.set_module_options({"enable_backward": False})

mat10 = wp.types.matrix(shape=(10, 3), dtype=wp.float32)


@functools.cache
def columns_of(shape: int) -> wp.Function:
    """Differences of four nodes, the columns of F in the Maubach frame where lengths are in edge lengths."""

    @wp.func
    def columns(x0: wp.vec3, x1: wp.vec3, x2: wp.vec3, x3: wp.vec3):
        c0 = x1 - x0
        c1 = x2 - x1
        c2 = x3 - x2
        if wp.static(shape == 1):
            c2 = c2 + (x3 - x0)
        if wp.static(shape == 2):
            c0 = ROOT2 * (x0 - x2)
            c1 = ROOT2 * (x1 - x2)
            c2 = 2.0 * c2
        return c0, c1, c2

    return columns


@functools.cache
def leaf_forces_of(shape: int) -> wp.Function:
    """Forces on the four nodes from the columns of the stress times V / h."""

    @wp.func
    def leaf_forces(p0: wp.vec3, p1: wp.vec3, p2: wp.vec3):
        f0 = p0
        f1 = p1 - p0
        f2 = p2 - p1
        f3 = -p2
        if wp.static(shape == 1):
            f0 = p0 + p2
            f3 = -2.0 * p2
        if wp.static(shape == 2):
            f0 = -ROOT2 * p0
            f1 = -ROOT2 * p1
            f2 = ROOT2 * (p0 + p1) + 2.0 * p2
            f3 = -2.0 * p2
        return f0, f1, f2, f3

    return leaf_forces


@functools.cache
def deformed_of(shape: int) -> wp.Function:
    """Turn ten displacements into ten positions relative to the first node's displacement, in edge lengths of a leaf.

    In that unit a subtree at rest has whole numbers for columns, and its forces vanish exactly.
    """
    at = [[2.0 * c for c in point] for point in POSITIONS[shape]]

    @wp.func
    def deformed(x: mat10, q: wp.mat33, inv_h: float, mirror: float):
        _generated_from = wp.static(fingerprint(at))
        q0 = column(q, 0)
        q1 = column(q, 1)
        q2 = column(q, 2) * mirror
        origin = x[0]
        y = mat10()
        for k in range(10):
            y[k] = (x[k] - origin) * inv_h + (
                wp.static(at[k][0]) * q0 + wp.static(at[k][1]) * q1 + wp.static(at[k][2]) * q2
            )
        return y

    return deformed


@functools.cache
def own_forces(shape: int, uniform: bool, chosen: range = range(8)) -> wp.Function:
    """Forces of the chosen leaves, each with its own rotation, and whether they may be trusted.

    ``h`` is a leaf's edge length, ``first`` where its material stands, and that of the other leaves unless uniform.
    With a rotation, R sym(R^T F) = F, so P = 2 mu (F - R) + lambda tr(R^T F - I) R: no matrix is multiplied.
    """
    columns, leaf_forces = columns_of(shape), leaf_forces_of(shape)
    leaves, handed = LEAVES[shape], HANDEDNESS[shape]
    begin, end = chosen.start, chosen.stop
    volume = VOLUME[shape]

    @wp.func
    def own_forces(x: mat10, h: float, mirror: float, mu: wp.array[wp.float32], lam: wp.array[wp.float32], first: int):
        _generated_from = wp.static(fingerprint(leaves, handed, begin, end))
        m = mu[first]
        k = lam[first]
        # P V/h = from_f F + from_z Z with Z = 2^ITERATIONS R.
        area = wp.static(volume) * h * h
        area_z = wp.static(0.5**ITERATIONS) * area
        g = mat10()
        trusted = bool(True)
        for leaf in range(wp.static(begin), wp.static(end)):
            if wp.static(not uniform):
                m = mu[first + leaf]
                k = lam[first + leaf]
            hand = mirror * wp.static(handed[leaf])
            c0, c1, c2 = columns(
                x[wp.static(leaves[leaf][0])],
                x[wp.static(leaves[leaf][1])],
                x[wp.static(leaves[leaf][2])],
                x[wp.static(leaves[leaf][3])],
            )
            z0, z1, z2, converged = newton_rotation(c0, c1, c2, hand)
            trusted = trusted and converged
            trace = wp.static(0.5**ITERATIONS) * (wp.dot(z0, c0) + wp.dot(z1, c1) + wp.dot(z2, c2))
            from_f = 2.0 * m * area
            from_z = (k * (trace - 3.0) - 2.0 * m) * area_z
            f0, f1, f2, f3 = leaf_forces(
                from_f * c0 + from_z * z0, from_f * c1 + from_z * z1, from_f * c2 + from_z * z2
            )
            g[wp.static(leaves[leaf][0])] += f0
            g[wp.static(leaves[leaf][1])] += f1
            g[wp.static(leaves[leaf][2])] += f2
            g[wp.static(leaves[leaf][3])] += f3
        if not trusted:
            g = mat10()
        return g, trusted

    return own_forces


@functools.cache
def shared_forces(shape: int, uniform: bool, given: bool, chosen: range = range(8)) -> wp.Function:
    """Forces of the chosen leaves, all with one rotation, the subtree root's or a given one, and whether it may be
    trusted.

    The ten positions are turned back once; in the subtree's own frame the leaves are linear elements. ``turn`` is the
    given rotation times the subtree's frame.
    """
    columns, leaf_forces = columns_of(shape), leaf_forces_of(shape)
    leaves, frames, at = LEAVES[shape], FRAMES[shape], POSITIONS[shape]
    begin, end = chosen.start, chosen.stop
    volume = VOLUME[shape]

    @wp.func
    def shared_forces(
        x: mat10,
        h: float,
        mirror: float,
        turn: wp.mat33,
        mu: wp.array[wp.float32],
        lam: wp.array[wp.float32],
        first: int,
    ):
        _generated_from = wp.static(fingerprint(leaves, frames, at, begin, end))
        trusted = bool(True)
        r0 = wp.vec3()
        r1 = wp.vec3()
        r2 = wp.vec3()
        if wp.static(given):
            r0 = column(turn, 0)
            r1 = column(turn, 1)
            r2 = column(turn, 2) * mirror
        else:
            c0, c1, c2 = columns(x[0], x[1], x[2], x[3])
            # The subtree's edge is two of a leaf's.
            z0, z1, z2, converged = newton_rotation(0.5 * c0, 0.5 * c1, 0.5 * c2, mirror)
            trusted = converged
            r0 = wp.static(0.5**ITERATIONS) * z0
            r1 = wp.static(0.5**ITERATIONS) * z1
            r2 = wp.static(0.5**ITERATIONS) * z2
        y = mat10()
        for n in range(10):
            # Displacement in the subtree's Maubach frame.
            y[n] = wp.vec3(
                wp.dot(r0, x[n]) - wp.static(2.0 * at[n][0]),
                wp.dot(r1, x[n]) - wp.static(2.0 * at[n][1]),
                wp.dot(r2, x[n]) - wp.static(2.0 * at[n][2]),
            )
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
            c = wp.matrix_from_cols(b0, b1, b2)
            # B^T C in the leaf's frame B, zeros of B left out.
            e = wp.mat33()
            for i in range(3):
                for j in range(3):
                    for axis in range(3):
                        if wp.static(abs(frames[leaf][i][axis]) > 1e-9):
                            e[i, j] += wp.static(frames[leaf][i][axis]) * c[axis, j]
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
            p = wp.mat33()
            for axis in range(3):
                for j in range(3):
                    for i in range(3):
                        if wp.static(abs(frames[leaf][i][axis]) > 1e-9):
                            p[axis, j] += wp.static(frames[leaf][i][axis]) * sigma[i, j]
            f0, f1, f2, f3 = leaf_forces(column(p, 0), column(p, 1), column(p, 2))
            g[wp.static(leaves[leaf][0])] += f0
            g[wp.static(leaves[leaf][1])] += f1
            g[wp.static(leaves[leaf][2])] += f2
            g[wp.static(leaves[leaf][3])] += f3
        for n in range(10):
            force = g[n]
            g[n] = force[0] * r0 + force[1] * r1 + force[2] * r2
        if not trusted:
            g = mat10()
        return g, trusted

    return shared_forces
