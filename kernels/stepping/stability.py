"""The longest stable step: the largest curvature at rest by Lanczos' iteration, and how stiff a body is now.

Small motions about the present displacements u obey q'' = -A q with A = M^-1/2 K M^-1/2 and q = M^1/2 d. Every free
node has a direction of its own, |q_i| = 1, so that the stiffest place is found wherever it is. A q comes from a
difference of forces. s_i = q_i . (A q)_i never exceeds the sum of the norms of the blocks of row i, and the largest of
these sums bounds the eigenvalues of A (Gershgorin's circles, for blocks). The next directions are the vectors of A q,
each normalised: a power iteration that does not lose the directions at softer places. Where s_i < 0, the body buckles
and does not vibrate.

The host reads nothing before the last step. Sums are float64 and always have the same order: first partial sums, then
sums of these.
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


#: The largest number of partial sums, one for each thread, and the number of sums into which these are folded.
PARTS = 16384
FOLDED = 128


@wp.kernel(enable_backward=False)
def random_motion(seed: int, inverse_mass: wp.array[wp.float32], q: wp.array[wp.vec4]):
    """Normally distributed numbers at nodes that are free to move."""
    i = wp.tid()
    state = wp.rand_init(seed, i)
    a = wp.vec3(wp.randn(state), wp.randn(state), wp.randn(state))
    if inverse_mass[i] == 0.0:
        a = wp.vec3()
    store_node(q, i, a)


@wp.kernel(enable_backward=False)
def largest_motions(inverse_mass: wp.array[wp.float32], q: wp.array[wp.vec4], largest: wp.array[wp.float64]):
    """Largest component of M^-1/2 q among every ``len(largest)``-th node."""
    part = wp.tid()
    most = float(0.0)
    i = part
    while i < q.shape[0]:
        a = wp.sqrt(inverse_mass[i]) * load_node(q, i)
        most = wp.max(most, wp.max(wp.abs(a[0]), wp.max(wp.abs(a[1]), wp.abs(a[2]))))
        i += largest.shape[0]
    largest[part] = wp.float64(most)


@wp.kernel(enable_backward=False)
def inner_products(a: wp.array[wp.vec4], b: wp.array[wp.vec4], sums: wp.array[wp.float64]):
    """Partial sums of a . b."""
    part = wp.tid()
    total = wp.float64(0.0)
    i = part
    while i < a.shape[0]:
        x = load_node(a, i)
        y = load_node(b, i)
        for axis in range(3):
            # The product of two float32 numbers may exceed the range of float32.
            total += wp.float64(x[axis]) * wp.float64(y[axis])
        i += sums.shape[0]
    sums[part] = total


@wp.kernel(enable_backward=False)
def fold(parts: wp.array[wp.float64], sums: wp.array[wp.float64], largest: wp.array[wp.float64]):
    """Sum, and largest value, of every ``FOLDED``-th part."""
    k = wp.tid()
    total = wp.float64(0.0)
    most = wp.float64(0.0)
    for i in range(k, parts.shape[0], FOLDED):
        total += parts[i]
        most = wp.max(most, parts[i])
    sums[k] = total
    largest[k] = most


@wp.kernel(enable_backward=False)
def take_scale(probe: float, largest: wp.array[wp.float64], scale: wp.array[wp.float32]):
    """Find the factor that makes the largest motion ``probe`` [m]."""
    most = wp.float64(0.0)
    for k in range(FOLDED):
        most = wp.max(most, largest[k])
    scale[0] = 1.0
    if most > wp.float64(0.0):
        scale[0] = float(wp.float64(probe) / most)


@wp.kernel(enable_backward=False)
def take_sum(
    sums: wp.array[wp.float64], root: int, step: wp.array[wp.int32], after: int, numbers: wp.array[wp.float64]
):
    """Write a sum, or its square root, to numbers[step + after]."""
    total = wp.float64(0.0)
    for k in range(FOLDED):
        total += sums[k]
    if root != 0:
        total = wp.sqrt(total)
    numbers[step[0] + after] = total


@wp.kernel(enable_backward=False)
def probe_motion(
    scale: wp.array[wp.float32], inverse_mass: wp.array[wp.float32], q: wp.array[wp.vec4], u: wp.array[wp.vec4]
):
    """u = scale M^-1/2 q."""
    i = wp.tid()
    store_node(u, i, (scale[0] * wp.sqrt(inverse_mass[i])) * load_node(q, i))


@wp.kernel(enable_backward=False)
def apply_stiffness(
    # In
    scale: wp.array[wp.float32],
    off: wp.array[wp.float64],
    step: wp.array[wp.int32],
    inverse_mass: wp.array[wp.float32],
    f: wp.array[wp.vec4],
    before: wp.array[wp.vec4],
    # Out
    w: wp.array[wp.vec4],
):
    """w = M^-1/2 K M^-1/2 q - off[step] before, from the forces f = -scale K M^-1/2 q.

    In step 0 ``before`` is not read.
    """
    i = wp.tid()
    a = (-wp.sqrt(inverse_mass[i]) / scale[0]) * load_node(f, i)
    if step[0] > 0:
        a -= float(off[step[0]]) * load_node(before, i)
    store_node(w, i, a)


@wp.kernel(enable_backward=False)
def take_away(numbers: wp.array[wp.float64], step: wp.array[wp.int32], a: wp.array[wp.vec4], b: wp.array[wp.vec4]):
    """b -= numbers[step] a."""
    i = wp.tid()
    store_node(b, i, load_node(b, i) - float(numbers[step[0]]) * load_node(a, i))


@wp.func
def divided(a: wp.vec3, length: wp.float64):
    if length > wp.float64(0.0):
        return float(wp.float64(1.0) / length) * a
    return a


@wp.kernel(enable_backward=False)
def normalise(lengths: wp.array[wp.float64], q: wp.array[wp.vec4]):
    """q /= lengths[0], if that is not zero."""
    i = wp.tid()
    store_node(q, i, divided(load_node(q, i), lengths[0]))


@wp.kernel(enable_backward=False)
def take_next(
    # In
    lengths: wp.array[wp.float64],
    step: wp.array[wp.int32],
    w: wp.array[wp.vec4],
    # In and out
    q: wp.array[wp.vec4],
    # Out
    before: wp.array[wp.vec4],
):
    """before = q and q = w / lengths[step + 1], where a length of zero does not divide."""
    i = wp.tid()
    store_node(before, i, load_node(q, i))
    store_node(q, i, divided(load_node(w, i), lengths[step[0] + 1]))


@wp.kernel(enable_backward=False)
def count_step(step: wp.array[wp.int32]):
    step[0] += 1


@wp.kernel(enable_backward=False)
def add_scaled(factor: float, a: wp.array[wp.vec4], b: wp.array[wp.vec4]):
    """b += factor a."""
    i = wp.tid()
    store_node(b, i, load_node(b, i) + factor * load_node(a, i))


@wp.kernel(enable_backward=False)
def scale_by(factor: float, a: wp.array[wp.vec4]):
    i = wp.tid()
    store_node(a, i, factor * load_node(a, i))
