"""Forces of complete subtrees on the CPU: eight subtrees side by side in the lanes of vector registers.

What a CPU core lacks is vectorisation. So the ten nodes of eight subtrees of one type are gathered into arrays of
lanes, one loop goes over the eight leaves, and forces are scattered once at the end. The laws are those of
``law_lanes``; leaves, or subtrees, that the corotated law leaves out are flagged by a bit each.

Native code generated from the tables of ``subtree``; see ``lanes`` for why.
"""

import functools

import warp as wp

from .elements import FRAME_SHIFT, LEVEL_MASK, MIRROR_BIT, Subtrees
from .lanes import COMPILER_FLAGS, PRELUDE, on_cpu
from .law_lanes import ROTATION, STRESSES, STRETCH
from .shapes import SQRT2, VOLUME
from .stiffness import Coefficients
from .subtree import FRAMES, HANDEDNESS, LEAVES, POSITIONS, stiffness

wp.set_module_options({"enable_backward": False})

# Displacements x of the ten nodes from the first, in edge lengths of a leaf, and the subtree's Maubach frame. Lanes
# past the last subtree repeat it.
_GATHER = f"""
    const int first_subtree = 8 * block, end = wp::min(8, count - first_subtree);
    const auto place = [&](int lane) {{ return wp::min(first_subtree + lane, count - 1); }};
    const auto code = [&](int lane) {{ return subtrees.code.data[place(lane)]; }};
    lanes8 x[30], g[30], axes[9], origin[4], corner[4];
    gather_matrix([&](int lane) {{ return subtrees.frames.data[code(lane) >> {FRAME_SHIFT}].data[0]; }}, axes);
    triple frame[3];
    for (int j = 0; j < 3; ++j) frame[j] = triple{{axes[j], axes[3 + j], axes[6 + j]}};
    static const float signs[2] = {{1.0f, -1.0f}};
    const lanes8 mirror = gather_one([&](int lane) {{ return signs + ((code(lane) >> {MIRROR_BIT}) & 1); }});
    const lanes8 h = 0.5f * gather_one([&](int lane) {{
        return &subtrees.size.data[(code(lane) & {int(LEVEL_MASK)}) / 3];
    }});
    const lanes8 inv_h = 1.0f / h;
    frame[2] = scaled(mirror, frame[2]);
    for (int k = 0; k < 10; ++k) {{
        gather([&](int lane) {{ return &u.data[subtrees.nodes.data[10 * place(lane) + k]][0]; }}, k ? corner : origin);
        for (int axis = 0; axis < 3; ++axis) {{
            x[3 * k + axis] = k ? (corner[axis] - origin[axis]) * inv_h : spread(0.0f);
            g[3 * k + axis] = spread(0.0f);
        }}
    }}
"""

# Add the forces, one subtree after the other.
_SCATTER = """
    four parts[8][10];
    for (int k = 0; k < 10; ++k) part(get(g, k), &parts[0][k], 10);
    for (int lane = 0; lane < end; ++lane) {
        const int* node = subtrees.nodes.data + 10 * (first_subtree + lane);
        for (int k = 0; k < 10; ++k) *reinterpret_cast<four*>(&f.data[node[k]][0]) += parts[lane][k];
    }
"""

# Flag what was left out.
_FLAG = """
    for (int lane = 0; lane < end; ++lane) flagged.data[first_subtree + lane] = static_cast<wp::uint8>(left_out[lane]);
"""

# Per-element material of one leaf of each of the eight subtrees.
_MATERIAL = """
        if (stride) {
            const auto element = [&](int lane) { return subtrees.first.data[place(lane)] + leaf; };
            m = gather_one([&](int lane) { return mu.data + element(lane); });
            k = gather_one([&](int lane) { return lam.data + element(lane); });
        }
"""


