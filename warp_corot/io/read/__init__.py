"""Readers of mesh files, one module for each family of formats."""

from .filemesh import Block, FileMesh, split_solids, triangles_of
from .files import SUFFIXES, read_mesh_file

__all__ = ["SUFFIXES", "Block", "FileMesh", "read_mesh_file", "split_solids", "triangles_of"]
