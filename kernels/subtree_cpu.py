"""Corotated forces of complete subtrees on the CPU: eight subtrees side by side in the lanes of vector registers.

What a CPU core lacks is vectorisation. So the ten nodes of eight subtrees of one type are gathered into arrays of
lanes, one loop goes over the eight leaves, and forces are scattered once at the end. The iteration is
``rotation.newton_rotation``, the units and the flags are those of ``subtree_cuda``.

Native code generated from the tables of ``subtree``; see ``lanes`` for why.
"""

import functools

import warp as wp

from .elements import FRAME_SHIFT, LEVEL_MASK, MIRROR_BIT, Subtrees
from .lanes import COMPILER_FLAGS, NEWTON, PRELUDE, on_cpu
from .rotation import ITERATIONS
from .shapes import SQRT2, VOLUME
from .stiffness import Coefficients
from .subtree import FRAMES, HANDEDNESS, LEAVES, POSITIONS, stiffness

wp.set_module_options({"enable_backward": False})

# Positions of the ten nodes relative to the first's displacement, in edge lengths of a leaf. Lanes past the last
# subtree repeat it.
_GATHER = f"""
    lanes8 x[30], g[30], frame[9], h, inv_h, mirror;
    const int first_subtree = 8 * block;
    for (int lane = 0; lane < 8; ++lane) {{
        const int s = wp::min(first_subtree + lane, count - 1);
        const int code = subtrees.code.data[s];
        const float edge = 0.5f * subtrees.size.data[(code & {int(LEVEL_MASK)}) / 3];
        const float sign = (code >> {MIRROR_BIT}) & 1 ? -1.0f : 1.0f;
        const float inv_edge = 1.0f / edge;
        const wp::mat_t<3, 3, wp::float32>& q = subtrees.frames.data[code >> {FRAME_SHIFT}];
        h[lane] = edge; inv_h[lane] = inv_edge; mirror[lane] = sign;
        for (int axis = 0; axis < 3; ++axis) {{
            frame[3 * axis][lane] = q.data[axis][0];
            frame[3 * axis + 1][lane] = q.data[axis][1];
            frame[3 * axis + 2][lane] = q.data[axis][2] * sign;
        }}
        const int* node = subtrees.nodes.data + 10 * s;
        const wp::vec_t<4, wp::float32> origin = u.data[node[0]];
        for (int k = 0; k < 10; ++k) {{
            const wp::vec_t<4, wp::float32>& a = u.data[node[k]];
            for (int axis = 0; axis < 3; ++axis) x[3 * k + axis][lane] = a[axis] - origin[axis];
        }}
    }}
    for (int k = 0; k < 10; ++k) {{
        for (int axis = 0; axis < 3; ++axis) {{
            const lanes8 rest = at[k][0] * frame[3 * axis] + at[k][1] * frame[3 * axis + 1]
                + at[k][2] * frame[3 * axis + 2];
            x[3 * k + axis] = x[3 * k + axis] * inv_h + rest;
            g[3 * k + axis] = spread(0.0f);
        }}
    }}
    masks8 trusted = h > 0.0f;
"""

# Add the forces of the subtrees that are to be trusted and flag the others.
_SCATTER = """
    const int end = wp::min(8, count - first_subtree);
    for (int lane = 0; lane < end; ++lane) {
        const int s = first_subtree + lane;
        flagged.data[s] = trusted[lane] ? 0 : 255;
        if (!trusted[lane]) continue;
        const int* node = subtrees.nodes.data + 10 * s;
        for (int k = 0; k < 10; ++k) {
            wp::vec_t<4, wp::float32>& sum = f.data[node[k]];
            for (int axis = 0; axis < 3; ++axis) sum[axis] += g[3 * k + axis][lane];
        }
    }
"""

# Per-element material of one leaf of each of the eight subtrees.
_MATERIAL = """
        if (stride) {
            for (int lane = 0; lane < 8; ++lane) {
                const int t = subtrees.first.data[wp::min(first_subtree + lane, count - 1)] + leaf;
                m[lane] = mu.data[t]; k[lane] = lam.data[t];
            }
        }
"""


def _table(name: str, kind: str, rows: list) -> str:
    inner = ", ".join("{" + ", ".join(f"{v!r}f" if kind == "float" else str(v) for v in row) + "}" for row in rows)
    return f"    static const {kind} {name}[{len(rows)}][{len(rows[0])}] = {{{inner}}};\n"


def _tables(shape: int) -> str:
    return (
        _table("nodes_of", "int", [list(leaf) for leaf in LEAVES[shape]])
        + _table("at", "float", [[2.0 * c for c in point] for point in POSITIONS[shape]])
        + _table("hand", "float", [[h] for h in HANDEDNESS[shape]])
        + _table("frame_of", "float", [[c for column in frame for c in column] for frame in FRAMES[shape]])
    )


