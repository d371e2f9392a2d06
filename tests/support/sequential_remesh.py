"""Refinement and simplification one vertex at a time, by geometry and dictionaries: the reference of passes."""

from sequential import Bisection


class SequentialRemesh(Bisection):
    """A mesh that refines by recursion and removes vertices if all leaves around them are marked.

    A leaf is (level, four lattice points in Maubach order), as in ``Bisection``; ``parents`` has its parent.
    """

    def __init__(self, cells, level):
        self.parents = {}
        super().__init__(cells, level)

    def _descend(self, leaf, level):
        if leaf[0] < level:
            self._remember(leaf)
        super()._descend(leaf, level)

    def _bisect(self, leaf):
        self._remember(leaf)
        super()._bisect(leaf)

    def _remember(self, leaf):
        for child in self.children(leaf):
            self.parents[child] = leaf

    def _remove(self, leaf):
        self.leaves.remove(leaf)
        for edge in self._edges(leaf):
            self._around[edge].remove(leaf)

    def newest(self, leaf):
        """The vertex with which a leaf was made; None for roots."""
        parent = self.parents.get(leaf)
        return None if parent is None else next(iter(set(leaf[1:]) - set(parent[1:])))

    def remesh(self, marks, min_level=0, max_level=48):
        """One pass. ``marks``: leaf -> 1 for bisection, -1 for merging."""
        for leaf, mark in marks.items():
            if mark == 1 and leaf[0] < max_level:
                self.refine(leaf)
        willing = {leaf for leaf, mark in marks.items() if mark == -1 and leaf in self.leaves and leaf[0] > min_level}
        willing = {leaf for leaf in willing if leaf in self.parents and self._siblings(leaf) <= willing}
        around = {}
        for leaf in self.leaves:
            for vertex in leaf[1:]:
                around.setdefault(vertex, set()).add(leaf)
        for vertex, star in around.items():
            if star <= willing and all(self.newest(leaf) == vertex for leaf in star):
                parents = {self.parents[leaf] for leaf in star}
                for leaf in star:
                    self._remove(leaf)
                for parent in parents:
                    self._insert(parent)

    def _siblings(self, leaf):
        return set(self.children(self.parents[leaf]))