# The columns of R - I in the subtree's frame: of a rotation by less than a right angle from its axial vector, which has
# its digits however small it is, by Rodrigues' formula; and turn, the columns of R times the frame, of the same R.
_RELATIVE = """
    triple turned[3];
    {
        lanes8 r[3][3];
        for (int i = 0; i < 3; ++i) for (int j = 0; j < 3; ++j) r[i][j] = dot(frame[i], turn[j]);
        const lanes8 x_ = 0.5f * (r[2][1] - r[1][2]), y_ = 0.5f * (r[0][2] - r[2][0]), z_ = 0.5f * (r[1][0] - r[0][1]);
        const lanes8 cosine = 0.5f * (r[0][0] + r[1][1] + r[2][2] - 1.0f), w = 1.0f / (1.0f + cosine);
        const lanes8 xx_ = w * x_ * x_, yy_ = w * y_ * y_, zz_ = w * z_ * z_;
        const lanes8 xy_ = w * x_ * y_, xz_ = w * x_ * z_, yz_ = w * y_ * z_;
        const masks8 acute = cosine > 0.0f;
        turned[0].x = acute ? -yy_ - zz_ : r[0][0] - 1.0f;
        turned[0].y = acute ? xy_ + z_ : r[1][0];
        turned[0].z = acute ? xz_ - y_ : r[2][0];
        turned[1].x = acute ? xy_ - z_ : r[0][1];
        turned[1].y = acute ? -xx_ - zz_ : r[1][1] - 1.0f;
        turned[1].z = acute ? yz_ + x_ : r[2][1];
        turned[2].x = acute ? xz_ + y_ : r[0][2];
        turned[2].y = acute ? yz_ - x_ : r[1][2];
        turned[2].z = acute ? -xx_ - yy_ : r[2][2] - 1.0f;
        for (int j = 0; j < 3; ++j)
            turn[j] = plus(frame[j], combined(turned[j].x, frame[0], turned[j].y, frame[1], turned[j].z, frame[2]));
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
    """The columns of the displacement gradient from four nodes."""
    differences = {
        0: "minus(x1, x0), minus(x2, x1), minus(x3, x2)",
        1: "minus(x1, x0), minus(x2, x1), plus(minus(x3, x2), minus(x3, x0))",
        2: f"scaled(spread({SQRT2!r}f), minus(x0, x2)), scaled(spread({SQRT2!r}f), minus(x1, x2)), "
        "scaled(spread(2.0f), minus(x3, x2))",
    }
    return f"""
        const int* n = {nodes};
        const triple x0 = get(x, n[0]), x1 = get(x, n[1]), x2 = get(x, n[2]), x3 = get(x, n[3]);
        const triple a[3] = {{{differences[shape]}}};
"""


def _add_leaf(shape: int) -> str:
    """Add the forces on a leaf's nodes from the columns p of P V / h."""
    forces = {
        0: ["p[0]", "minus(p[1], p[0])", "minus(p[2], p[1])", "minus(nothing, p[2])"],
        1: ["plus(p[0], p[2])", "minus(p[1], p[0])", "minus(p[2], p[1])", "scaled(spread(-2.0f), p[2])"],
        2: [
            f"scaled(spread({-SQRT2!r}f), p[0])",
            f"scaled(spread({-SQRT2!r}f), p[1])",
            f"plus(scaled(spread({SQRT2!r}f), plus(p[0], p[1])), scaled(spread(2.0f), p[2]))",
            "scaled(spread(-2.0f), p[2])",
        ],
    }
    return "".join(f"        add(g, n[{i}], {force});\n" for i, force in enumerate(forces[shape]))


def _columns_of_frames(shape: int) -> tuple[list[tuple[float, ...]], list[list[int]]]:
    """The different columns that frames of leaves have in the subtree's, and which each leaf has."""
    rounded = [[tuple(round(c, 12) + 0.0 for c in column) for column in frame] for frame in FRAMES[shape]]
    different = sorted({column for frame in rounded for column in frame})
    return different, [[different.index(column) for column in frame] for frame in rounded]


def _frames(shape: int) -> str:
    """``leaf_axes``, of which three are the frame of each leaf, by ``axes_of``."""
    different, used = _columns_of_frames(shape)
    code = f"    triple leaf_axes[{len(different)}];\n"
    for i, column in enumerate(different):
        terms = [f"{weight!r}f * frame[{c}].%s" for c, weight in enumerate(column) if weight]
        code += (
            f"    leaf_axes[{i}] = triple{{{', '.join(' + '.join(terms).replace('%s', axis) for axis in 'xyz')}}};\n"
        )
    return _table("axes_of", "int", used) + code


