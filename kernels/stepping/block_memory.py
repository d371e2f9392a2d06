"""Arrays and lists in a thread block's shared memory, each as one function that reads or writes it. CUDA only."""

import warp as wp

LOAD, STORE, LOAD_BYTES = 0, 1, 2
RESERVE, WRITE, READ, COUNT, CLEAR = 0, 1, 2, 3, 4


def shared_list(room: int) -> wp.Function:
    """A list of integers in shared memory, as one function.

    ``access`` says what it does: make room for ``value`` entries and return the first place, write or read entry ``i``,
    return the number of entries, or clear the list.
    """
    snippet = f"""
#if defined(__CUDA_ARCH__)
    __shared__ int count;
    __shared__ int entries[{room}];
    if (access == {RESERVE}) return atomicAdd(&count, value);
    if (access == {WRITE}) entries[i] = value;
    if (access == {READ}) return entries[i];
    if (access == {COUNT}) return count < {room} ? count : {room};
    if (access == {CLEAR}) count = 0;
#endif
    return 0;
"""

    @wp.func_native(snippet)
    def list_of(access: int, i: int, value: int) -> int: ...

    return list_of


def shared_vectors(count: int, tag: str) -> wp.Function:
    """An array of vectors in shared memory, as one function that reads or writes it.

    With ``LOAD_BYTES`` the place is counted in bytes.
    """

    snippet = f"""
#if defined(__CUDA_ARCH__)
    // {tag}
    __shared__ float memory[{3 * count}];
    if (access == {STORE}) {{
        memory[3 * i] = value[0]; memory[3 * i + 1] = value[1]; memory[3 * i + 2] = value[2];
        return value;
    }}
    const float* at = access == {LOAD_BYTES} ? (const float*)((const char*)memory + i) : memory + 3 * i;
    return wp::vec_t<3, wp::float32>(at[0], at[1], at[2]);
#else
    return value;
#endif
"""

    @wp.func_native(snippet)
    def memory(access: int, i: int, value: wp.vec3) -> wp.vec3: ...

    return memory


def shared_numbers(count: int, tag: str) -> wp.Function:
    """An array of numbers in shared memory, as one function that reads or writes it."""
    snippet = f"""
#if defined(__CUDA_ARCH__)
    // {tag}
    __shared__ float memory[{count}];
    if (access == {STORE}) memory[i] = value;
    return memory[i];
#else
    return value;
#endif
"""

    @wp.func_native(snippet)
    def memory(access: int, i: int, value: float) -> float: ...

    return memory


def vectors_at(first: int) -> wp.Function:
    """An array of vectors in the block's dynamic shared memory, from number ``first`` on; see ``shared_vectors``.

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
