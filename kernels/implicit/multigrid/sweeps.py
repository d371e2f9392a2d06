"""Smoothing on the CPU: block Gauss-Seidel sweeps over a level's rows, one thread for each world.

A forward sweep from zero reads the lower half of the matrix, and its residual needs only the upper half. So one sweep
before the coarser level and its mirror image after it cost as much as two products, and smooth as well as Chebyshev's
iteration of degree 2, which costs four.
"""

import warp as wp

from warp_corot.kernels.elements.simd8 import on_cpu

from .cycle import Rows

wp.set_module_options({"enable_backward": False})

#: Shared code: the sum of a range of a row's blocks times x, and the product of an inverse and a vector.
_ROWS = """
    const int* starts = rows.starts.data;
    const int* columns = rows.columns.data;
    const float* blocks = &rows.blocks.data[(long long)world * entries].data[0][0];
    const float* inverse = &inverses.data[(long long)world * count].data[0][0];
    const four* right = reinterpret_cast<const four*>(r.data) + (long long)world * count;
    four* x = reinterpret_cast<four*>(z.data) + (long long)world * count;
    four* rest = reinterpret_cast<four*>(other.data) + (long long)world * count;
    // Blocks are transposed; of the last column a number past its end is read.
    const auto product = [&](int begin, int end) {
        four a = {0.0f, 0.0f, 0.0f, 0.0f}, b = a, c = a;
        const float* m = blocks + 9ll * begin;
        for (int p = begin; p < end; ++p, m += 9) {
            const four v = x[columns[p]];
            a += *reinterpret_cast<const four*>(m) * v[0];
            b += *reinterpret_cast<const four*>(m + 3) * v[1];
            c += *reinterpret_cast<const four*>(m + 6) * v[2];
        }
        a += b + c;
        return four{a[0], a[1], a[2], 0.0f};
    };
    const auto solved = [&](int i, const four& v) {
        const float* m = inverse + 9ll * i;
        const four a = {m[0], m[3], m[6], 0.0f}, b = {m[1], m[4], m[7], 0.0f}, c = {m[2], m[5], m[8], 0.0f};
        return a * v[0] + b * v[1] + c * v[2];
    };
"""


@wp.func_native(
    on_cpu(
        _ROWS,
        """
    for (int i = 0; i < count; ++i) {
        rest[i] = right[i] - product(starts[i], diagonal.data[i]);
        x[i] = solved(i, rest[i]);
    }
""",
    )
)
def sweep_rows_from_zero(
    world: int,
    count: int,
    entries: int,
    rows: Rows,
    diagonal: wp.array[wp.int32],
    inverses: wp.array[wp.mat33],
    r: wp.array[wp.vec4],
    z: wp.array[wp.vec4],
    other: wp.array[wp.vec4],
): ...


@wp.func_native(
    on_cpu(
        _ROWS,
        """
    for (int k = 0; k < count; ++k) {
        const int i = backward ? count - 1 - k : k;
        x[i] += solved(i, right[i] - product(starts[i], starts[i + 1]));
    }
""",
    )
)
def sweep_rows(
    world: int,
    count: int,
    entries: int,
    backward: bool,
    rows: Rows,
    inverses: wp.array[wp.mat33],
    r: wp.array[wp.vec4],
    z: wp.array[wp.vec4],
    other: wp.array[wp.vec4],
): ...


@wp.func_native(
    on_cpu(
        _ROWS,
        """
    if (is_first)
        for (int i = 0; i < count; ++i) rest[i] -= product(diagonal.data[i], starts[i + 1]);
    else
        for (int i = 0; i < count; ++i) rest[i] = right[i] - product(starts[i], starts[i + 1]);
""",
    )
)
def subtract_rows(
    world: int,
    count: int,
    entries: int,
    is_first: bool,
    rows: Rows,
    diagonal: wp.array[wp.int32],
    inverses: wp.array[wp.mat33],
    r: wp.array[wp.vec4],
    z: wp.array[wp.vec4],
    other: wp.array[wp.vec4],
): ...


@wp.kernel(enable_backward=False)
def sweep_from_zero(
    # In
    count: int,
    entries: int,
    rows: Rows,
    diagonal: wp.array[wp.int32],
    inverses: wp.array[wp.mat33],
    r: wp.array[wp.vec4],
    # Out
    z: wp.array[wp.vec4],
    other: wp.array[wp.vec4],
):
    """z = (D + L)^-1 r; ``other`` is r - L z."""
    sweep_rows_from_zero(wp.tid(), count, entries, rows, diagonal, inverses, r, z, other)


@wp.kernel(enable_backward=False)
def sweep(
    # In
    count: int,
    entries: int,
    backward: bool,
    rows: Rows,
    inverses: wp.array[wp.mat33],
    r: wp.array[wp.vec4],
    # In and out
    z: wp.array[wp.vec4],
):
    """Sweep over all rows, forward or backward."""
    sweep_rows(wp.tid(), count, entries, backward, rows, inverses, r, z, z)


@wp.kernel(enable_backward=False)
def find_rest(
    # In
    count: int,
    entries: int,
    is_first: bool,
    rows: Rows,
    diagonal: wp.array[wp.int32],
    r: wp.array[wp.vec4],
    z: wp.array[wp.vec4],
    inverses: wp.array[wp.mat33],
    # In and out
    other: wp.array[wp.vec4],
):
    """r - A z; after ``sweep_from_zero``, ``other`` already has a part of it."""
    subtract_rows(wp.tid(), count, entries, is_first, rows, diagonal, inverses, r, z, other)