def _columns(shape: int, nodes: str) -> str:
    """The columns of F from four nodes."""
    differences = {
        0: "minus(x1, x0), b = minus(x2, x1), c = minus(x3, x2)",
        1: "minus(x1, x0), b = minus(x2, x1), c = plus(minus(x3, x2), minus(x3, x0))",
        2: f"scaled(spread({SQRT2!r}f), minus(x0, x2)), b = scaled(spread({SQRT2!r}f), minus(x1, x2)), "
        "c = scaled(spread(2.0f), minus(x3, x2))",
    }
    return f"""
        const int* n = {nodes};
        const triple x0 = get(x, n[0]), x1 = get(x, n[1]), x2 = get(x, n[2]), x3 = get(x, n[3]);
        const triple a = {differences[shape]};
"""


def _add_leaf(shape: int) -> str:
    """Add the forces on a leaf's nodes from the columns p, q, r of P V / h."""
    zero = "triple{spread(0.0f), spread(0.0f), spread(0.0f)}"
    forces = {
        0: ["p", "minus(q, p)", "minus(r, q)", f"minus({zero}, r)"],
        1: ["plus(p, r)", "minus(q, p)", "minus(r, q)", "scaled(spread(-2.0f), r)"],
        2: [
            f"scaled(spread({-SQRT2!r}f), p)",
            f"scaled(spread({-SQRT2!r}f), q)",
            f"plus(scaled(spread({SQRT2!r}f), plus(p, q)), scaled(spread(2.0f), r))",
            "scaled(spread(-2.0f), r)",
        ],
    }
    return "".join(f"        add(g, n[{i}], {force});\n" for i, force in enumerate(forces[shape]))


def _own_snippet(shape: int) -> str:
    inverse = 0.5**ITERATIONS
    return on_cpu(
        f"""{_tables(shape)}{PRELUDE}{_GATHER}{NEWTON}
    const lanes8 area = {VOLUME[shape]!r}f * h * h;
    lanes8 m = spread(mu.data[0]), k = spread(lam.data[0]);
    #pragma clang loop unroll(disable)
    for (int leaf = 0; leaf < 8; ++leaf) {{{_MATERIAL}{_columns(shape, "nodes_of[leaf]")}
        triple z[3];
        trusted &= newton(a, b, c, hand[leaf][0] * mirror, z);
        // With a rotation, R sym(R^T F) = F: P = 2 mu (F - R) + lambda tr(R^T F - I) R.
        const lanes8 trace = {inverse!r}f * (dot(z[0], a) + dot(z[1], b) + dot(z[2], c));
        const lanes8 from_f = 2.0f * m * area;
        const lanes8 from_z = (k * (trace - 3.0f) - 2.0f * m) * ({inverse!r}f * area);
        const triple p = plus(scaled(from_f, a), scaled(from_z, z[0]));
        const triple q = plus(scaled(from_f, b), scaled(from_z, z[1]));
        const triple r = plus(scaled(from_f, c), scaled(from_z, z[2]));
{_add_leaf(shape)}    }}
{_SCATTER}"""
    )


def _product(shape: int) -> str:
    """g -= h^2 K d with the stiffness of a whole subtree, straight-line code without its zeros."""
    entries = Coefficients(*stiffness(shape))
    values = "".join(
        f"        const float c{k} = {a!r}f * lam.data[0] + {b!r}f * mu.data[0];\n"
        for k, (a, b) in enumerate(entries.distinct)
    )
    rows = ""
    for i, (places, signs) in enumerate(zip(entries.table, entries.signs, strict=True)):
        terms = " ".join(f"{'+' if signs[j] > 0 else '-'} c{k} * x[{j}]" for j, k in enumerate(places) if k >= 0)
        rows += f"        g[{i}] = w * ({terms});\n"
    # K is over the subtree's edge, two of a leaf's.
    return f"{values}        const lanes8 w = -2.0f * h * h;\n{rows}"


