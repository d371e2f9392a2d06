"""Arrays in a thread block's shared memory, each as one function that reads or writes it. CUDA only."""

import warp as wp

LOAD, STORE, LOAD_BYTES = 0, 1, 2


def _array(memory: str, dtype: type) -> wp.Function:
    """An array of numbers or vectors, as one function that reads or writes it.

    Args:
        memory: C++ that declares ``memory``.
        dtype: float or vec3.
    """
    width = 1 if dtype is float else 3
    value = "value" if dtype is float else "value[{0}]"
    store = " ".join(f"at[{k}] = {value.format(k)};" for k in range(width))
    found = "at[0]" if dtype is float else "wp::vec_t<3, wp::float32>(at[0], at[1], at[2])"
    snippet = f"""
#if defined(__CUDA_ARCH__)
    {memory}
    float* at = access == {LOAD_BYTES} ? (float*)((char*)memory + i) : memory + {width} * i;
    if (access == {STORE}) {{
        {store}
        return value;
    }}
    return {found};
#else
    return value;
#endif
"""

    @wp.func_native(snippet)
    def access_memory(access: int, i: int, value: dtype) -> dtype: ...

    return access_memory


def shared_array(count: int, tag: str, dtype: type = wp.vec3) -> wp.Function:
    """An array in shared memory of its own. With ``LOAD_BYTES`` the place is counted in bytes."""
    return _array(f"__shared__ float memory[{count if dtype is float else 3 * count}];  // {tag}", dtype)


def array_at(first: int, dtype: type = wp.vec3) -> wp.Function:
    """An array in the block's dynamic shared memory, from the number ``first`` on.

    The kernel reserves the memory as a tile; for a tile, Warp requests more than 48 KB if necessary.
    """
    dynamic = "extern __shared__ char dynamic_smem_base[];"
    return _array(f"{dynamic} float* memory = (float*)dynamic_smem_base + {first};", dtype)
