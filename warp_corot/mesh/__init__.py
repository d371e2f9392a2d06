"""Meshes: the forest of bisected tetrahedra, tetrahedra of any shape, and surfaces that follow them."""

from warp_corot.mesh.surfaces.bound import BoundPoints, SurfaceMesh

from .forest import TetForest
from .tetmesh import TetMesh
from .tree import Tree

__all__ = ["BoundPoints", "SurfaceMesh", "TetForest", "TetMesh", "Tree"]
