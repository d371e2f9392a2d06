"""Corotated forces of orthotropic elements on the CPU, eight to the lanes of vector registers; see ``lanes``.

Both kinds of elements come as general ones, with M multiplied into their rest matrix: F M = M + (d1 d2 d3) B. An
element that the unscaled iteration does not turn adds nothing and is flagged; ``repair_anisotropic`` does those. Among
them are all that are near having no definite rotation (see ``anisotropic``): the iteration turns none whose stretches
are not within 0.44 and 2.27, and with these det(tr(S) I - S) / |S|^3 is above 0.5.
"""

import functools
from typing import Any

import warp as wp

from .anisotropic import OrthotropicMaterial, axes_of, element_forces, filled
from .elements import ForestElements, GeneralElements, frame, rest_volume
from .general_cpu import ADD_FORCES, gather_elements, rest_inverse_of
from .lanes import COMPILER_FLAGS, NEWTON, PRELUDE, on_cpu
from .remesh_plan import Plan, extent, leaf_row
from .rotation import ITERATIONS, byers_xu

wp.set_module_options({"enable_backward": False})

_GATHER = gather_elements("""
        const wp::mat_t<3, 3, wp::float32>& axes = material.axes.data[material.axes_stride * t];
        const wp::vec_t<9, wp::float32>& stiffness = material.stiffness.data[material.stride * t];
        for (int i = 0; i < 9; ++i) {
            m[i][lane] = axes.data[i / 3][i % 3];
            k[i][lane] = stiffness[i];
        }
        if (is_active) active[lane] = activation.data[t];
""")

_FORCES = f"""{PRELUDE}{NEWTON}
    lanes8 m[9], k[9], active = spread(0.0f);
{_GATHER}
    // Columns of F M and of its rotation.
    triple c[3], r[3];
    for (int j = 0; j < 3; ++j) {{
        const triple axis = {{m[j], m[3 + j], m[6 + j]}};
        c[j] = plus(plus(axis, scaled(b[j], d1)), plus(scaled(b[3 + j], d2), scaled(b[6 + j], d3)));
    }}
    const masks8 trusted = newton(c[0], c[1], c[2], spread(1.0f), r);
    for (int j = 0; j < 3; ++j) r[j] = scaled(spread({0.5**ITERATIONS!r}f), r[j]);
    const lanes8 e0 = dot(r[0], c[0]) - 1.0f, e1 = dot(r[1], c[1]) - 1.0f, e2 = dot(r[2], c[2]) - 1.0f;
    const lanes8 e01 = 0.5f * (dot(r[0], c[1]) + dot(r[1], c[0]));
    const lanes8 e02 = 0.5f * (dot(r[0], c[2]) + dot(r[2], c[0]));
    const lanes8 e12 = 0.5f * (dot(r[1], c[2]) + dot(r[2], c[1]));
    const lanes8 s0 = k[0] * e0 + k[3] * e1 + k[4] * e2;
    const lanes8 s1 = k[3] * e0 + k[1] * e1 + k[5] * e2;
    const lanes8 s2 = k[4] * e0 + k[5] * e1 + k[2] * e2;
    const lanes8 s01 = 2.0f * k[6] * e01, s02 = 2.0f * k[7] * e02, s12 = 2.0f * k[8] * e12;
    // tr(S) I - S has the diagonal h and the other entries -e; its adjugate and determinant.
    const lanes8 h0 = 2.0f + e1 + e2, h1 = 2.0f + e0 + e2, h2 = 2.0f + e0 + e1;
    const lanes8 a0 = h1 * h2 - e12 * e12, a1 = h0 * h2 - e02 * e02, a2 = h0 * h1 - e01 * e01;
    const lanes8 a01 = e02 * e12 + e01 * h2, a02 = e01 * e12 + e02 * h1, a12 = e01 * e02 + h0 * e12;
    const lanes8 det = h0 * a0 - e01 * a01 - e02 * a02;
    // Axial vector of e s - s e.
    const lanes8 w0 = e02 * s01 + e12 * s1 + e2 * s12 - (e01 * s02 + e1 * s12 + e12 * s2);
    const lanes8 w1 = e0 * s02 + e01 * s12 + e02 * s2 - (e02 * s0 + e12 * s01 + e2 * s02);
    const lanes8 w2 = e01 * s0 + e1 * s01 + e12 * s02 - (e0 * s01 + e01 * s1 + e02 * s12);
    const lanes8 over = 1.0f / det;
    const lanes8 t0 = over * (a0 * w0 + a01 * w1 + a02 * w2);
    const lanes8 t1 = over * (a01 * w0 + a1 * w1 + a12 * w2);
    const lanes8 t2 = over * (a02 * w0 + a12 * w1 + a2 * w2);
    triple p[3];
    p[0] = plus(scaled(s0, r[0]), plus(scaled(s01 + t2, r[1]), scaled(s02 - t1, r[2])));
    p[1] = plus(scaled(s01 - t2, r[0]), plus(scaled(s1, r[1]), scaled(s12 + t0, r[2])));
    p[2] = plus(scaled(s02 + t1, r[0]), plus(scaled(s12 - t0, r[1]), scaled(s2, r[2])));
    p[0] = plus(p[0], scaled(active, c[0]));
    for (int j = 0; j < 3; ++j) p[j] = scaled(-volume, p[j]);
{ADD_FORCES}"""


