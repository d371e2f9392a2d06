"""Native code for eight subtrees of one type in vector lanes, generated from the tables of ``tables.subtree``.

The code is text, like that in ``native`` around it; this file does not use Warp.
"""

import functools

from warp_corot.kernels.elements.elements import FRAME_SHIFT, LEVEL_MASK, MIRROR_BIT
from warp_corot.kernels.elements.lanes import constants, native
from warp_corot.kernels.elements.stiffness import Coefficients
from warp_corot.kernels.tables.shapes import VOLUME, column_sums, force_sums
from warp_corot.kernels.tables.subtree import FRAMES, HANDEDNESS, LEAVES, POSITIONS, stiffness


@functools.cache
def begin(shape: int) -> str:
    """Code that reads eight subtrees of a type, with the tables of this type.

    It defines

    - what ``native/subtrees.h`` defines;
    - the tables ``nodes_of`` (nodes of each leaf) and, in the subtree's Maubach frame, ``at`` (rest positions of the
      nodes), ``frame_of`` (the leaves' frames) and ``hand`` (their handedness);
    - ``leaf_axes``, the different columns of the leaves' frames; ``axes_of`` says which three make the frame of a leaf;
    - the functions ``columns`` and ``add_leaf``, which take ten displacements or forces and the numbers of four of
      them.
    """
    columns = "".join(f" a[{c}] = {expression};" for c, expression in enumerate(column_sums(shape)))
    forces = "".join(f" add(g, n[{n}], {expression});" for n, expression in enumerate(force_sums(shape)))
    functions = f"""
const auto columns = [&](const lanes8* x, const int* n, triple* a) {{
    const triple x0 = get(x, n[0]), x1 = get(x, n[1]), x2 = get(x, n[2]), x3 = get(x, n[3]);
   {columns}
}};
const auto add_leaf = [&](lanes8* g, const int* n, const triple* p) {{
    const triple &p0 = p[0], &p1 = p[1], &p2 = p[2];
   {forces}
}};
"""
    names = {"FRAME_SHIFT": FRAME_SHIFT, "MIRROR_BIT": MIRROR_BIT, "LEVEL_MASK": LEVEL_MASK}
    numbers = constants(VOLUME=VOLUME[shape], **{name: int(value) for name, value in names.items()})
    return numbers + _tables(shape) + functions + native("subtrees") + _frames(shape)


@functools.cache
def product(shape: int) -> str:
    """``multiply``: g = -h^2 K y with the stiffness of a whole subtree, straight-line code without its zeros."""
    entries = Coefficients(*stiffness(shape))
    values = "".join(
        f"    const float c{k} = {a!r}f * isotropic.lam.data[0] + {b!r}f * isotropic.mu.data[0];\n"
        for k, (a, b) in enumerate(entries.distinct)
    )
    rows = ""
    for i, (places, signs) in enumerate(zip(entries.table, entries.signs, strict=True)):
        terms = " ".join(f"{'+' if signs[j] > 0 else '-'} c{k} * y[{j}]" for j, k in enumerate(places) if k >= 0)
        rows += f"    g[{i}] = w * ({terms});\n"
    # K is over the subtree's edge, two of a leaf's.
    return (
        "const auto multiply = [&](const lanes8* y, lanes8* g) {\n"
        f"{values}    const lanes8 w = -2.0f * h * h;\n{rows}}};\n"
    )


@functools.cache
def near_test(shape: int) -> str:
    """``are_near``: whether |skew E| <= tolerance and |sym E| <= 1/2 in every leaf, for displacements y turned back.

    E is C B^T, with the matrix C that ``columns`` finds and the leaf's frame B.
    """
    code = ""
    for nodes, frame in zip(LEAVES[shape], FRAMES[shape], strict=True):

        def difference(i: int, j: int, frame: list = frame) -> str:
            """The difference of the entries i, j and j, i of C B^T."""
            terms = [(frame[c][j], f"a[{c}].{'xyz'[i]}") for c in range(3)]
            terms += [(-frame[c][i], f"a[{c}].{'xyz'[j]}") for c in range(3)]
            return " + ".join(f"{weight!r}f * {entry}" for weight, entry in terms if abs(weight) > 1e-9)

        code += f"""
    {{
        static const int n[4] = {{{", ".join(map(str, nodes))}}};
        triple a[3];
        columns(y, n, a);
        const triple twice = {{{difference(2, 1)}, {difference(0, 2)}, {difference(1, 0)}}};
        const lanes8 skew = 0.5f * dot(twice, twice);
        const lanes8 whole = dot(a[0], a[0]) + dot(a[1], a[1]) + dot(a[2], a[2]);
        near &= (skew <= bound) & (whole - skew <= 0.25f);
    }}"""
    return f"""const auto are_near = [&](const lanes8* y) {{
    const lanes8 bound = spread(material.tolerance * material.tolerance);
    masks8 near = every;{code}
    return near;
}};
"""


def _table(name: str, kind: str, rows: list) -> str:
    inner = ", ".join("{" + ", ".join(f"{v!r}f" if kind == "float" else str(v) for v in row) + "}" for row in rows)
    return f"static const {kind} {name}[{len(rows)}][{len(rows[0])}] = {{{inner}}};\n"


def _tables(shape: int) -> str:
    return (
        _table("nodes_of", "int", [list(leaf) for leaf in LEAVES[shape]])
        + _table("at", "float", [[2.0 * c for c in point] for point in POSITIONS[shape]])
        + _table("hand", "float", [[h] for h in HANDEDNESS[shape]])
        + _table("frame_of", "float", [[c for column in frame for c in column] for frame in FRAMES[shape]])
    )


def _columns_of_frames(shape: int) -> tuple[list[tuple[float, ...]], list[list[int]]]:
    """The different columns of the leaves' frames, in the subtree's frame, and which three each leaf has."""
    rounded = [[tuple(round(c, 12) + 0.0 for c in column) for column in frame] for frame in FRAMES[shape]]
    different = sorted({column for frame in rounded for column in frame})
    return different, [[different.index(column) for column in frame] for frame in rounded]


def _frames(shape: int) -> str:
    different, used = _columns_of_frames(shape)
    code = f"triple leaf_axes[{len(different)}];\n"
    for i, column in enumerate(different):
        terms = [f"{weight!r}f * frame[{c}].%s" for c, weight in enumerate(column) if weight]
        code += f"leaf_axes[{i}] = triple{{{', '.join(' + '.join(terms).replace('%s', axis) for axis in 'xyz')}}};\n"
    return _table("axes_of", "int", used) + code
