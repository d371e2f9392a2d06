"""Corotated forces of tetrahedra one by one on the CPU, eight to the lanes of vector registers; see ``lanes``.

General tetrahedra, and those of a forest that are in no complete subtree, for which a rest matrix is worked out once.

An element that the unscaled iteration does not turn adds nothing and is flagged; ``repair_elements`` does those.
"""

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
from .lanes import COMPILER_FLAGS, NEWTON, PRELUDE, on_cpu
from .rotation import ITERATIONS, byers_xu

wp.set_module_options({"enable_backward": False})


def gather_elements(reads: str) -> str:
    """Fill the lanes with eight elements, the last one again where there are no more: displacements d of the last three
    nodes from the first, rest matrices b and volumes, and what ``reads`` reads of element t into ``lane``."""
    return f"""
    lanes8 d[9], b[9], volume;
    const int first_element = 8 * block;
    for (int lane = 0; lane < 8; ++lane) {{
        const int t = wp::min(first_element + lane, count - 1);
        const wp::vec_t<4, wp::int32> node = elements.nodes.data[t];
        const wp::vec_t<4, wp::float32> origin = u.data[node[0]];
        for (int n = 0; n < 3; ++n) {{
            const wp::vec_t<4, wp::float32>& a = u.data[node[n + 1]];
            for (int axis = 0; axis < 3; ++axis) d[3 * n + axis][lane] = a[axis] - origin[axis];
        }}
        {reads}
        const wp::mat_t<3, 3, wp::float32>& inverse = elements.rest_inverse.data[t];
        for (int i = 0; i < 9; ++i) b[i][lane] = inverse.data[i / 3][i % 3];
        volume[lane] = elements.volume.data[t];
    }}
    const triple d1 = get(d, 0), d2 = get(d, 1), d3 = get(d, 2);
"""


#: Adds the forces of eight elements from their stresses p times -V, columns, and flags those that are not ``trusted``.
ADD_FORCES = """
    lanes8 g[12];
    triple rest = triple{spread(0.0f), spread(0.0f), spread(0.0f)};
    for (int n = 1; n < 4; ++n) {
        const lanes8* row = b + 3 * (n - 1);
        const triple force = plus(scaled(row[0], p[0]), plus(scaled(row[1], p[1]), scaled(row[2], p[2])));
        g[3 * n] = force.x; g[3 * n + 1] = force.y; g[3 * n + 2] = force.z;
        rest = minus(rest, force);
    }
    g[0] = rest.x; g[1] = rest.y; g[2] = rest.z;
    const int end = wp::min(8, count - first_element);
    for (int lane = 0; lane < end; ++lane) {
        const int t = first_element + lane;
        flagged.data[t] = trusted[lane] ? 0 : 1;
        if (!trusted[lane]) continue;
        const wp::vec_t<4, wp::int32> node = elements.nodes.data[t];
        for (int n = 0; n < 4; ++n) {
            wp::vec_t<4, wp::float32>& sum = f.data[node[n]];
            for (int axis = 0; axis < 3; ++axis) sum[axis] += g[3 * n + axis][lane];
        }
    }
"""

_GATHER = gather_elements("m[lane] = mu.data[stride * t]; k[lane] = lam.data[stride * t];")

_FORCES = f"""{PRELUDE}{NEWTON}
    lanes8 m, k;
{_GATHER}
    // Columns of F = I + (d1 d2 d3) B.
    triple c[3], z[3];
    for (int j = 0; j < 3; ++j) c[j] = plus(scaled(b[j], d1), plus(scaled(b[3 + j], d2), scaled(b[6 + j], d3)));
    c[0].x += 1.0f; c[1].y += 1.0f; c[2].z += 1.0f;
    const masks8 trusted = newton(c[0], c[1], c[2], spread(1.0f), z);
    // With a rotation, R sym(R^T F) = F: P = 2 mu (F - R) + lambda tr(R^T F - I) R.
    const lanes8 trace = {0.5**ITERATIONS!r}f * (dot(z[0], c[0]) + dot(z[1], c[1]) + dot(z[2], c[2]));
    const lanes8 from_f = -2.0f * m * volume;
    const lanes8 from_z = (k * (trace - 3.0f) - 2.0f * m) * (-{0.5**ITERATIONS!r}f * volume);
    triple p[3];
    for (int j = 0; j < 3; ++j) p[j] = plus(scaled(from_f, c[j]), scaled(from_z, z[j]));
{ADD_FORCES}"""


@wp.func_native(on_cpu(_FORCES))
def eight_elements(
    elements: GeneralElements,
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
    flagged: wp.array[wp.uint8],
):
    """Corotated forces, each element with its own rotation; a thread is eight elements."""
    eight_elements(elements, wp.tid(), count, mu, lam, stride, u, f, flagged)


@wp.kernel(module="unique", enable_backward=False)
def repair_elements(
    # In
    flagged: wp.array[wp.uint8],
    elements: GeneralElements,
    mu: wp.array[wp.float32],
    lam: wp.array[wp.float32],
    stride: int,
    u: wp.array[wp.vec4],
    # Out
    f: wp.array[wp.vec4],
):
    """Forces of flagged elements with the rotation that is right for every F."""
    t = wp.tid()
    if flagged[t] == wp.uint8(0):
        return
    g = local_gradient(elements, t, u)
    q = frame(elements, t)
    r = byers_xu(q + g)
    scatter_stress(elements, t, r * hooke(corotated_strain(g, q, r), mu[t * stride], lam[t * stride]), f)


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
