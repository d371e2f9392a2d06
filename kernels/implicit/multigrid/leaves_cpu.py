"""The entries off the diagonal of the finest matrix on the CPU: those of ``values.gather_leaves``, one thread for each
world, in parts. A column of a block is a vector register, so that a contribution takes some forty instructions.
"""

import warp as wp

from warp_corot.kernels.elements.elements import LEVEL_MASK
from warp_corot.kernels.elements.simd8 import constants, on_cpu

from .values import Leaves

wp.set_module_options({"enable_backward": False})


@wp.func_native(
    on_cpu(
        constants(LEVELS=int(LEVEL_MASK)),
        """
    const auto &upper = leaves.upper, &places = leaves.places, &pairs = leaves.pairs;
    const auto &starts = leaves.starts, &codes = leaves.codes;
    const auto &mu = leaves.mu, &lam = leaves.lam;
    const int stride = leaves.stride;
    const float scale = scales.data[2] + scales.data[1] * stiffening;
    const long long first = (long long)world * leaves.world_elements, first_row = (long long)world * leaves.row_entries;
    const auto row = [&](int place) { return *reinterpret_cast<const four*>(&leaves.rows.data[first_row + place]); };
    const auto turned = [](const float* q, const float* g) {
        const four x = {q[0], q[3], q[6], 0.0f}, y = {q[1], q[4], q[7], 0.0f}, z = {q[2], q[5], q[8], 0.0f};
        return x * g[0] + y * g[1] + z * g[2];
    };
    const long long count = upper.shape[0];
    const int last = count * (number + 1) / parts;
    for (int u = count * number / parts; u < last; ++u) {
        four c[3] = {};
        if (upper.data[u][0] == upper.data[u][1]) {
            if (more.shape[0] <= 1) continue;
            for (int at = starts.data[u]; at < starts.data[u + 1]; ++at) {
                if (codes.data[at] >= -1) continue;
                const four a = row(pairs.data[-2 - codes.data[at]][0]), b = a * a[3];
                for (int j = 0; j < 3; ++j) c[j] += a * b[j];
            }
            float* to = &more.data[(long long)world * leaves.ranks + upper.data[u][0]].data[0][0];
            for (int j = 0; j < 3; ++j)
                for (int i = 0; i < 3; ++i) to[3 * j + i] = scale * c[j][i];
            continue;
        }
        for (int at = starts.data[u]; at < starts.data[u + 1]; ++at) {
            const int code = codes.data[at];
            if (code < 0) {
                const four a = row(pairs.data[-2 - code][0]), b = row(pairs.data[-2 - code][1]);
                for (int j = 0; j < 3; ++j) c[j] += a * b[j];
                continue;
            }
            const long long t = first + (code >> 4);
            const float* g = &leaves.gradients.data[4 * ((leaves.elements.code.data[t] & LEVELS) % 3)][0];
            const float* q = &leaves.frames.data[t].data[0][0];
            const four a = turned(q, g + 3 * ((code >> 2) & 3)), b = turned(q, g + 3 * (code & 3));
            const float m = mu.data[t * stride], l = lam.data[t * stride], most = most_lambda * m;
            const four la = a * (l < most ? l : most), mb = b * m, ab = a * mb;
            const float d = ab[0] + ab[1] + ab[2];
            c[0] += la * b[0] + mb * a[0] + four{d, 0.0f, 0.0f, 0.0f};
            c[1] += la * b[1] + mb * a[1] + four{0.0f, d, 0.0f, 0.0f};
            c[2] += la * b[2] + mb * a[2] + four{0.0f, 0.0f, d, 0.0f};
        }
        float* own = &blocks.data[(long long)world * leaves.entries + places.data[u][0]].data[0][0];
        float* mirrored = &blocks.data[(long long)world * leaves.entries + places.data[u][1]].data[0][0];
        for (int j = 0; j < 3; ++j) {
            c[j] *= scale;
            for (int i = 0; i < 3; ++i) {
                own[3 * j + i] = c[j][i];
                mirrored[3 * i + j] = c[j][i];
            }
        }
    }
""",
    )
)
def gather_entries(
    number: int,
    parts: int,
    world: int,
    leaves: Leaves,
    scales: wp.array[float],
    stiffening: float,
    most_lambda: float,
    blocks: wp.array[wp.mat33],
    more: wp.array[wp.mat33],
): ...


@wp.kernel(enable_backward=False)
def gather_leaves_on_cpu(
    # In
    number: int,
    parts: int,
    leaves: Leaves,
    scales: wp.array[float],
    stiffening: float,
    most_lambda: float,
    # Out
    blocks: wp.array[wp.mat33],
    more: wp.array[wp.mat33],
):
    """As ``values.gather_leaves``, for one of so many parts of the entries."""
    gather_entries(number, parts, wp.tid(), leaves, scales, stiffening, most_lambda, blocks, more)