def _law_snippet(shape: int, law: str) -> str:
    """Every leaf by itself."""
    flags = law == "corotated"
    if law == "linear":
        stress = """
        lanes8 e[6];
        for (int j = 0; j < 3; ++j) e[j] = dot(q[j], a[j]);
        e[3] = 0.5f * (dot(q[0], a[1]) + dot(q[1], a[0]));
        e[4] = 0.5f * (dot(q[0], a[2]) + dot(q[2], a[0]));
        e[5] = 0.5f * (dot(q[1], a[2]) + dot(q[2], a[1]));
        stress(q, e, mirror, m * area, k * area, p);
"""
    else:
        stress = f"""
        lanes8 e[6];
        stretching(a, q, e);
        const triple f_[3] = {{plus(q[0], a[0]), plus(q[1], a[1]), plus(q[2], a[2])}};
        {"const masks8 sound = " if flags else ""}stress(f_, e, hand[leaf][0] * mirror, m * area, k * area, p);
        {"left_out |= ~sound & (1 << leaf);" if flags else ""}
"""
    return on_cpu(
        f"""{_tables(shape)}{PRELUDE}{STRESSES[law]}{_GATHER}{_frames(shape)}
    const lanes8 area = {VOLUME[shape]!r}f * h * h;
    lanes8 m = spread(mu.data[0]), k = spread(lam.data[0]);
    masks8 left_out = {{}};
    #pragma clang loop unroll(disable)
    for (int leaf = 0; leaf < 8; ++leaf) {{{_MATERIAL}{_columns(shape, "nodes_of[leaf]")}
        const int* c = axes_of[leaf];
        const triple q[3] = {{leaf_axes[c[0]], leaf_axes[c[1]], leaf_axes[c[2]]}};
        triple p[3];{stress}{_add_leaf(shape)}    }}
{_SCATTER}{_FLAG if flags else ""}"""
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
    """All leaves with one rotation, the root's or a given one."""
    if given:
        rotation = """
    gather_matrix([&](int lane) { return rotations.data[unit.data[place(lane)]].data[0]; }, axes);
    const triple rotation[3] = {
        {axes[0], axes[3], axes[6]}, {axes[1], axes[4], axes[7]}, {axes[2], axes[5], axes[8]}};
    for (int j = 0; j < 3; ++j) {
        turn[j] = combined(frame[j].x, rotation[0], frame[j].y, rotation[1], frame[j].z, rotation[2]);
    }
"""
    else:
        rotation = f"""
    {{
        static const int corners[4] = {{0, 1, 2, 3}};{_columns(shape, "corners")}
        // The subtree's edge is two of a leaf's.
        triple half[3], f_[3];
        for (int j = 0; j < 3; ++j) half[j] = scaled(spread(0.5f), a[j]), f_[j] = plus(frame[j], half[j]);
        lanes8 e[6];
        stretching(half, frame, e);
        left_out = ~rotation_of(f_, e, mirror, turn) & 255;
    }}
"""
    return on_cpu(
        f"""{_tables(shape)}{PRELUDE}{STRETCH}{ROTATION}{_GATHER}
    triple turn[3];
    masks8 left_out = {{}};{rotation}{_RELATIVE}
    // Displacements in the subtree's Maubach frame, where the leaves are linear elements.
    for (int node = 0; node < 10; ++node) {{
        const triple d = get(x, node);
        for (int axis = 0; axis < 3; ++axis) {{
            x[3 * node + axis] = dot(turn[axis], d) + at[node][0] * turned[axis].x + at[node][1] * turned[axis].y
                + at[node][2] * turned[axis].z;
        }}
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
            e[i][0] = w[0] * a[0].x + w[1] * a[0].y + w[2] * a[0].z;
            e[i][1] = w[0] * a[1].x + w[1] * a[1].y + w[2] * a[1].z;
            e[i][2] = w[0] * a[2].x + w[1] * a[2].y + w[2] * a[2].z;
        }}
        m *= area; k *= area;
        const lanes8 pressure = k * (e[0][0] + e[1][1] + e[2][2]);
        const lanes8 xx = 2.0f * m * e[0][0] + pressure, yy = 2.0f * m * e[1][1] + pressure;
        const lanes8 zz = 2.0f * m * e[2][2] + pressure;
        const lanes8 xy = m * (e[0][1] + e[1][0]), xz = m * (e[0][2] + e[2][0]), yz = m * (e[1][2] + e[2][1]);
        const auto in_leaf = [&](const lanes8& s0, const lanes8& s1, const lanes8& s2) {{
            return triple{{b0[0] * s0 + b0[3] * s1 + b0[6] * s2, b0[1] * s0 + b0[4] * s1 + b0[7] * s2,
                b0[2] * s0 + b0[5] * s1 + b0[8] * s2}};
        }};
        const triple p[3] = {{in_leaf(xx, xy, xz), in_leaf(xy, yy, yz), in_leaf(xz, yz, zz)}};
{_add_leaf(shape)}    }}
    }}
    for (int node = 0; node < 10; ++node) {{
        const triple d = get(g, node);
        const triple force = chosen(left_out, nothing, combined(d.x, turn[0], d.y, turn[1], d.z, turn[2]));
        g[3 * node] = force.x; g[3 * node + 1] = force.y; g[3 * node + 2] = force.z;
    }}
{_SCATTER}{_FLAG}"""
    )


@functools.cache
def scatter_subtrees_own(shape: int) -> wp.Kernel:
    """Corotated forces of subtrees, every leaf with its own rotation; a thread is eight subtrees."""

    @wp.func_native(_law_snippet(shape, "corotated"))
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
def scatter_law_subtrees(shape: int, law: str) -> wp.Kernel:
    """Forces of subtrees under a law of ``law_lanes`` that needs no rotation; a thread is eight subtrees."""

    @wp.func_native(_law_snippet(shape, law))
    def eight_subtrees(
        subtrees: Subtrees,
        block: int,
        count: int,
        mu: wp.array[wp.float32],
        lam: wp.array[wp.float32],
        stride: int,
        u: wp.array[wp.vec4],
        f: wp.array[wp.vec4],
    ): ...

    @wp.kernel(module="unique", enable_backward=False, module_options={"cpu_compiler_flags": COMPILER_FLAGS})
    def scatter_law_subtrees(
        # In
        subtrees: Subtrees,
        mu: wp.array[wp.float32],
        lam: wp.array[wp.float32],
        stride: int,
        count: int,
        u: wp.array[wp.vec4],
        # Out
        f: wp.array[wp.vec4],
    ):
        eight_subtrees(subtrees, wp.tid(), count, mu, lam, stride, u, f)

    return scatter_law_subtrees


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
