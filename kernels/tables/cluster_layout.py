"""How elements are divided among the thread blocks of ``clusters``: numbers that its kernels are generated from."""

from dataclasses import dataclass

#: Bytes of a vector in shared memory.
QUAD_BYTES = 16
#: How many of these shared memory reads or writes at once, from groups of banks.
BANK_GROUPS = 8
#: Slots of a task of single elements, and how many of their places, in bytes, are in a word.
TASK_SLOTS, NUMBERS = 8, 4


@dataclass(frozen=True)
class ClusterLayout:
    """The numbers that a kernel is generated from.

    Attributes:
        threads: Threads a block.
        each: Elements a thread.
        resident: Blocks that a multiprocessor's registers must have room for.
        early: Whether a thread reads the numbers of its sum before it needs them.
    """

    threads: int = 128
    each: int = 1
    resident: int = 8
    early: bool = True

    @property
    def elements(self) -> int:
        """Elements of a cluster."""
        return self.threads * self.each

    @property
    def corners(self) -> int:
        return 4 * self.elements


DEFAULT_LAYOUT = ClusterLayout(early=False)


@dataclass(frozen=True)
class PairLayout:
    """The same of pairs of elements, one a thread.

    Attributes:
        threads: Threads a block, up to 192: slots have ten bits.
        resident, early: As above.
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
#: wait, if few registers spill to memory (H200, general ones: 7 blocks take 1.08 times as long as 6).
LATTICE, GENERAL, ANISOTROPIC = PairLayout(resident=8), PairLayout(resident=6), PairLayout(resident=4)

#: Larger tables than this [bytes] do not stay in the second-level cache beside the nodes and are fetched this many
#: blocks ahead: about as many as an H200 runs at once.
LARGE, AHEAD = 24 << 20, 1024
