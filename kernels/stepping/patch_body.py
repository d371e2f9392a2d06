"""A body's patches in the form that the kernel of ``patches`` reads, and the layout for which the kernel is
generated.
"""

from dataclasses import dataclass

import warp as wp

#: A column of ``PatchBody.rest`` has the inverse of the matrix of rest edges, row by row, then the volume.
VOLUME_ROW = 9


@dataclass(frozen=True)
class Layout:
    """The numbers for which a kernel is generated.

    Attributes:
        threads: Threads of a block.
        elements, halo: Number of elements that a thread computes, and of halo nodes that it waits for.
        lanes: Threads that sum the forces on one node.
        nodes, slots: Room for displacements and for forces in shared memory; one more slot takes forces that are not
            used.
        groups, members: Room for groups that share a dilatation and for the elements of each; zero if none do.
        overlaps: Whether a block computes the elements that need no halo before it waits for the halo.
    """

    threads: int
    elements: int
    halo: int
    lanes: int
    nodes: int
    slots: int
    groups: int = 0
    members: int = 0
    overlaps: bool = True

    @property
    def vectors(self) -> int:
        return self.nodes + self.slots + 1

    @property
    def floats(self) -> int:
        """The shared memory of a block, in float32 numbers."""
        return 3 * self.vectors + self.groups * (2 * self.members + 2)


@wp.struct
class PatchBody:
    """The patches of each world of a body; see ``solvers.explicit.patch_layout.Patches``."""

    element_count: int  # of the mesh
    own: wp.array[wp.int32]  # [N] of one world, as all that is not said to be of others
    own_start: wp.array[wp.int32]  # [patches + 1], as the other starts
    halo: wp.array[wp.int32]
    halo_start: wp.array[wp.int32]
    elements: wp.array[wp.int32]  # [E]
    element_start: wp.array[wp.int32]
    interior: wp.array[wp.int32]  # [patches] number of a patch's elements that need no halo; they come first
    computed: wp.array[wp.int32]  # [patches] number of elements that it computes; it only measures the others
    measures: wp.array[wp.int32]  # [E] where an element's dilatation goes: group by group, one row a member
    corners: wp.array[wp.uint64]  # [E] the four corners' places among the patch's nodes, 16 bits each
    slots: wp.array[wp.uint64]  # [E] the places of the corners' forces in the same form
    bases: wp.array[wp.int32]
    base_start: wp.array[wp.int32]
    rest: wp.array2d[wp.float32]  # [10, E] see ``VOLUME_ROW``
    # Keyframes of all trajectories, one after another.
    trajectory: wp.array[wp.int32]  # [worlds N] the trajectory that a node follows, or -1
    place: wp.array[wp.int32]  # [worlds N] the node's column there
    key_start: wp.array[wp.int32]  # [trajectories + 1] into ``times``
    value_start: wp.array[wp.int32]  # [trajectories] into ``values``, whose rows have ``columns`` entries
    columns: wp.array[wp.int32]  # [trajectories]
    times: wp.array[wp.float64]
    values: wp.array[wp.vec3]


# --- the exchange of displacements between blocks that run at the same time ------------------------------------------


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
