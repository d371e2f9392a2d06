"""The stiffness of tension, the part of the corotated law's derivative that R K R^T lacks; see ``corotated.tangent``.

A taut string swings back since its tension turns with it. The exact derivative has that part: with the eigenvectors v_k
of S, principal stretches l and Biot stresses s, a turn w of an element, half of axial(dF R^T), causes [Theta w]x R,
    Theta = sum over k of (s_i + s_j) / (l_i + l_j) v_k v_k^T,
in world axes. Terms that are negative are left out, so the sum with R K R^T is positive semidefinite.

A pressure p that elements share, positive in tension, has the derivative p d^2 J / dF^2 besides the rows of its groups:
p l_k on turns, which belongs to Theta, -p l_k on the shears of the same planes, and p l_k between the other two
stretches. These hold turns up only in part, so they go together; up to p = 2 mu / l the sum remains semidefinite.

Elements whose tension is too small to change the motion of a node within a step are left out.
"""

import functools

import warp as wp

from warp_corot.kernels.elements.constitutive import IsotropicMaterial, corotated_strain
from warp_corot.kernels.elements.elements import (
    ForestElements,
    GeneralElements,
    add_nodal_forces,
    edge_length,
    frame,
    gradient_of,
    local_gradient,
    rest_volume,
)
from warp_corot.kernels.elements.forces import where_is
from warp_corot.kernels.elements.simd8 import headers, on_cpu
from warp_corot.kernels.math.matrices import axial, column, frobenius, identity3
from warp_corot.kernels.math.rotation import quick_rotation
from warp_corot.kernels.modules import unique_kernel
from warp_corot.kernels.tables.shapes import GRADIENT

wp.set_module_options({"enable_backward": False})

#: An element counts if so many times the stiffness of its steepest hat function exceeds the inertia of a node in the
#: step. Those that meet at a node have some three times that stiffness, and steps bear twice the inertia without it.
MEETING = 1.5
#: The largest square of a hat function's gradient, times the square of the edge length.
STEEPEST = max(sum(columns[c][n] ** 2 for c in range(3)) for columns in GRADIENT for n in range(4))

#: What eight elements are in C++.
EIGHT = {ForestElements: "ForestEight", GeneralElements: "GeneralEight"}

mat43 = wp.types.matrix(shape=(4, 3), dtype=wp.float32)


@wp.func
def steepest(elements: ForestElements, t: int):
    """The square of the steepest gradient of a hat function [1/m^2]."""
    h = edge_length(elements, t)
    return wp.static(STEEPEST) / (h * h)


@wp.func
def steepest(elements: GeneralElements, t: int):
    rows = elements.rest_inverse[t]
    a, b, c = rows[0], rows[1], rows[2]
    d = a + b + c
    return wp.max(wp.max(wp.dot(a, a), wp.dot(b, b)), wp.max(wp.dot(c, c), wp.dot(d, d)))


@wp.func_native("return corot::twist_at<wp::mat_t<4, 3, float>>(strain, mu, lam, pressure);")
def twist_of(strain: wp.mat33, mu: float, lam: float, pressure: float) -> mat43: ...


@functools.cache
def find_taut(Elements: type) -> wp.Kernel:
    """Find the elements whose tension counts, and their rotations, Theta and p S in world axes (CUDA)."""

    @unique_kernel(native=headers("tension", cuda=True))
    def find_taut(
        # In
        elements: Elements,
        isotropic: IsotropicMaterial,
        dilating: IsotropicMaterial,
        shared: wp.array[wp.vec4],
        mass: wp.array[float],
        scales: wp.array[float],
        u: wp.array[wp.vec4],
        # Out
        taut: wp.array[wp.uint8],
        turns: wp.array[wp.mat33],
        twists: wp.array[wp.mat33],
        swells: wp.array[wp.mat33],
    ):
        t = wp.tid()
        q = frame(elements, t)
        g = local_gradient(elements, t, u)
        mu, lam = isotropic.mu[t * isotropic.stride], isotropic.lam[t * isotropic.stride]
        pressure = float(0.0)
        if shared.shape[0] > 0:
            pressure = dilating.lam[t * dilating.stride] * shared[t][1]
        # Green's strains are no smaller than the others where these are positive.
        a = wp.transpose(q) * g
        green = 0.5 * (a + wp.transpose(a) + wp.transpose(a) * a)
        size = frobenius(green)
        bound = 1.42 * mu * size + 2.0 * lam * wp.max(wp.trace(green), 0.0) + wp.max(pressure, 0.0) * (1.0 + size)
        nodes = elements.nodes[t]
        least = wp.min(wp.min(mass[nodes[0]], mass[nodes[1]]), wp.min(mass[nodes[2]], mass[nodes[3]]))
        stiffness = scales[2] * wp.static(MEETING) * rest_volume(elements, t) * steepest(elements, t)
        counts = stiffness * bound > scales[0] * least
        if counts:
            turn = quick_rotation(q + g)
            strain = corotated_strain(g, q, turn)
            twist = twist_of(strain, mu, lam, pressure)
            counts = stiffness * twist[3, 1] > scales[0] * least
            if counts:
                theta = wp.matrix_from_rows(twist[0], twist[1], twist[2])
                turns[t] = turn
                twists[t] = turn * theta * wp.transpose(turn)
                if swells.shape[0] > 0:
                    swells[t] = turn * (twist[3, 0] * (strain + identity3())) * wp.transpose(turn)
        taut[t] = wp.where(counts, wp.uint8(1), wp.uint8(0))

    return find_taut


