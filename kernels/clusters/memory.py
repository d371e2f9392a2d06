"""Memory of clusters: contiguous arrays on the device, and vectors in a thread block's shared memory.

Warp does not know that arrays are contiguous, so these functions save some hundred instructions for addresses.
"""

import warp as wp

from warp_corot.kernels.elements.elements import ADD_FORCE
from warp_corot.kernels.stepping.block_memory import STORE

wp.set_module_options({"enable_backward": False})


@wp.func_native("return numbers.data[i];")
def number_of(numbers: wp.array[wp.int32], i: int) -> int: ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const float4 a = ((const float4*)vectors.data)[i];
    return wp::vec_t<3, wp::float32>(a.x, a.y, a.z);
#else
    return wp::vec_t<3, wp::float32>(vectors.data[i][0], vectors.data[i][1], vectors.data[i][2]);
#endif
""")
def vector_of(vectors: wp.array[wp.vec4], i: int) -> wp.vec3: ...


@wp.func_native(ADD_FORCE.replace("wp::index(f, node)", "f.data[node]"))
def add_sum(f: wp.array[wp.vec4], node: int, force: wp.vec3): ...


def shared_quads(count: int, tag: str) -> wp.Function:
    """An array of vectors in shared memory, 16 bytes each, as one function that reads or writes it by bytes."""
    snippet = f"""
#if defined(__CUDA_ARCH__)
    // {tag}
    __shared__ float4 memory[{count}];
    float4* at = (float4*)((char*)memory + i);
    if (access == {STORE}) {{
        *at = make_float4(value[0], value[1], value[2], 0.0f);
        return value;
    }}
    const float4 a = *at;
    return wp::vec_t<3, wp::float32>(a.x, a.y, a.z);
#else
    return value;
#endif
"""

    @wp.func_native(snippet)
    def memory(access: int, i: int, value: wp.vec3) -> wp.vec3: ...

    return memory
