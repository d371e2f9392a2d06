"""Meshes: the forest of bisected tetrahedra, and tetrahedra of any shape."""

from .forest import TetForest, Tree
from .tetmesh import TetMesh

__all__ = ["TetForest", "TetMesh", "Tree"]
