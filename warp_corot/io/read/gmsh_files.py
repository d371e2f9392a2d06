"""Formats of Gmsh's library: .msh of every version, Medit's .mesh, I-deas' .unv and Nastran's .bdf."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .filemesh import Block, FileMesh, Unreadable, corners_note

#: Kinds by the names of Gmsh's element families.
KINDS = {
    "Tetrahedron": "tetra",
    "Hexahedron": "hexahedron",
    "Prism": "wedge",
    "Pyramid": "pyramid",
    "Triangle": "triangle",
    "Quadrilateral": "quad",
}
#: Names of groups that have none, by their dimension.
DIMENSIONS = ("point", "curve", "surface")
#: First words of .msh files. Gmsh takes other files for scripts and runs them.
BEGINNINGS = (b"$MeshFormat", b"$NOD", b"$Comments", b"$PhysicalNames")


def read(path: Path) -> FileMesh:
    """All elements of a file, with its physical groups, or else its entities, as arrays of numbers.

    Raises:
        Unreadable: With Gmsh's own message.
    """
    with path.open("rb") as file:
        start = file.read(512).lstrip(b"\xef\xbb\xbf \t\r\n")
    if path.suffix.lower() == ".msh" and not start.startswith(BEGINNINGS):
        raise Unreadable("it does not begin with $MeshFormat or $NOD")
    try:
        import gmsh
    except OSError as error:
        raise Unreadable(f"its library cannot be loaded: {error}") from None

    is_open = gmsh.isInitialized()  # by the caller, whose models stay
    if not is_open:
        gmsh.initialize(argv=["gmsh"], readConfigFiles=False, interruptible=False)
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.option.setNumber("General.NumThreads", 1)
    former = gmsh.model.getCurrent() if is_open else ""
    gmsh.model.add("warp_corot")
    gmsh.logger.start()
    try:
        return _merged(gmsh, path)
    finally:
        gmsh.logger.stop()
        gmsh.model.remove()
        if is_open:
            gmsh.model.setCurrent(former)
        else:
            gmsh.finalize()


def _merged(gmsh: Any, path: Path) -> FileMesh:
    """The elements of a file, which become those of Gmsh's current model."""
    try:
        gmsh.merge(str(path))
    except Exception as error:
        raise Unreadable(_reason(gmsh, str(error))) from None
    said = _reason(gmsh, "")
    mesh = _mesh(gmsh)
    if said and not mesh.solids and not mesh.faces:
        raise Unreadable(said)
    return mesh


def _reason(gmsh: Any, otherwise: str) -> str:
    errors = [line.partition("Error: ")[2] for line in gmsh.logger.get() if line.startswith("Error")]
    return "; ".join(dict.fromkeys(errors)) or otherwise


def _mesh(gmsh: Any) -> FileMesh:
    tags, coordinates, _ = gmsh.model.mesh.getNodes()
    order = np.argsort(tags, kind="stable")
    tags = np.asarray(tags, np.int64)[order]
    points = np.asarray(coordinates, np.float64).reshape(-1, 3)[order]
    blocks: list[Block] = []
    names: dict[str, dict[int, str]] = {}
    ignored: dict[str, int] = {}
    notes: list[str] = []
    for dimension, entity in gmsh.model.getEntities():
        groups = gmsh.model.getPhysicalGroupsForEntity(dimension, entity)
        group = int(groups[0]) if len(groups) else 0
        for kind, _, nodes in zip(*gmsh.model.mesh.getElements(dimension, entity), strict=True):
            name, _, order_, count, _, primary = gmsh.model.mesh.getElementProperties(kind)
            cells = np.asarray(nodes, np.int64).reshape(-1, count)
            known = KINDS.get(name.split()[0])
            if known is None:
                ignored[name.lower()] = ignored.get(name.lower(), 0) + len(cells)
                continue
            if order_ > 1:
                notes.append(corners_note(known, order_))
            corners = np.searchsorted(tags, cells[:, :primary])
            data = {"physical group": np.full(len(cells), group), "entity": np.full(len(cells), entity)}
            blocks.append(Block(known, corners, data))
            if group:
                said = gmsh.model.getPhysicalName(dimension, group)
                if said and dimension == 3:
                    names.setdefault("physical group", {})[group] = said
    return FileMesh(points, blocks, names, ignored, list(dict.fromkeys(notes)), _node_sets(gmsh, tags))


def _node_sets(gmsh: Any, tags: NDArray[np.int64]) -> dict[str, NDArray[np.int64]]:
    """The nodes of physical groups of points, curves and surfaces."""
    found = {}
    for dimension, group in gmsh.model.getPhysicalGroups():
        if dimension < 3:
            name = gmsh.model.getPhysicalName(dimension, group) or f"{DIMENSIONS[dimension]}_{group}"
            nodes, _ = gmsh.model.mesh.getNodesForPhysicalGroup(dimension, group)
            found[name] = np.unique(np.searchsorted(tags, np.asarray(nodes, np.int64)))
    return found
