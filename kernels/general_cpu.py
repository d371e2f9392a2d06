"""Forces of tetrahedra one by one on the CPU, eight to the lanes of vector registers; see ``lanes``.

General tetrahedra, and those of a forest that are in no complete subtree, for which a rest matrix is worked out once.

An element of which the corotated law finds no rotation adds nothing and is put on a list, which ``repair_elements``
goes through.
"""

import functools
from typing import Any

import warp as wp

from .constitutive import corotated_strain, hooke
from .elements import (
    ForestElements,
    GeneralElements,
    frame,
    gradient_of,
    local_gradient,
    rest_volume,
    scatter_stress,
)
from .lanes import COMPILER_FLAGS, PRELUDE, on_cpu
from .law_lanes import STRESSES
from .rotation import byers_xu

wp.set_module_options({"enable_backward": False})


#: Eight elements in the lanes, the last one again where there are no more: displacements d1, d2, d3 of the last three
#: nodes from the first, rest matrices b and volumes.
GATHER = """
    const int first_element = 8 * block, end = wp::min(8, count - first_element);
    const auto element = [&](int lane) { return wp::min(first_element + lane, count - 1); };
    const auto node = [&](int lane, int n) { return &u.data[elements.nodes.data[element(lane)][n]][0]; };
    lanes8 b[9], corner[4][4];
    gather_matrix([&](int lane) { return elements.rest_inverse.data[element(lane)].data[0]; }, b);
    gather([&](int lane) { return node(lane, 0); }, corner[0]);
    gather([&](int lane) { return node(lane, 1); }, corner[1]);
    gather([&](int lane) { return node(lane, 2); }, corner[2]);
    gather([&](int lane) { return node(lane, 3); }, corner[3]);
    const triple d1 = minus(get(corner[1], 0), get(corner[0], 0)), d2 = minus(get(corner[2], 0), get(corner[0], 0));
    const triple d3 = minus(get(corner[3], 0), get(corner[0], 0));
    // Values of elements, side by side.
    const auto values_of = [&](const float* values) {
        return end == 8 ? *reinterpret_cast<const lanes8*>(values + first_element)
            : gather_one([&](int lane) { return values + element(lane); });
    };
    const lanes8 volume = values_of(elements.volume.data);
"""

#: Columns a of the displacement gradient (d1 d2 d3) B, and f of F = I + (d1 d2 d3) B.
GRADIENT = """
    triple a[3], f_[3];
    for (int j = 0; j < 3; ++j) f_[j] = a[j] = combined(b[j], d1, b[3 + j], d2, b[6 + j], d3);
    f_[0].x += 1.0f; f_[1].y += 1.0f; f_[2].z += 1.0f;
"""

#: Adds the forces of eight elements, one after the other, from their stresses p times -V, columns.
ADD_FORCES = """
    four parts[8][4];
    triple rest = nothing;
    for (int n = 1; n < 4; ++n) {
        const lanes8* row = b + 3 * (n - 1);
        const triple force = combined(row[0], p[0], row[1], p[1], row[2], p[2]);
        rest = minus(rest, force);
        part(force, &parts[0][n], 4);
    }
    part(rest, &parts[0][0], 4);
    for (int lane = 0; lane < end; ++lane) {
        const wp::vec_t<4, wp::int32>& to = elements.nodes.data[first_element + lane];
        for (int n = 0; n < 4; ++n) *reinterpret_cast<four*>(&f.data[to[n]][0]) += parts[lane][n];
    }
"""

#: Puts elements that are not ``sound`` on the list of those left out: how many, then which.
LEAVE_OUT = """
    if (any(~sound)) {
        for (int lane = 0; lane < end; ++lane) {
            if (!sound[lane]) left_out.data[++left_out.data[0]] = first_element + lane;
        }
    }
"""

#: mu and lambda, one for all or by element.
MATERIAL = """
    const lanes8 m = stride ? values_of(mu.data) : spread(mu.data[0]);
    const lanes8 k = stride ? values_of(lam.data) : spread(lam.data[0]);
"""


