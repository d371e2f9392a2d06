"""Readers of mesh files, one module for each family of formats."""

from .filemesh import SUFFIXES, Block, FileMesh, read_mesh_file, split_solids, triangles_of

__all__ = ["SUFFIXES", "Block", "FileMesh", "read_mesh_file", "split_solids", "triangles_of"]
