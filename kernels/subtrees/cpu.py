"""Forces of complete subtrees on the CPU: eight subtrees side by side in the lanes of vector registers.

A CPU core is fast only with vector instructions. So the ten nodes of eight subtrees of one type are gathered into
arrays of lanes, a loop computes the eight leaves, and forces are scattered once at the end (``native/subtrees8.h``).
The laws are those of ``elements.simd8``. A bit flags each leaf or subtree that the corotated law leaves out.
"""

import functools
from collections.abc import Sequence

import warp as wp

from warp_corot.kernels.corotated.tangent import RotatedMaterial
from warp_corot.kernels.elements.constitutive import IsotropicMaterial
from warp_corot.kernels.elements.dilatation import Dilatation
from warp_corot.kernels.elements.elements import Subtrees
from warp_corot.kernels.elements.shapes import Coefficients
from warp_corot.kernels.elements.simd8 import STRESSLESS, IsotropicLaw, NativeLaw, elastic, headers, scatter_simd8
from warp_corot.kernels.tables.subtree import FRAMES, HANDEDNESS, LEAVES, POSITIONS, stiffness

# --- the tables of a type in C++, generated from those of ``tables.subtree`` ------------------------------------------


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


# --- kernels ---------------------------------------------------------------------------------------------------------


wp.set_module_options({"enable_backward": False})


@wp.struct
class ToleranceMaterial:
    """Lamé's parameters [Pa], and the tolerance within which leaves use the root's rotation [rad]."""

    isotropic: IsotropicMaterial
    tolerance: float


@wp.struct
class DilatingMaterial:
    """A material whose leaves share their dilatation; the tolerance is as in ``ToleranceMaterial``.

    ``lam`` [Pa] belongs to the shared dilatation; lambda is zero in ``isotropic``.
    """

    isotropic: IsotropicMaterial
    tolerance: float
    lam: wp.array[wp.float32]


#: The arguments of all traversals, and how laws with a shared dilatation begin.
_UNITS = "units, block, count"
_DILATING = "corot::dilating<corot::{}>({}, material.lam, material.isotropic.stride)"


@functools.cache
def scatter_subtrees(shape: int, Material: type, law: NativeLaw) -> wp.Kernel:
    """Forces of subtrees under a law, each leaf on its own; a thread is eight subtrees. Leaves left out are flagged."""
    kind = f"corot::Type, {int(law.leaves_out)}"
    call = f"corot::scatter_subtrees<{kind}>({law.code}, {_UNITS}, u, f, missed)"
    native = headers("subtrees8", law.header, types=subtree_type(shape))
    return scatter_simd8(call, Subtrees, Material, wp.uint8, native)


def scatter_law_subtrees(shape: int, law: IsotropicLaw = "corotated", shared: Dilatation | None = None) -> wp.Kernel:
    """The same under an isotropic law; with a shared dilatation the material is a ``DilatingMaterial``."""
    if shared is None:
        return scatter_subtrees(shape, IsotropicMaterial, elastic(law))
    inner = elastic(law, "material.isotropic")
    return scatter_subtrees(shape, DilatingMaterial, inner._replace(code=_DILATING.format(shared.lanes, inner.code)))


@functools.cache
def scatter_subtrees_shared(shape: int, given: bool) -> wp.Kernel:
    """Corotated forces of subtrees with their root's rotation or a given one; a thread is eight subtrees."""
    kind = f"corot::Type, {int(given)}"
    call = f"corot::scatter_subtrees_shared<{kind}>({_UNITS}, material, u, f, missed)"
    return scatter_simd8(call, Subtrees, RotatedMaterial, wp.uint8, headers("subtrees8", types=subtree_type(shape)))


@functools.cache
def scatter_subtrees_tolerance(shape: int, shared: Dilatation | None = None) -> wp.Kernel:
    """Corotated forces of subtrees, with the root's rotation where it is near those of the leaves; a thread is eight
    subtrees.

    It is near if the displacement gradient E that it leaves in each leaf has |skew E| <= tolerance [rad] and
    |sym E| <= 1/2, and the subtree as one element is strained by no more than 1/2. Then F = I + E = exp(w) U with
    |w| <= 2 tolerance, and the error of the stress is at most (2 mu + 3 lambda) (3 |w| |U - I| + |w|^2 |U|).
    Otherwise every leaf has its own rotation, and the forces are bit for bit those of ``scatter_law_subtrees``. With a
    shared dilatation the material is a ``DilatingMaterial``.
    """
    law, rest = (elastic(name, "material.isotropic").code for name in ("corotated", STRESSLESS))
    if shared is not None:
        law, rest = (_DILATING.format(shared.lanes, code) for code in (law, rest))
    kind = f"corot::Type, {int(shared is not None)}"
    material = "material.isotropic, material.tolerance"
    call = f"corot::scatter_subtrees_tolerance<{kind}>({law}, {rest}, {_UNITS}, {material}, u, f, missed)"
    Material, native = (
        ToleranceMaterial if shared is None else DilatingMaterial,
        headers("subtrees8", types=subtree_type(shape)),
    )
    return scatter_simd8(call, Subtrees, Material, wp.uint8, native)
