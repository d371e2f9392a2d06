"""The longest stable step: the largest curvature at rest by Lanczos' iteration, and how stiff a body is now.

Small motions about the present displacements u obey q'' = -A q with A = M^-1/2 K M^-1/2 and q = M^1/2 d. Every free
node has a direction of its own, |q_i| = 1, so that the stiffest place is found wherever it is. A q comes from a
difference of forces. s_i = q_i . (A q)_i never exceeds the sum of the norms of the blocks of row i, and the largest of
these sums bounds the eigenvalues of A (Gershgorin's circles, for blocks). The next directions are the vectors of A q,
each normalised: a power iteration that does not lose the directions at softer places. Where s_i < 0, the body buckles
and does not vibrate.

Lanczos' iteration needs partial sums, in float64 and always in the same order, which the host adds up.
"""

import functools
from typing import Any

import warp as wp

from warp_corot.kernels.elements.elements import frame, load_node, local_gradient, store_node
from warp_corot.kernels.modules import unique_kernel

from .pace import CURVATURE, DONE, DT, STRAIN, Pace

wp.set_module_options({"enable_backward": False})


#: Every element's strain is measured once in this many measurements.
TURNS = wp.constant(4)


@wp.kernel(enable_backward=False)
def probe_directions(
    # In
    scale: wp.array[wp.float32],
    inverse_mass: wp.array[wp.float32],
    u: wp.array[wp.vec4],
    # In and out
    q: wp.array[wp.vec4],
    # Out
    probed: wp.array[wp.vec4],
    f: wp.array[wp.vec4],
):
    """Move displacements along the directions by scale M^-1/2 q; nodes without a direction get one."""
    i = wp.tid()
    w = inverse_mass[i]
    a = load_node(q, i)
    if w > 0.0:
        if wp.dot(a, a) == 0.0:
            state = wp.rand_init(20130705, i)
            a = wp.normalize(wp.vec3(wp.randn(state), wp.randn(state), wp.randn(state)))
            store_node(q, i, a)
        a = (scale[0] * wp.sqrt(w)) * a
    else:
        a = wp.vec3()
    store_node(probed, i, load_node(u, i) + a)
    store_node(f, i, wp.vec3())


#: The bits of non-negative floats have the order of the floats. The threads of a warp find their largest value first,
#: because thousands of atomic operations on one address would take longer than everything else here.
_KEEP_LARGEST = """
    if (!(value > wp::index(largest, place))) return;
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
    const unsigned int together = __activemask();
    const int most = __reduce_max_sync(together, __float_as_int(value));
    if (__popc(together & ((1u << (threadIdx.x & 31)) - 1u)) == 0)
        atomicMax(reinterpret_cast<int*>(&wp::index(largest, place)), most);
#elif defined(__CUDA_ARCH__)
    atomicMax(reinterpret_cast<int*>(&wp::index(largest, place)), __float_as_int(value));
#else
    wp::index(largest, place) = value;
#endif
"""


@wp.func_native(_KEEP_LARGEST)
def keep_largest(value: float, place: int, largest: wp.array[wp.float32]):
    """Write the largest value of all threads to a place, at least zero; NaN is ignored."""
    ...


@wp.kernel(enable_backward=False)
def find_curvatures(
    # In
    inverse_mass: wp.array[wp.float32],
    u: wp.array[wp.vec4],
    probed: wp.array[wp.vec4],
    f: wp.array[wp.vec4],
    f_probed: wp.array[wp.vec4],
    # Out
    q: wp.array[wp.vec4],
    found: wp.array[wp.float32],
):
    """Find the largest s_i [1/s^2] and the next directions."""
    i = wp.tid()
    w = inverse_mass[i]
    if w == 0.0:
        return
    # The motion after rounding made the forces; far from rest it differs from the motion that was asked for.
    d = load_node(probed, i) - load_node(u, i)
    force = load_node(f, i) - load_node(f_probed, i)
    square = wp.dot(d, d)
    length = wp.length(force)
    if square > 0.0 and length > 0.0 and length <= 3.0e38:
        keep_largest(w * (wp.dot(d, force) / square), CURVATURE, found)
        store_node(q, i, force / length)


@functools.cache
def find_strains(Elements: Any) -> wp.Kernel:
    """The largest entry of C - I = F^T F - I of any element, now and after ``steps`` more steps at the present rate.

    Each measurement takes one element in ``turns``, and the next one takes others. That is enough, because neighbours
    share nodes and are strained alike.
    """

    @unique_kernel()
    def find_strains(
        # In
        elements: Elements,
        u: wp.array[wp.vec4],
        v: wp.array[wp.vec4],
        pace: Pace,
        steps: int,
        turns: int,
        count: int,
        # Out
        found: wp.array[wp.float32],
    ):
        measurement = int(pace.counts[DONE] / wp.int64(steps))
        i = wp.tid()
        t = i * turns + measurement % turns
        if t >= count:
            return
        g = local_gradient(elements, t, u)
        rate = local_gradient(elements, t, v)
        q = frame(elements, t)
        strain = wp.transpose(q) * g
        strain = strain + wp.transpose(strain) + wp.transpose(g) * g
        strain_rate = wp.transpose(q + g) * rate
        ahead = strain + (float(steps) * float(pace.seconds[DT])) * (strain_rate + wp.transpose(strain_rate))
        most = float(0.0)
        for i in range(3):
            for j in range(3):
                most = wp.max(most, wp.max(wp.abs(strain[i, j]), wp.abs(ahead[i, j])))
        keep_largest(most, STRAIN, found)

    return find_strains


#: The largest number of partial sums, one for each thread.
PARTS = 16384


@wp.kernel(enable_backward=False)
def find_sums(
    # In
    inverse_mass: wp.array[wp.float32],
    a: wp.array[wp.vec4],
    b: wp.array[wp.vec4],
    # Out
    parts: wp.array2d[wp.float64],
):
    """Find partial sums of a . b, and the largest components of M^-1/2 b, of every ``len(parts)``-th node."""
    part = wp.tid()
    total = wp.float64(0.0)
    most = float(0.0)
    i = part
    while i < a.shape[0]:
        y = load_node(b, i)
        # The product of two float32 numbers may exceed the range of float32.
        total += wp.dot(wp.vec3d(load_node(a, i)), wp.vec3d(y))
        most = wp.max(most, wp.sqrt(inverse_mass[i]) * wp.max(wp.abs(y)))
        i += parts.shape[0]
    parts[part, 0] = total
    parts[part, 1] = wp.float64(most)


@wp.kernel(enable_backward=False)
def weigh(factor: float, inverse_mass: wp.array[wp.float32], a: wp.array[wp.vec4], b: wp.array[wp.vec4]):
    """b = factor M^-1/2 a."""
    i = wp.tid()
    store_node(b, i, (factor * wp.sqrt(inverse_mass[i])) * load_node(a, i))


@wp.kernel(enable_backward=False)
def add_scaled(factor: float, a: wp.array[wp.vec4], b: wp.array[wp.vec4]):
    """b += factor a."""
    i = wp.tid()
    store_node(b, i, load_node(b, i) + factor * load_node(a, i))


@wp.kernel(enable_backward=False)
def scale_by(factor: float, a: wp.array[wp.vec4]):
    i = wp.tid()
    store_node(a, i, factor * load_node(a, i))
