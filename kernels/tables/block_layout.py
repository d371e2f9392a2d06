"""How a small body is divided among the threads of one block: numbers that ``stepping.block`` is generated from.

Plain Python, as ``subtree``. ``SHARED_BYTES`` is the shared memory that a block has by default.
"""

from dataclasses import dataclass

from .subtree import LEAVES

SHARED_BYTES = 48 * 1024
VECTOR_BYTES = 12
WARP = 32
MAX_THREADS = 1024

#: Slots that one thread adds up, with their places in bytes, four to a word; its neighbours add up further slots of the
#: same node.
TASK_SLOTS = 8
NUMBERS = 4
#: Words of the ten nodes of a subtree.
NODE_WORDS = 3
#: Number of neighbouring threads that may add up one node, which limits the slots of a node.
NEIGHBOURS = 8
MOST_SLOTS = NEIGHBOURS * TASK_SLOTS
#: A task as one integer: the node, how many neighbours follow for the same node, and whether it is the first of them,
#: which moves the node.
FOLLOWING_SHIFT, FIRST_SHIFT = 16, 24
NO_NODE = 0xFFFF


@dataclass(frozen=True)
class Layout:
    """How a body is divided among the threads of a block.

    Attributes:
        shape: Type of its subtrees.
        uniform: Whether all of a world is of one material.
        parts: Into how many parts the leaves of a subtree are dealt: 1 or 2 (4 was slower).
        subtrees: Room for subtrees, whole warps of them.
        nodes: Room for nodes.
        tasks: Sums that make up the nodes' forces, whole warps of them; see ``TASK_SLOTS``.
        dilating: Whether the leaves of a subtree share their dilatation.
    """

    shape: int
    uniform: bool
    parts: int
    subtrees: int
    nodes: int
    tasks: int = 0
    dilating: bool = False

    @property
    def threads(self) -> int:
        """Threads a block: warp after warp of subtrees, the parts of a subtree in neighbouring warps.

        A multiprocessor's four schedulers take warps in turn, so each runs the code of one part only. If a world is to
        be finished soon, there are as many threads as tasks.
        """
        return max(self.parts * self.subtrees, self.tasks if self.parts > 1 else 0)

    @property
    def fits(self) -> bool:
        needed = VECTOR_BYTES * (2 * self.nodes + self.slot_count + 1) + 4 * self.sum_count
        return needed <= SHARED_BYTES and self.threads <= MAX_THREADS

    @property
    def slot_count(self) -> int:
        """Slots for forces; one more is always zero."""
        return self.subtrees * sum(place >= 0 for places in self.places for place in places)

    @property
    def sum_count(self) -> int:
        """Two sums for each part of a subtree where its leaves share their dilatation."""
        return 2 * self.parts * self.subtrees if self.dilating else 0

    def leaves(self, part: int) -> range:
        """The leaves of a part."""
        each = 8 // self.parts
        return range(part * each, (part + 1) * each)

    @property
    def places(self) -> list[list[int]]:
        """For each part and each of a subtree's ten nodes, its place among a subtree's slots, -1 if the part has none.

        The slot's number is the subtree's plus this many times ``subtrees``.
        """
        places, count = [], 0
        for part in range(self.parts):
            used = {node for leaf in self.leaves(part) for node in LEAVES[self.shape][leaf]}
            row = [-1] * 10
            for node in sorted(used):
                row[node] = count
                count += 1
            places.append(row)
        return places

    def needs(self, part: int) -> list[bool]:
        """Which of a subtree's ten nodes a part reads: among them the first, to which all are relative."""
        return [place >= 0 or node == 0 for node, place in enumerate(self.places[part])]
