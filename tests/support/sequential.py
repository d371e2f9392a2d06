"""Bisection one tetrahedron at a time, by recursion, with geometry alone: the reference of the forest."""

from itertools import combinations, permutations, product

import numpy as np


class Bisection:
    """Conforming bisection of a box of cubes, one tetrahedron at a time, on an integer lattice of 2^20 to a cube edge.

    A leaf is a tuple (level, four lattice points in Maubach order); ``leaves`` is the set of them.
    """

    CUBE = 2**20

    def __init__(self, cells, level):
        self.leaves = set()
        self._around = {}  # edge -> leaves that have it
        for cell in product(*(range(n) for n in cells)):
            for order in permutations(range(3)):
                vertices = [tuple(self.CUBE * c for c in cell)]
                for axis in order:
                    vertices.append(tuple(c + self.CUBE * (i == axis) for i, c in enumerate(vertices[-1])))
                self._descend((0, *vertices), level)

    @staticmethod
    def refinement_edge(leaf):
        return frozenset((leaf[1], leaf[1 + 3 - leaf[0] % 3]))

    @staticmethod
    def children(leaf):
        level, *x = leaf
        k = 3 - level % 3
        z = tuple((a + b) // 2 for a, b in zip(x[0], x[k], strict=True))
        return (level + 1, *x[:k], z, *x[k + 1 :]), (level + 1, *x[1 : k + 1], z, *x[k + 1 :])

    def _descend(self, leaf, level):
        if leaf[0] == level:
            self._insert(leaf)
        else:
            for child in self.children(leaf):
                self._descend(child, level)

    def _edges(self, leaf):
        return (frozenset(pair) for pair in combinations(leaf[1:], 2))

    def _insert(self, leaf):
        self.leaves.add(leaf)
        for edge in self._edges(leaf):
            self._around.setdefault(edge, set()).add(leaf)

    def _bisect(self, leaf):
        self.leaves.remove(leaf)
        for edge in self._edges(leaf):
            self._around[edge].remove(leaf)
        for child in self.children(leaf):
            self._insert(child)

    def refine(self, leaf):
        """Bisect a leaf (if it still is one) and, first, the leaves that conformity requires."""
        if leaf not in self.leaves:
            return
        edge = self.refinement_edge(leaf)
        while others := [other for other in self._around[edge] if self.refinement_edge(other) != edge]:
            self.refine(others[0])
        for member in list(self._around[edge]):
            self._bisect(member)

    def points(self, leaf, cell_size=1.0):
        """The four vertices [4, 3] in Maubach order, in units of length."""
        return np.array(leaf[1:], float) / self.CUBE * cell_size
