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


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return gridDim.x;
#else
    return 1;
#endif
""")
def block_count() -> int:
    """The number of blocks of the launch."""
    ...


#: Numbers from one counter of a barrier to the next: each has a line of the cache of its own, for blocks that wait read
#: it all the time.
LINE = wp.constant(32)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncthreads();
    if (blocks == 1) return;
    if (threadIdx.x == 0) {
        unsigned* count = &wp::index(arrived, which * 32);
        const unsigned own = blockIdx.x == 0 ? 0x80000000u - (blocks - 1u) : 1u;
        unsigned before, now;
        asm volatile("atom.add.release.gpu.global.u32 %0, [%1], %2;" : "=r"(before) : "l"(count), "r"(own) : "memory");
        do asm volatile("ld.acquire.gpu.global.u32 %0, [%1];" : "=r"(now) : "l"(count) : "memory");
        while (((before ^ now) & 0x80000000u) == 0u);
    }
    __syncthreads();
#endif
""")
def synchronize_blocks(arrived: wp.array[wp.uint32], which: int, blocks: int):
    """Wait for all threads of the first so many blocks, which must all be resident. Together they change the first bit
    of ``arrived[LINE * which]``."""
    ...


@wp.func
def synchronize_grid(arrived: wp.array[wp.uint32]):
    """Wait for all threads of the launch, whose blocks must all be resident, by the first counter."""
    synchronize_blocks(arrived, 0, block_count())


@wp.func
def spread_thread(thread: int, threads: int, block: int):
    """The first item of a thread if each warp takes the next 32 items in another block, so that few items are spread
    over many multiprocessors. ``block``: the number of threads of a block."""
    if threads < block:
        return thread
    blocks = threads // block
    within = thread % block
    return ((within // 32) * blocks + thread // block) * 32 + within % 32


@wp.func
def number_in(word: wp.uint64, k: int):
    """The k-th of the four 16-bit numbers in a word."""
    return int((word >> wp.uint64(16 * k)) & wp.uint64(0xFFFF))


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
    return __popc(__ballot_sync(0xffffffffu, flag != 0));
#else
    return flag != 0;
#endif
""")
def lanes_with(flag: int) -> int:
    """How many threads of the warp have a flag; all of them must ask."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __shfl_sync(0xffffffffu, value, 0);
#else
    return value;
#endif
""")
def of_first_lane(value: int) -> int:
    """The value of the first thread of the warp; all of them must ask."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    int sum = value;
    const int lane = threadIdx.x & 31;
    for (int far = 1; far < 32; far *= 2) {
        const int other = __shfl_up_sync(0xffffffffu, sum, far);
        if (lane >= far) sum += other;
    }
    return sum - value;
#else
    return 0;
#endif
""")
def sum_before(value: int) -> int:
    """The sum of the values of the warp's threads before this one; all of them must ask."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncwarp();
#endif
""")
def synchronize_warp():
    """Wait for the threads of the warp, and see what they have written."""
    ...


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
