"""Functions for the threads of a block: barriers, shuffles within a warp, bits, and numbers packed into words."""

import warp as wp


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncthreads();
#endif
""")
def synchronize_block(): ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __syncthreads_or(flag);
#else
    return flag;
#endif
""")
def synchronize_any(flag: int) -> int:
    """Wait for all threads of the block, and return whether any has a flag."""
    ...


@wp.func
def number_in(word: wp.uint64, k: int):
    """The k-th of the four 16-bit numbers in a word."""
    return int((word >> wp.uint64(16 * k)) & wp.uint64(0xFFFF))


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __popc(bits);
#else
    return __builtin_popcount(bits);
#endif
""")
def bit_count(bits: int) -> int: ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __ffs(bits) - 1;
#else
    return __builtin_ctz(bits);
#endif
""")
def lowest_bit(bits: int) -> int: ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return wp::vec_t<3, wp::float32>(
        __shfl_down_sync(0xffffffff, value[0], distance),
        __shfl_down_sync(0xffffffff, value[1], distance),
        __shfl_down_sync(0xffffffff, value[2], distance));
#else
    return value;
#endif
""")
def shuffle_down(value: wp.vec3, distance: int) -> wp.vec3: ...
