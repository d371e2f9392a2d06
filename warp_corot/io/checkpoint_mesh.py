"""Meshes in checkpoints."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from ..mesh import TetForest, TetMesh, Tree

#: What forests have that were made from a domain.
OF_DOMAIN = ("phi", "fill", "labels", "node_labels")


def pack_mesh(mesh: TetForest | TetMesh, prefix: str, arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    """Put a mesh into arrays whose names begin with ``prefix``; returns what else there is, for JSON."""
    if isinstance(mesh, TetMesh):
        arrays[prefix + "points"], arrays[prefix + "tets"] = mesh.points, mesh.tets
        return {"kind": "general", "up_axis": mesh.up_axis, "repaired": mesh.repaired}
    arrays[prefix + "lattice"], arrays[prefix + "node_ends"] = mesh.lattice, mesh.node_ends
    for field in dataclasses.fields(Tree):
        arrays[f"{prefix}tree.{field.name}"] = getattr(mesh.tree, field.name)
    of_domain = [name for name in OF_DOMAIN if getattr(mesh, name) is not None]
    for name in of_domain:
        arrays[f"{prefix}domain.{name}"] = getattr(mesh, name)
    return {
        "kind": "forest",
        "of_domain": of_domain,
        "label_names": mesh.label_names,
        "up_axis": mesh.up_axis,
        "cells": mesh.cells,
        "cell_size": mesh.cell_size,
        "origin": mesh.origin,
    }


def unpack_mesh(described: dict[str, Any], prefix: str, arrays: dict[str, np.ndarray]) -> TetForest | TetMesh:
    """The mesh that ``pack_mesh`` put there."""
    if described["kind"] == "general":
        mesh = TetMesh(arrays[prefix + "points"], arrays[prefix + "tets"], up_axis=described["up_axis"])
        mesh.repaired = described["repaired"]
        return mesh
    tree = Tree(**{field.name: arrays[f"{prefix}tree.{field.name}"] for field in dataclasses.fields(Tree)})
    x, y, z = described["cells"]
    a, b, c = described["origin"]
    lattice, ends = arrays[prefix + "lattice"], arrays[prefix + "node_ends"]
    of_domain = {name: arrays[f"{prefix}domain.{name}"] for name in described["of_domain"]}
    names = tuple(described["label_names"])
    up_axis = described["up_axis"]
    return TetForest(
        (x, y, z), described["cell_size"], (a, b, c), lattice, ends, tree, up_axis, label_names=names, **of_domain
    )
