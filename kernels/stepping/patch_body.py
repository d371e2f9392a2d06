"""A body's patches in the form that the kernel of ``patches`` reads, and the layout for which the kernel is
generated.
"""

from dataclasses import dataclass

import warp as wp

#: A column of ``PatchBody.rest`` has the inverse of the matrix of rest edges, row by row, then the volume.
VOLUME_ROW = 9
#: Threads of whole worlds for which a multiprocessor's registers must have room.
RESIDENT_THREADS = 768


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
        whole: Whether a patch is a whole world. Then blocks exchange nothing, and read elements' constants, which are
            the same in all worlds, at every step in place of keeping them, so that more blocks are resident.
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
    whole: bool = False

    @property
    def resident(self) -> int:
        """Blocks for which a multiprocessor's registers must have room."""
        return max(RESIDENT_THREADS // self.threads, 1) if self.whole else 1

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
