"""VTK's own readers: legacy .vtk of every version, and XML: .vtu .vtp .vtm .vts .vtr .vti and parallel ones."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkCommonCore import vtkOutputWindow, vtkStringOutputWindow
from vtkmodules.vtkCommonDataModel import (
    vtkCompositeDataSet,
    vtkImageData,
    vtkPolyData,
    vtkRectilinearGrid,
    vtkStructuredGrid,
    vtkUnstructuredGrid,
)
from vtkmodules.vtkFiltersCore import vtkAppendFilter, vtkTriangleFilter
from vtkmodules.vtkFiltersGeneral import vtkDataSetTriangleFilter

from .filemesh import (
    CORNERS,
    Block,
    FileMesh,
    LoadedVolume,
    Unreadable,
    corners_note,
    joined_meshes,
    sets_of_numbers,
    whole_numbers,
)

#: The module of VTK and its reader of files that are not XML.
BY_SUFFIX = {".vtk": ("vtkIOLegacy", "vtkGenericDataObjectReader"), ".vtkhdf": ("vtkIOHDF", "vtkHDFReader")}
VOXEL, PIXEL = 11, 8
#: The order of their corners in the other kinds.
ORDERS = {VOXEL: (0, 1, 3, 2, 4, 5, 7, 6), PIXEL: (0, 1, 3, 2)}
#: VTK's cell types by the kind that their corners make; corners come first in cells of any order.
KINDS = {
    "tetra": (10, 24, 71, 78, 82),
    "hexahedron": (12, 25, 29, 33, 72, 79, VOXEL),
    "wedge": (13, 26, 31, 32, 73, 80),
    "pyramid": (14, 27, 37, 74, 81),
    "triangle": (5, 22, 34, 69, 76),
    "quad": (9, 23, 28, 30, 70, 77, PIXEL),
}
LINEAR = {10, 12, 13, 14, 5, 9, VOXEL, PIXEL}
#: Arrays of VTK that number neither regions nor sets of nodes.
INTERNAL = (
    *("vtkGhostType", "vtkOriginalCellIds", "vtkOriginalPointIds"),
    *("GlobalCellIds", "GlobalElementId", "GlobalPointIds", "GlobalNodeId"),
)
#: Polygons, strips, prisms with five and six sides and polyhedra, which VTK itself splits, with all cells beside them.
MANY_FACED = {6: "strips", 7: "polygons", 15: "pentagonal prisms", 16: "hexagonal prisms", 42: "polyhedra"}


def read(path: Path) -> FileMesh | LoadedVolume:
    """The cells of a file, or the voxels of an image.

    Raises:
        Unreadable: With VTK's own message.
    """
    window, former = vtkStringOutputWindow(), vtkOutputWindow.GetInstance()
    vtkOutputWindow.SetInstance(window)
    try:
        module, kind = BY_SUFFIX.get(path.suffix.lower(), ("vtkIOXML", "vtkXMLGenericDataObjectReader"))
        reader = getattr(import_module(f"vtkmodules.{module}"), kind)()
        reader.SetFileName(str(path))
        readable = not hasattr(reader, "CanReadFile") or reader.CanReadFile(str(path))
        if readable:
            reader.Update()
            data = reader.GetOutputDataObject(0)
    finally:
        vtkOutputWindow.SetInstance(former)
    said = _errors(window.GetOutput())
    if not readable or said or data is None:
        start = path.read_bytes()[:64]
        begins = f"its root element is not a VTKFile of this kind (it begins {start[:40].decode(errors='replace')!r})"
        raise Unreadable(said or (begins if start.lstrip().startswith(b"<") else "it does not begin like XML"))
    if isinstance(data, vtkImageData):
        return _image(data)
    leaves = list(_leaves(data, ""))
    if not leaves:
        raise Unreadable(f"it holds {data.GetClassName()}, which is empty or not a mesh")
    parts = [(name, _mesh(leaf)) for name, leaf in leaves]
    if len(parts) == 1:
        return parts[0][1]
    for number, (_, mesh) in enumerate(parts, start=1):
        for block in mesh.blocks:
            block.data["block"] = np.full(len(block.nodes), number)
    return joined_meshes(parts, objects=[], names={"block": {k: name for k, (name, _) in enumerate(parts, start=1)}})


def _errors(said: str) -> str:
    """The messages in VTK's output, without the places in its code."""
    found = []
    for part in said.split("ERROR: ")[1:]:
        text = part.split("\n\n")[0]
        lines = [line.strip() for line in text.splitlines()[1:] if line.strip()]
        words = " ".join(lines)
        _, address, message = words.partition("): ")
        said_of_itself = message if address else words
        if not said_of_itself.startswith("Algorithm "):  # a message that only repeats the failure
            found.append(said_of_itself)
    return "; ".join(dict.fromkeys(filter(None, found)))


def _leaves(data: Any, name: str) -> Iterator[tuple[str, Any]]:
    """The data sets of a file with their names; those in a composite one by one."""
    if isinstance(data, vtkCompositeDataSet):
        iterator = data.NewIterator()
        iterator.SkipEmptyNodesOn()
        iterator.InitTraversal()
        while not iterator.IsDoneWithTraversal():
            leaf = iterator.GetCurrentDataObject()
            info = iterator.GetCurrentMetaData() if iterator.HasCurrentMetaData() else None
            own = info.Get(vtkCompositeDataSet.NAME()) if info is not None else None
            yield from _leaves(leaf, own or f"block {iterator.GetCurrentFlatIndex()}")
            iterator.GoToNextItem()
    elif isinstance(data, vtkStructuredGrid | vtkRectilinearGrid | vtkImageData):
        yield name, _filtered(vtkAppendFilter(), data)
    elif isinstance(data, vtkUnstructuredGrid | vtkPolyData) and data.GetNumberOfCells():
        yield name, data


