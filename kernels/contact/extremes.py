"""Atomic minima and maxima that no thread waits for: Warp's own compare and swap, one thread after the other.

The bits of numbers without a sign are in order as integers, those of numbers with one in reverse order.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func_native("""
    float* to = reinterpret_cast<float*>(&wp::index(bounds, world, body));
    for (int axis = 0; axis < 3; ++axis) {
#if defined(__CUDA_ARCH__)
        const int bits = __float_as_int(value[axis]);
        if (bits >= 0) atomicMin(reinterpret_cast<int*>(to) + axis, bits);
        else atomicMax(reinterpret_cast<unsigned*>(to) + axis, (unsigned)bits);
#else
        if (value[axis] < to[axis]) to[axis] = value[axis];
#endif
    }
""")
def extend_down(bounds: wp.array2d[wp.vec3], world: int, body: int, value: wp.vec3):
    """Lower each component of a body's bounds to at most a value."""
    ...


@wp.func_native("""
    float* to = reinterpret_cast<float*>(&wp::index(bounds, world, body));
    for (int axis = 0; axis < 3; ++axis) {
#if defined(__CUDA_ARCH__)
        const int bits = __float_as_int(value[axis]);
        if (bits >= 0) atomicMax(reinterpret_cast<int*>(to) + axis, bits);
        else atomicMin(reinterpret_cast<unsigned*>(to) + axis, (unsigned)bits);
#else
        if (value[axis] > to[axis]) to[axis] = value[axis];
#endif
    }
""")
def extend_up(bounds: wp.array2d[wp.vec3], world: int, body: int, value: wp.vec3):
    """Raise each component of a body's bounds to at least a value."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    unsigned bits = __float_as_uint(value);
    bool adds = true;
#if __CUDA_ARCH__ >= 800
    bits = __reduce_max_sync(0xffffffffu, bits);
    adds = (threadIdx.x & 31) == 0;
#endif
    if (adds && bits != 0) atomicMax(reinterpret_cast<unsigned*>(&wp::index(most, 0)), bits);
#else
    if (value > wp::index(most, 0)) wp::index(most, 0) = value;
#endif
""")
def raise_by_warp(most: wp.array[wp.float32], value: float):
    """Raise a number to at least a value, neither of which is negative. All threads of a warp must call it."""
    ...