def _forces(law: str) -> str:
    leaves_out = law == "corotated"
    if law == "linear":
        strain = """
    const lanes8 e[6] = {a[0].x, a[1].y, a[2].z,
        0.5f * (a[0].y + a[1].x), 0.5f * (a[0].z + a[2].x), 0.5f * (a[1].z + a[2].y)};
    f_[0] = f_[1] = f_[2] = nothing;
    f_[0].x = f_[1].y = f_[2].z = spread(1.0f);
"""
    else:
        strain = """
    lanes8 e[6];
    stretching_there(a, e);
"""
    return on_cpu(f"""{PRELUDE}{STRESSES[law]}
{GATHER}{MATERIAL}{GRADIENT}{strain}
    triple p[3];
    {"const masks8 sound = " if leaves_out else ""}stress(f_, e, spread(1.0f), -volume * m, -volume * k, p);
{ADD_FORCES}{LEAVE_OUT if leaves_out else ""}""")


@wp.func_native(_forces("corotated"))
def eight_elements(
    elements: GeneralElements,
    block: int,
    count: int,
    mu: wp.array[wp.float32],
    lam: wp.array[wp.float32],
    stride: int,
    u: wp.array[wp.vec4],
    f: wp.array[wp.vec4],
    left_out: wp.array[wp.int32],
): ...


@wp.kernel(module="unique", enable_backward=False, module_options={"cpu_compiler_flags": COMPILER_FLAGS})
def scatter_elements(
    # In
    elements: GeneralElements,
    mu: wp.array[wp.float32],
    lam: wp.array[wp.float32],
    stride: int,
    count: int,
    u: wp.array[wp.vec4],
    # Out
    f: wp.array[wp.vec4],
    left_out: wp.array[wp.int32],
):
    """Corotated forces, each element with its own rotation; a thread is eight elements."""
    eight_elements(elements, wp.tid(), count, mu, lam, stride, u, f, left_out)


@functools.cache
def scatter_law_elements(law: str) -> wp.Kernel:
    """Forces of a law of ``law_lanes`` that needs no rotation; a thread is eight elements."""

    @wp.func_native(_forces(law))
    def eight_elements(
        elements: GeneralElements,
        block: int,
        count: int,
        mu: wp.array[wp.float32],
        lam: wp.array[wp.float32],
        stride: int,
        u: wp.array[wp.vec4],
        f: wp.array[wp.vec4],
    ): ...

    @wp.kernel(module="unique", enable_backward=False, module_options={"cpu_compiler_flags": COMPILER_FLAGS})
    def scatter_law_elements(
        # In
        elements: GeneralElements,
        mu: wp.array[wp.float32],
        lam: wp.array[wp.float32],
        stride: int,
        count: int,
        u: wp.array[wp.vec4],
        # Out
        f: wp.array[wp.vec4],
    ):
        eight_elements(elements, wp.tid(), count, mu, lam, stride, u, f)

    return scatter_law_elements


@wp.kernel(module="unique", enable_backward=False)
def repair_elements(
    # In
    elements: GeneralElements,
    mu: wp.array[wp.float32],
    lam: wp.array[wp.float32],
    stride: int,
    u: wp.array[wp.vec4],
    # In and out
    left_out: wp.array[wp.int32],
    # Out
    f: wp.array[wp.vec4],
):
    """Forces of the elements on the list, with the rotation that is right for every F, by one thread; empties it."""
    for i in range(left_out[0]):
        t = left_out[i + 1]
        g = local_gradient(elements, t, u)
        q = frame(elements, t)
        r = byers_xu(q + g)
        scatter_stress(elements, t, r * hooke(corotated_strain(g, q, r), mu[t * stride], lam[t * stride]), f)
    left_out[0] = 0


@wp.func
def rest_inverse_of(elements: Any, t: int, turn: wp.mat33):
    """B [3, 3] with G turn = (d1 d2 d3) B, where d are the displacements of the last three nodes from the first."""
    # Linear in them: they enter by their rows, one at a time.
    o = wp.vec3(0.0, 0.0, 0.0)
    x = wp.vec3(1.0, 0.0, 0.0)
    rows = wp.mat33()
    rows[0] = (gradient_of(elements, t, o, x, o, o) * turn)[0]
    rows[1] = (gradient_of(elements, t, o, o, x, o) * turn)[0]
    rows[2] = (gradient_of(elements, t, o, o, o, x) * turn)[0]
    return rows


@wp.kernel(enable_backward=False)
def rest_matrices(
    # In
    elements: ForestElements,
    # Out
    rest_inverse: wp.array[wp.mat33],
    volume: wp.array[wp.float32],
):
    """What general elements keep, of elements of a forest."""
    t = wp.tid()
    rest_inverse[t] = rest_inverse_of(elements, t, wp.transpose(frame(elements, t)))
    volume[t] = rest_volume(elements, t)