def _mesh(data: Any) -> FileMesh:
    points, sets = np.empty((0, 3)), dict[str, NDArray[np.int64]]()
    if data.GetPoints() is not None:
        points = np.array(vtk_to_numpy(data.GetPoints().GetData()), dtype=np.float64)
    for array, numbers in _whole_arrays(data.GetPointData(), data.GetNumberOfPoints()).items():
        sets |= sets_of_numbers(array, numbers)
    if isinstance(data, vtkPolyData):
        # VTK itself triangulates strips and general polygons.
        data = _filtered(vtkTriangleFilter(), data, "PassLinesOff", "PassVertsOff")
        triangles = _ints(data.GetPolys().GetConnectivityArray()).reshape(-1, 3)
        block = Block("triangle", triangles, _whole_arrays(data.GetCellData(), len(triangles)))
        return FileMesh(points, [block], node_sets=sets)
    types, blocks, notes, ignored = _types(data), list[Block](), list[str](), dict[str, int]()
    if found := set(types.tolist()) & MANY_FACED.keys():
        split = ", ".join(MANY_FACED[number] for number in sorted(found))
        notes.append(f"{split} are split into tetrahedra or triangles by VTK")
        data = _filtered(vtkDataSetTriangleFilter(), data)
        types = _types(data)
    array, arrays = data.GetCells(), _whole_arrays(data.GetCellData(), data.GetNumberOfCells())
    offsets, nodes = _ints(array.GetOffsetsArray()), _ints(array.GetConnectivityArray())
    if len(offsets) != len(types) + 1 or (np.diff(offsets) < 0).any() or offsets[-1] > len(nodes):
        raise Unreadable("the offsets of its cells do not fit their number")
    kinds = {number: kind for kind, numbers in KINDS.items() for number in numbers}
    for number in np.unique(types).tolist():
        cells, kind = np.flatnonzero(types == number), kinds.get(number)
        if kind is None:
            ignored[f"VTK's type {number}" if number > 4 else "line"] = len(cells)
            continue
        short = np.flatnonzero(offsets[cells + 1] - offsets[cells] < CORNERS[kind])
        if len(short):
            raise Unreadable(f"cell {cells[short[0]]}, a {kind}, has fewer than {CORNERS[kind]} corners")
        order = ORDERS.get(number, range(CORNERS[kind]))
        corners = nodes[offsets[cells][:, None] + np.array(order)]
        blocks.append(Block(kind, corners, {name: values[cells] for name, values in arrays.items()}))
        if number not in LINEAR:
            notes.append(corners_note(kind, 2 if number < 69 else None))
    return FileMesh(points, blocks, ignored=ignored, notes=list(dict.fromkeys(notes)), node_sets=sets)


def _filtered(filtering: Any, data: Any, *options: str) -> Any:
    """The output of a filter of VTK."""
    for option in options:
        getattr(filtering, option)()
    filtering.SetInputData(data)
    filtering.Update()
    return filtering.GetOutput()


def _types(data: Any) -> NDArray[np.int64]:
    array = data.GetCellTypes() if hasattr(data, "GetCellTypes") else None
    if array is None or not hasattr(array, "GetNumberOfTuples"):
        array = data.GetCellTypesArray()
    return _ints(array)


def _whole_arrays(arrays: Any, count: int) -> dict[str, NDArray[np.int64]]:
    found = {}
    for k in range(arrays.GetNumberOfArrays()):
        array, name = arrays.GetArray(k), arrays.GetArrayName(k)
        if isinstance(name, bytes):  # VTK's answer where a name is not UTF-8
            name = name.decode(errors="replace")
        if array is None or not name or name in INTERNAL:
            continue
        values = whole_numbers(vtk_to_numpy(array))
        if values is not None and len(values) == count:
            found[name] = values
    return found


def _ints(array: Any) -> NDArray[np.int64]:
    """Whole numbers, also from VTK's implicit arrays."""
    try:
        return np.array(vtk_to_numpy(array), dtype=np.int64)
    except (AttributeError, TypeError, ValueError, AssertionError):
        return np.array([array.GetComponent(k, 0) for k in range(array.GetNumberOfTuples())], dtype=np.int64)


def _image(grid: Any) -> LoadedVolume:
    extent = np.array(grid.GetExtent()).reshape(3, 2)
    at_points = grid.GetPointData().GetNumberOfArrays() > 0
    data = grid.GetPointData() if at_points else grid.GetCellData()
    array = data.GetScalars()
    if array is None and data.GetNumberOfArrays() == 1:
        array = data.GetArray(0)
    shape = extent[:, 1] - extent[:, 0] + (1 if at_points else 0)
    if array is None or array.GetNumberOfTuples() != np.prod(shape):
        names = ", ".join(str(data.GetArrayName(k)) for k in range(data.GetNumberOfArrays())) or "none"
        raise Unreadable(f"no whole array of scalars chosen; its arrays: {names}")
    if array.GetNumberOfComponents() != 1:
        raise Unreadable(f"it has {array.GetNumberOfComponents()} numbers a voxel; it must have one")
    matrix = grid.GetIndexToPhysicalMatrix()
    affine = np.array([[matrix.GetElement(i, j) for j in range(4)] for i in range(4)])
    affine[:3, 3] += affine[:3, :3] @ (extent[:, 0] + (0.0 if at_points else 0.5))
    notes = [] if at_points else ["values belong to cells: voxel centres lie between the grid's points"]
    values = np.array(vtk_to_numpy(array).reshape(tuple(shape), order="F"), order="F")
    return LoadedVolume(values, affine, notes)