def _shared_snippet(shape: int, given: bool) -> str:
    if given:
        rotation = f"""
    for (int lane = 0; lane < 8; ++lane) {{
        const int s = wp::min(first_subtree + lane, count - 1);
        const wp::mat_t<3, 3, wp::float32> r =
            wp::mul(rotations.data[unit.data[s]], subtrees.frames.data[subtrees.code.data[s] >> {FRAME_SHIFT}]);
        for (int column = 0; column < 3; ++column) {{
            const float sign = column == 2 ? mirror[lane] : 1.0f;
            turn[column].x[lane] = r.data[0][column] * sign;
            turn[column].y[lane] = r.data[1][column] * sign;
            turn[column].z[lane] = r.data[2][column] * sign;
        }}
    }}
"""
    else:
        rotation = f"""
    {{
        static const int corners[4] = {{0, 1, 2, 3}};{_columns(shape, "corners")}
        // The subtree's edge is two of a leaf's.
        trusted = newton(scaled(spread(0.5f), a), scaled(spread(0.5f), b), scaled(spread(0.5f), c), mirror, turn);
        for (int column = 0; column < 3; ++column) turn[column] = scaled(spread({0.5**ITERATIONS!r}f), turn[column]);
    }}
"""
    return on_cpu(
        f"""{_tables(shape)}{PRELUDE}{_GATHER}{NEWTON}
    triple turn[3];{rotation}
    // Displacements in the subtree's Maubach frame, where the leaves are linear elements.
    for (int node = 0; node < 10; ++node) {{
        const triple d = get(x, node);
        for (int axis = 0; axis < 3; ++axis) x[3 * node + axis] = dot(turn[axis], d) - at[node][axis];
    }}
    if (!stride) {{
{_product(shape)}    }} else {{
    const lanes8 area = {VOLUME[shape]!r}f * h * h;
    lanes8 m, k;
    #pragma clang loop unroll(disable)
    for (int leaf = 0; leaf < 8; ++leaf) {{{_MATERIAL}{_columns(shape, "nodes_of[leaf]")}
        // E = B^T C in the leaf's frame B, then P = B sigma.
        const float* b0 = frame_of[leaf];
        lanes8 e[3][3];
        for (int i = 0; i < 3; ++i) {{
            const float* w = b0 + 3 * i;
            e[i][0] = w[0] * a.x + w[1] * a.y + w[2] * a.z;
            e[i][1] = w[0] * b.x + w[1] * b.y + w[2] * b.z;
            e[i][2] = w[0] * c.x + w[1] * c.y + w[2] * c.z;
        }}
        m *= area; k *= area;
        const lanes8 pressure = k * (e[0][0] + e[1][1] + e[2][2]);
        const lanes8 xx = 2.0f * m * e[0][0] + pressure, yy = 2.0f * m * e[1][1] + pressure;
        const lanes8 zz = 2.0f * m * e[2][2] + pressure;
        const lanes8 xy = m * (e[0][1] + e[1][0]), xz = m * (e[0][2] + e[2][0]), yz = m * (e[1][2] + e[2][1]);
        const auto turned = [&](const lanes8& s0, const lanes8& s1, const lanes8& s2) {{
            return triple{{b0[0] * s0 + b0[3] * s1 + b0[6] * s2, b0[1] * s0 + b0[4] * s1 + b0[7] * s2,
                b0[2] * s0 + b0[5] * s1 + b0[8] * s2}};
        }};
        const triple p = turned(xx, xy, xz), q = turned(xy, yy, yz), r = turned(xz, yz, zz);
{_add_leaf(shape)}    }}
    }}
    for (int node = 0; node < 10; ++node) {{
        const triple d = get(g, node);
        g[3 * node] = turn[0].x * d.x + turn[1].x * d.y + turn[2].x * d.z;
        g[3 * node + 1] = turn[0].y * d.x + turn[1].y * d.y + turn[2].y * d.z;
        g[3 * node + 2] = turn[0].z * d.x + turn[1].z * d.y + turn[2].z * d.z;
    }}
{_SCATTER}"""
    )


@functools.cache
def scatter_subtrees_own(shape: int) -> wp.Kernel:
    """Corotated forces of subtrees, every leaf with its own rotation; a thread is eight subtrees."""

    @wp.func_native(_own_snippet(shape))
    def eight_subtrees(
        subtrees: Subtrees,
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
    def scatter_subtrees_own(
        # In
        subtrees: Subtrees,
        count: int,
        mu: wp.array[wp.float32],
        lam: wp.array[wp.float32],
        stride: int,
        u: wp.array[wp.vec4],
        # Out
        f: wp.array[wp.vec4],
        flagged: wp.array[wp.uint8],
    ):
        eight_subtrees(subtrees, wp.tid(), count, mu, lam, stride, u, f, flagged)

    return scatter_subtrees_own


@functools.cache
def scatter_subtrees_shared(shape: int, given: bool) -> wp.Kernel:
    """Corotated forces of subtrees with their root's rotation or a given one; a thread is eight subtrees."""

    @wp.func_native(_shared_snippet(shape, given))
    def eight_subtrees(
        subtrees: Subtrees,
        block: int,
        count: int,
        mu: wp.array[wp.float32],
        lam: wp.array[wp.float32],
        stride: int,
        u: wp.array[wp.vec4],
        rotations: wp.array[wp.mat33],
        unit: wp.array[wp.int32],
        f: wp.array[wp.vec4],
        flagged: wp.array[wp.uint8],
    ): ...

    @wp.kernel(module="unique", enable_backward=False, module_options={"cpu_compiler_flags": COMPILER_FLAGS})
    def scatter_subtrees_shared(
        # In
        subtrees: Subtrees,
        count: int,
        mu: wp.array[wp.float32],
        lam: wp.array[wp.float32],
        stride: int,
        u: wp.array[wp.vec4],
        rotations: wp.array[wp.mat33],
        unit: wp.array[wp.int32],
        # Out
        f: wp.array[wp.vec4],
        flagged: wp.array[wp.uint8],
    ):
        eight_subtrees(subtrees, wp.tid(), count, mu, lam, stride, u, rotations, unit, f, flagged)

    return scatter_subtrees_shared