@wp.func_native(on_cpu(_FORCES))
def eight_anisotropic(
    elements: GeneralElements,
    material: OrthotropicMaterial,
    is_active: int,
    activation: wp.array[wp.float32],
    block: int,
    count: int,
    u: wp.array[wp.vec4],
    f: wp.array[wp.vec4],
    flagged: wp.array[wp.uint8],
): ...


@wp.kernel(module="unique", enable_backward=False, module_options={"cpu_compiler_flags": COMPILER_FLAGS})
def scatter_anisotropic_lanes(
    # In
    elements: GeneralElements,
    material: OrthotropicMaterial,
    is_active: int,
    activation: wp.array[wp.float32],
    count: int,
    u: wp.array[wp.vec4],
    # Out
    f: wp.array[wp.vec4],
    flagged: wp.array[wp.uint8],
):
    """Corotated forces of orthotropic elements and of their active stress; a thread is eight elements.

    ``elements`` have Dm^-1 M in place of their rest matrix' inverse.
    """
    eight_anisotropic(elements, material, is_active, activation, wp.tid(), count, u, f, flagged)


@wp.func
def turn_element(
    elements: Any,
    material: OrthotropicMaterial,
    t: int,
    rest_inverse: wp.array[wp.mat33],
    volume: wp.array[wp.float32],
):
    rest_inverse[t] = rest_inverse_of(elements, t, wp.transpose(frame(elements, t)) * axes_of(material, t))
    volume[t] = filled(material, t) * rest_volume(elements, t)


@functools.cache
def turn_elements(Elements: Any) -> wp.Kernel:
    """Elements of either kind as ``scatter_anisotropic_lanes`` wants them: Dm^-1 M, and the filled volume."""

    @wp.kernel(module="unique", enable_backward=False)
    def turn_elements(
        # In
        elements: Elements,
        material: OrthotropicMaterial,
        # Out
        rest_inverse: wp.array[wp.mat33],
        volume: wp.array[wp.float32],
    ):
        turn_element(elements, material, wp.tid(), rest_inverse, volume)

    return turn_elements


@wp.kernel(module="unique", enable_backward=False)
def turn_changed(
    # In
    threads: int,
    plan: Plan,
    elements: ForestElements,
    material: OrthotropicMaterial,
    # Out
    rest_inverse: wp.array[wp.mat33],
    volume: wp.array[wp.float32],
):
    """The same of leaves that have changed, and of what padding there is in their place."""
    for t in range(wp.tid(), extent(leaf_row(plan), plan), threads):
        turn_element(elements, material, t, rest_inverse, volume)


@functools.cache
def repair_anisotropic(Elements: Any) -> wp.Kernel:
    """Forces of flagged elements, in a way that is right for every F."""
    forces = element_forces(byers_xu)

    @wp.kernel(module="unique", enable_backward=False)
    def repair_anisotropic(
        # In
        flagged: wp.array[wp.uint8],
        elements: Elements,
        material: OrthotropicMaterial,
        is_active: int,
        activation: wp.array[wp.float32],
        u: wp.array[wp.vec4],
        # Out
        f: wp.array[wp.vec4],
    ):
        t = wp.tid()
        if flagged[t] != wp.uint8(0):
            forces(elements, material, is_active, activation, t, u, f)

    return repair_anisotropic
