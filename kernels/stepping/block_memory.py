"""Arrays in a thread block's shared memory, each as one function that reads or writes it. CUDA only."""

import warp as wp

LOAD, STORE = 0, 1


def vectors_at(first: int) -> wp.Function:
    """An array of vectors in the block's dynamic shared memory, from number ``first`` on.

    The kernel reserves the memory as a tile; for a tile, Warp requests more than 48 KB if necessary.
    """
    snippet = f"""
#if defined(__CUDA_ARCH__)
    extern __shared__ char dynamic_smem_base[];
    float* at = (float*)dynamic_smem_base + 3 * (i + {first});
    if (access == {STORE}) {{
        at[0] = value[0]; at[1] = value[1]; at[2] = value[2];
        return value;
    }}
    return wp::vec_t<3, wp::float32>(at[0], at[1], at[2]);
#else
    return value;
#endif
"""

    @wp.func_native(snippet)
    def memory(access: int, i: int, value: wp.vec3) -> wp.vec3: ...

    return memory


def numbers_at(first: int) -> wp.Function:
    """An array of numbers in the same memory, from number ``first`` on."""
    snippet = f"""
#if defined(__CUDA_ARCH__)
    extern __shared__ char dynamic_smem_base[];
    float* at = (float*)dynamic_smem_base + {first} + i;
    if (access == {STORE}) *at = value;
    return *at;
#else
    return value;
#endif
"""

    @wp.func_native(snippet)
    def memory(access: int, i: int, value: float) -> float: ...

    return memory
