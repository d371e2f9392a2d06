"""The nodes of a forest by tree level, found by walking down its tree on the host."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warp_corot.mesh.bisection import far_end
from warp_corot.mesh.tree import LIVE, Tree


@dataclass(frozen=True)
class TreeLevels:
    """By the mesh's own numbers: level and ends of the nodes of tetrahedra with leaves below them, and the finest level
    of those around each; -1 for other nodes."""

    level: np.ndarray
    ends: np.ndarray
    finest: np.ndarray

    @classmethod
    def of(cls, tree: Tree, place_count: int) -> TreeLevels:
        alive = tree.first_child == LIVE
        for element in np.argsort(-tree.level, kind="stable"):
            if alive[element] and tree.parent[element] >= 0:
                alive[tree.parent[element]] = True
        level, finest = np.full(place_count, -1), np.full(place_count, -1)
        ends = np.full((place_count, 2), -1)
        for element in np.flatnonzero(alive):
            nodes, depth = tree.tets[element], int(tree.level[element])
            finest[nodes] = np.maximum(finest[nodes], depth)
            if tree.parent[element] < 0:
                level[nodes] = 0
            child = tree.first_child[element]
            if child >= 0:
                (middle,) = set(tree.tets[child]) - set(nodes)
                assert level[middle] in (-1, depth + 1)
                level[middle] = depth + 1
                ends[middle] = sorted((nodes[0], nodes[far_end(depth % 3)]))
        return cls(level, ends, finest)

    def prolongation(self, places: np.ndarray, coarse: int, fine: int) -> np.ndarray:
        """From the nodes up to a level to those up to a finer one, dense, float64: rows and columns are numbers, those
        of other nodes are zero.

        Args:
            places: Place of the node with each number.
        """
        count = len(places)
        number = np.full(len(self.level), -1)
        number[places] = np.arange(count)
        matrix = np.diag(np.where(self.level[places] <= coarse, 1.0, 0.0))
        for level in range(coarse + 1, fine + 1):
            of_level = np.flatnonzero(self.level[places] == level)
            a, b = number[self.ends[places[of_level]]].T
            matrix[of_level] = 0.5 * (matrix[a] + matrix[b])
        return matrix
