"""Tetrahedra from USD stages: `UsdGeom.TetMesh` prims, and Mesh prims that carry ``tetraIndices``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import Usd, UsdGeom

from warp_corot.errors import InputError
from warp_corot.io.files.usd import first_value, in_world, metres_per_unit, open_stage, reads_stage
from warp_corot.io.read.filemesh import Block, FileMesh, sets_of_numbers


@reads_stage
def read_usd_tets(path: Path) -> FileMesh:
    """The tetrahedra of all prims of a stage, joined, in world space; none if no prim has any.

    The rest shape is the primvar ``rest`` if there is one (as in files of `UsdWriter`), else ``points`` at
    the default time, else at the first time sample, also if the mesh changes over time. Inactive and abstract
    prims are left out; instances are read. Node sets come from primvars of whole numbers.

    Args:
        path: A .usd, .usda, .usdc or .usdz file.

    Raises:
        InputError: The file is not a USD stage, or its indices are not a multiple of four or name no points.
    """
    stage = open_stage(path)
    all_points: list[NDArray[np.float64]] = [np.empty((0, 3))]
    blocks: list[Block] = []
    prims: list[tuple[str, int]] = []
    sets: dict[str, list[NDArray[np.int64]]] = {}
    offset = 0
    for prim in stage.Traverse(Usd.TraverseInstanceProxies()):
        indices = _tet_indices(prim, path)
        if indices is None or len(indices) == 0:
            continue
        points = _rest_points(prim, path)
        if indices.min() < 0 or indices.max() >= len(points):
            bad = indices[(indices < 0) | (indices >= len(points))][0]
            raise InputError(f"{path}: prim {prim.GetPath()} names point {bad} but has points 0 to {len(points) - 1}")
        all_points.append(in_world(prim, points))
        blocks.append(Block("tetra", indices + offset))
        name, taken = prim.GetName(), {known for known, _ in prims}
        prims.append((name if name not in taken else f"{name}_{len(prims) + 1}", len(indices)))
        for known, nodes in _node_sets(prim, len(points)).items():
            sets.setdefault(known, []).append(nodes + offset)
        offset += len(points)
    return FileMesh(
        np.concatenate(all_points),
        blocks,
        node_sets={known: np.concatenate(parts) for known, parts in sets.items()},
        metres=metres_per_unit(stage, path),
        up_axis=str(UsdGeom.GetStageUpAxis(stage)),
        objects=prims if len(prims) > 1 else [],
    )


def _node_sets(prim: Any, count: int) -> dict[str, NDArray[np.int64]]:
    """The node sets that a prim's primvars of whole numbers define."""
    found: dict[str, NDArray[np.int64]] = {}
    for primvar in UsdGeom.PrimvarsAPI(prim).GetPrimvars():
        if primvar.GetInterpolation() != UsdGeom.Tokens.vertex or primvar.IsIndexed():
            continue
        values = np.asarray(first_value(primvar))
        if values.shape == (count,) and values.dtype.kind in "iub":
            found |= sets_of_numbers(primvar.GetPrimvarName().replace(":", "_"), values.astype(np.int64))
    return found


def _tet_indices(prim, path: Path) -> NDArray[np.int64] | None:
    """Tetrahedra [T, 4] of a prim, or None if it has none."""
    if prim.IsA(UsdGeom.TetMesh):
        attribute = UsdGeom.TetMesh(prim).GetTetVertexIndicesAttr()
    elif prim.IsA(UsdGeom.PointBased) and prim.HasAttribute("tetraIndices"):
        attribute = prim.GetAttribute("tetraIndices")
    else:
        return None
    value = first_value(attribute)
    if value is None:
        return None
    flat = np.asarray(value).reshape(-1)
    if flat.dtype.kind not in "iu":
        raise InputError(f"{path}: {attribute.GetPath()} is of type {attribute.GetTypeName()}; it must be integers")
    if len(flat) % 4:
        raise InputError(f"{path}: {attribute.GetPath()} has {len(flat)} indices, not a multiple of four")
    return flat.astype(np.int64).reshape(-1, 4)


def _rest_points(prim, path: Path) -> NDArray[np.float64]:
    """Points [N, 3] of a prim at rest, in its own space."""
    value = first_value(UsdGeom.PointBased(prim).GetPointsAttr())
    if value is None or len(value) == 0:
        raise InputError(f"{path}: prim {prim.GetPath()} has tetrahedra but no points")
    rest = UsdGeom.PrimvarsAPI(prim).GetPrimvar("rest")
    if rest:
        rest_value = rest.ComputeFlattened()
        if rest_value is None:
            rest_value = rest.ComputeFlattened(Usd.TimeCode.EarliestTime())
        if rest_value is not None and len(rest_value) == len(value):
            value = rest_value
    return np.asarray(value, dtype=np.float64).reshape(-1, 3)
