"""On the CPU subnormal numbers count as zero: two launches set and restore the thread's floating-point mode.

A core takes a hundred times as long for a subnormal number, and where a wave has not arrived yet, forces and velocities
are subnormal. The mode belongs to the thread. So one launch before the kernels of a run saves and changes it, and one
launch after them restores it. Graphs record both like any other launch.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

# x86: MXCSR with its bits 15 (flush to zero) and 6 (denormals are zero). ARM: FPCR with its bit 24, which is both.
_READ_AND_SET = """
#if defined(__CUDA_ARCH__)
#elif defined(__x86_64__)
    mode.data[0] = __builtin_ia32_stmxcsr();
    __builtin_ia32_ldmxcsr(mode.data[0] | 0x8040u);
#elif defined(__aarch64__)
    unsigned long long fpcr;
    asm volatile("mrs %0, fpcr" : "=r"(fpcr));
    mode.data[0] = static_cast<unsigned int>(fpcr);
    asm volatile("msr fpcr, %0" :: "r"(fpcr | (1ull << 24)));
#endif
"""

_RESTORE = """
#if defined(__CUDA_ARCH__)
#elif defined(__x86_64__)
    __builtin_ia32_ldmxcsr(mode.data[0]);
#elif defined(__aarch64__)
    asm volatile("msr fpcr, %0" :: "r"(static_cast<unsigned long long>(mode.data[0])));
#endif
"""


@wp.func_native(_READ_AND_SET)
def exchange_mode(mode: wp.array[wp.uint32]): ...


@wp.func_native(_RESTORE)
def put_back_mode(mode: wp.array[wp.uint32]): ...


@wp.kernel(enable_backward=False)
def flush_subnormals(mode: wp.array[wp.uint32]):
    """Save the thread's mode in ``mode`` [1], and count subnormal numbers as zero from now on."""
    exchange_mode(mode)


@wp.kernel(enable_backward=False)
def restore_subnormals(mode: wp.array[wp.uint32]):
    """Restore the saved mode."""
    put_back_mode(mode)