@functools.cache
def find_taut8(Elements: type) -> wp.Kernel:
    """The same on the CPU, from the ``begin``-th eight elements on; a thread is eight elements."""
    given = "isotropic, dilating, shared, mass, scales, u, taut, turns, twists, swells"
    call = f"corot::find_taut<corot::{EIGHT[Elements]}>(elements, block, count, {MEETING}f, {STEEPEST!r}f, {given});"

    @wp.func_native(on_cpu(call))
    def eight_elements(
        elements: Elements,
        block: int,
        count: int,
        isotropic: IsotropicMaterial,
        dilating: IsotropicMaterial,
        shared: wp.array[wp.vec4],
        mass: wp.array[float],
        scales: wp.array[float],
        u: wp.array[wp.vec4],
        taut: wp.array[wp.uint8],
        turns: wp.array[wp.mat33],
        twists: wp.array[wp.mat33],
        swells: wp.array[wp.mat33],
    ): ...

    @unique_kernel(native=headers("tension"))
    def find_taut8(
        # In
        begin: int,
        count: int,
        elements: Elements,
        isotropic: IsotropicMaterial,
        dilating: IsotropicMaterial,
        shared: wp.array[wp.vec4],
        mass: wp.array[float],
        scales: wp.array[float],
        u: wp.array[wp.vec4],
        # Out
        taut: wp.array[wp.uint8],
        turns: wp.array[wp.mat33],
        twists: wp.array[wp.mat33],
        swells: wp.array[wp.mat33],
    ):
        block = begin + wp.tid()
        eight_elements(
            elements, block, count, isotropic, dilating, shared, mass, scales, u, taut, turns, twists, swells
        )

    return find_taut8


@wp.func
def cofactor_change(a: wp.mat33, b: wp.mat33):
    """The derivative of the cofactor of a in the direction b."""
    a0, a1, a2, b0, b1, b2 = column(a, 0), column(a, 1), column(a, 2), column(b, 0), column(b, 1), column(b, 2)
    return wp.matrix_from_cols(
        wp.cross(b1, a2) + wp.cross(a1, b2), wp.cross(b2, a0) + wp.cross(a2, b0), wp.cross(b0, a1) + wp.cross(a0, b1)
    )


@functools.cache
def add_taut_product(Elements: type) -> wp.Kernel:
    """y += K p of tension; a thread an element (CUDA)."""

    @unique_kernel()
    def add_taut_product(
        # In
        elements: Elements,
        taut: wp.array[wp.uint8],
        turns: wp.array[wp.mat33],
        twists: wp.array[wp.mat33],
        swells: wp.array[wp.mat33],
        p: wp.array[wp.vec4],
        # In and out
        y: wp.array[wp.vec4],
    ):
        t = wp.tid()
        if taut[t] == wp.uint8(0):
            return
        turn = turns[t]
        b = local_gradient(elements, t, p) * wp.transpose(turn)
        stress = wp.skew(0.5 * (twists[t] * axial(b)))
        if swells.shape[0] > 0:
            stress += cofactor_change(swells[t], b)
        add_nodal_forces(elements, t, -stress * turn, elements.nodes[t], y)

    return add_taut_product


@functools.cache
def add_taut_product8(Elements: type) -> wp.Kernel:
    """The same on the CPU; a thread is eight of ``count`` elements."""

    given = "taut, turns, twists, swells, p, y"

    @wp.func_native(on_cpu(f"corot::add_taut_product<corot::{EIGHT[Elements]}>(elements, block, count, {given});"))
    def eight_elements(
        elements: Elements,
        block: int,
        count: int,
        taut: wp.array[wp.uint8],
        turns: wp.array[wp.mat33],
        twists: wp.array[wp.mat33],
        swells: wp.array[wp.mat33],
        p: wp.array[wp.vec4],
        y: wp.array[wp.vec4],
    ): ...

    @unique_kernel(native=headers("tension"))
    def add_taut_product8(
        # In
        elements: Elements,
        count: int,
        taut: wp.array[wp.uint8],
        turns: wp.array[wp.mat33],
        twists: wp.array[wp.mat33],
        swells: wp.array[wp.mat33],
        p: wp.array[wp.vec4],
        # In and out
        y: wp.array[wp.vec4],
    ):
        eight_elements(elements, wp.tid(), count, taut, turns, twists, swells, p, y)

    return add_taut_product8


@functools.cache
def add_taut_diagonal(Elements: type) -> wp.Kernel:
    """Add the 3x3 blocks of tension on K's diagonal to those of the nodes; each thread takes one node of an element."""

    @unique_kernel()
    def add_taut_diagonal(
        # In
        elements: Elements,
        taut: wp.array[wp.uint8],
        turns: wp.array[wp.mat33],
        twists: wp.array[wp.mat33],
        # In and out
        blocks: wp.array[wp.mat33],
    ):
        t = wp.tid() // 4
        n = wp.tid() % 4
        if taut[t] == wp.uint8(0):
            return
        x = wp.vec3(1.0, 0.0, 0.0)
        unit = gradient_of(
            elements, t, where_is(n == 0, x), where_is(n == 1, x), where_is(n == 2, x), where_is(n == 3, x)
        )
        along = wp.skew(turns[t] * unit[0])
        block = (0.5 * rest_volume(elements, t)) * (wp.transpose(along) * twists[t] * along)
        wp.atomic_add(blocks, elements.nodes[t][n], block)

    return add_taut_diagonal
