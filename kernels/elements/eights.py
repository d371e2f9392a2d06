"""Eight elements, of a forest or general ones, in the lanes of vector registers: native code that gathers them as they
are, also where a mesh changes; see ``lanes``.

``native/gather_eights.h`` says what kernels find, and ``native/scatter_eights.h`` adds their forces.
"""

import functools
from collections.abc import Callable

from warp_corot.kernels.tables.shapes import FRAME_SHIFT, MIRROR_BIT, VOLUME, column_sums, force_sums

from .elements import LEVEL_MASK, ForestElements
from .lanes import constants, native


@functools.cache
def gathering(Elements: type) -> str:
    """Native code that gathers eight elements. In: units, block, count. Out: what ``native/forest_eights.h`` and
    ``native/general_eights.h`` define; ``columns``, the columns of a gradient from values at four nodes; ``forces_of``,
    the forces at the four nodes from the columns of a stress times ``weight``; and what ``native/gather_eights.h``
    defines.
    """
    if Elements is not ForestElements:
        return native("strain", "eights", "side_by_side", "rest_elements", "general_eights", "gather_eights")
    names = {"FRAME_SHIFT": FRAME_SHIFT, "MIRROR_BIT": MIRROR_BIT, "LEVEL_MASK": LEVEL_MASK}
    columns = [f"    a[{c}] = ({_by_type(column_sums, c)}) * inverse_h;\n" for c in range(3)]
    forces = [f"    force[{n}] = {_by_type(force_sums, n)};\n" for n in range(4)]
    volume = "is_type2 ? spread({2!r}f) : is_type1 ? spread({1!r}f) : spread({0!r}f)".format(*VOLUME)
    return (
        constants(**{name: int(value) for name, value in names.items()})
        + native("strain", "eights", "side_by_side", "forest_eights")
        + f"const lanes8 inverse_h = 1.0f / h, weight = h * h * ({volume});\n"
        + "const auto columns = [&](const triple* x, triple* a) {\n"
        + "    const triple &x0 = x[0], &x1 = x[1], &x2 = x[2], &x3 = x[3];\n"
        + f"{''.join(columns)}}};\n"
        + "const auto forces_of = [&](const triple* p, triple* force) {\n"
        + "    const triple &p0 = p[0], &p1 = p[1], &p2 = p[2];\n"
        + f"{''.join(forces)}}};\n"
        + native("gather_eights")
    )


def frames(Elements: type) -> str:
    """Native code that turns tensors from the elements' frames to the axes of rest space, and back."""
    return native("frames" if Elements is ForestElements else "no_frames")


def _by_type(sums: Callable[[int], list[str]], i: int) -> str:
    """The i-th of some expressions, for elements of any type."""
    of0, of1, of2 = (sums(shape)[i] for shape in range(3))
    others = of0 if of0 == of1 else f"chosen(is_type1, {of1}, {of0})"
    return f"chosen(is_type2, {of2}, {others})"
