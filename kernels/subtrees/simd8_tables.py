"""The tables of complete subtrees for ``native/subtrees8.h``, generated from those of ``tables.subtree``.

This file does not use Warp.
"""

import functools
from collections.abc import Sequence

from warp_corot.kernels.elements.stiffness import Coefficients
from warp_corot.kernels.tables.subtree import FRAMES, HANDEDNESS, LEAVES, POSITIONS, stiffness


@functools.cache
def subtree_type(shape: int) -> str:
    """``corot::Type``: the tables of a type in C++, and the product with the stiffness of a whole subtree."""
    columns, used = _columns_of_frames(shape)
    tables = (
        f"static constexpr int SHAPE = {shape}, AXES_COUNT = {len(columns)};\n"
        + _table("NODES", "int", LEAVES[shape])
        + _table("AT", "float", [[2.0 * c for c in point] for point in POSITIONS[shape]])
        + _table("HAND", "float", HANDEDNESS[shape])
        + _table("FRAME", "float", FRAMES[shape])
        + _table("AXES", "float", columns)
        + _table("AXES_OF", "int", used)
    )
    return f"namespace corot {{\nstruct Type {{\n{tables}{_product(shape)}}};\n}}\n"


def _product(shape: int) -> str:
    """g = w K y with the stiffness of a whole subtree, straight-line code without its zeros."""
    entries = Coefficients(*stiffness(shape))
    code = "".join(f"const float c{k} = {a!r}f * lam + {b!r}f * mu;\n" for k, (a, b) in enumerate(entries.distinct))
    for i, (places, signs) in enumerate(zip(entries.table, entries.signs, strict=True)):
        terms = [f"{'+' if signs[j] > 0 else '-'} c{k} * {_entry('y', j)}" for j, k in enumerate(places) if k >= 0]
        code += f"{_entry('g', i)} = w * ({' '.join(terms)});\n"
    vectors = "const triple<lanes8>* y, const lanes8& w, float lam, float mu, triple<lanes8>* g"
    return f"static COROT_INLINE void multiply({vectors}) {{\n{code}}}\n"


def _entry(vectors: str, i: int) -> str:
    return f"{vectors}[{i // 3}].{'xyz'[i % 3]}"


def _table(name: str, kind: str, rows: Sequence) -> str:
    sizes, inner = "", rows
    while isinstance(inner, Sequence):
        sizes, inner = f"{sizes}[{len(inner)}]", inner[0]
    return f"static constexpr {kind} {name}{sizes} = {_braces(rows, 'f' if kind == 'float' else '')};\n"


def _braces(rows: Sequence | float, suffix: str) -> str:
    if not isinstance(rows, Sequence):
        return f"{rows!r}{suffix}"
    return "{" + ", ".join(_braces(row, suffix) for row in rows) + "}"


def _columns_of_frames(shape: int) -> tuple[list[tuple[float, ...]], list[list[int]]]:
    """The different columns of the leaves' frames, in the subtree's frame, and which three each leaf has."""
    rounded = [[tuple(round(c, 12) + 0.0 for c in column) for column in frame] for frame in FRAMES[shape]]
    different = sorted({column for frame in rounded for column in frame})
    return different, [[different.index(column) for column in frame] for frame in rounded]
