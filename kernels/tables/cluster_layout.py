"""How elements are divided among the thread blocks of ``clusters``: numbers that its kernels are generated from."""

from dataclasses import dataclass

#: Bytes of a vector in shared memory.
QUAD_BYTES = 16
#: How many of these shared memory reads or writes at once, from groups of banks.
BANK_GROUPS = 8


@dataclass(frozen=True)
class PairLayout:
    """The numbers that a kernel is generated from; a thread takes a pair of elements.

    Attributes:
        threads: Threads a block, up to 192: slots have ten bits.
        resident: Blocks that a multiprocessor's registers must have room for.
        early: Whether a thread reads the numbers of its sum before it needs them.
        ahead: How many blocks ahead tables are fetched into the second-level cache, 0: they are not.
    """

    threads: int = 128
    resident: int = 6
    early: bool = False
    ahead: int = 0

    @property
    def zero(self) -> int:
        """The first of the slots that are zero; before it there are five a thread."""
        return 5 * self.threads


#: For a forest's elements, for general ones, and for the anisotropic law: the more blocks are resident, the less they
#: wait, if few registers spill to memory.
LATTICE, GENERAL, ANISOTROPIC = PairLayout(resident=8), PairLayout(resident=7), PairLayout(resident=4)

#: Larger tables than this [bytes] do not stay in the second-level cache beside the nodes and are fetched this many
#: blocks ahead: about as many as an H200 runs at once.
LARGE, AHEAD = 24 << 20, 1024
