"""The exchange of displacements between thread blocks that run at the same time. CUDA only."""

import warp as wp

#: How often a block polls for a displacement before it gives up; this takes some seconds.
MOST_LOOKS = 1 << 22


@wp.struct
class Exchange:
    """The arrays through which blocks exchange displacements."""

    nodes: int  # of all worlds
    published: wp.array[
        wp.vec4
    ]  # [2 nodes] displacements of even and of odd steps; w holds the bits of the step's number
    begun: wp.array[wp.uint32]  # [worlds patches] the number of the next launch's first state


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const unsigned long long low = ((unsigned long long)__float_as_uint(value[1]) << 32) | __float_as_uint(value[0]);
    const unsigned long long high = ((unsigned long long)number << 32) | __float_as_uint(value[2]);
    asm volatile("{ .reg .b128 all; mov.b128 all, {%1, %2}; st.relaxed.gpu.global.b128 [%0], all; }"
        :: "l"(&wp::index(published, i)), "l"(low), "l"(high) : "memory");
#endif
""")
def publish(published: wp.array[wp.vec4], i: int, value: wp.vec3, number: wp.uint32):
    """Write a displacement and its number in one access."""
    ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    unsigned long long low = 0, high = 0;
    for (int look = 0; look < {MOST_LOOKS}; ++look) {{
        asm volatile("{{ .reg .b128 all; ld.relaxed.gpu.global.b128 all, [%2]; mov.b128 {{%0, %1}}, all; }}"
            : "=l"(low), "=l"(high) : "l"(&wp::index(published, i)) : "memory");
        if ((unsigned)(high >> 32) == number)
            return wp::vec_t<4, wp::float32>(__uint_as_float((unsigned)low), __uint_as_float((unsigned)(low >> 32)),
                                             __uint_as_float((unsigned)high), 0.0f);
    }}
#endif
    return wp::vec_t<4, wp::float32>(0.0f, 0.0f, 0.0f, 1.0f);
""")
def await_displacement(published: wp.array[wp.vec4], i: int, number: wp.uint32) -> wp.vec4:
    """Wait for the displacement of the step ``number``; the last component is 0, or 1 if it did not arrive."""
    ...
