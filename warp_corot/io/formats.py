"""Tetrahedral meshes from files: USD, and whatever with tetrahedra meshio reads."""

import contextlib
import io
import logging
import os
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .assets import find_asset

USD_SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class LoadedMesh:
    """A tetrahedral mesh as it came from a file.

    Attributes:
        points: Rest positions, float64 [N, 3] [m].
        tets: Vertex indices, int32 [T, 4]; orientation as in the file.
        up_axis: "X", "Y" or "Z". Formats that name none get "Z", the habit of the meshers that write them.
        metres_per_unit: Length of the file's unit [m], before ``scale``.
        name: Short name, fit for a title.
        source: The file it was read from.
    """

    points: NDArray[np.float64]
    tets: NDArray[np.int32]
    up_axis: str
    metres_per_unit: float
    name: str
    source: Path


def load_tets(path: str | PathLike[str], scale: float = 1.0) -> LoadedMesh:
    """Loads the tetrahedra of a file, in metres.

    USD stages are read with OpenUSD (unit, up axis and world transforms applied, several prims joined); other files
    with meshio (``pip install "warp-corot[mesh]"``), taken as metres: all blocks of tetrahedra, of second-order ones
    their four corners. ``warp:NAME`` names an asset in Warp's wheel, see `warp_corot.io.assets`.

    Args:
        path: File, or asset name.
        scale: Factor on all coordinates, after the file's own unit.

    Returns:
        The mesh. Elements are not judged here (orientation, volume): `TetMesh` does that.

    Raises:
        InputError: No such file, not a mesh, no tetrahedra, coordinates that are not finite, indices out of range,
            a scale that is not positive; one line that says which.
    """
    if not (np.isfinite(scale) and scale > 0.0):
        raise InputError(f"scale is {scale}, should be a positive number")
    asset = find_asset(path)
    source = asset.path if asset else Path(path)
    if source.is_dir():
        raise InputError(f"{source}: is a folder, should be a mesh file")
    if not source.exists():
        raise InputError(f"{source}: no such file")
    try:
        with source.open("rb") as file:
            if not file.read(1):
                raise InputError(f"{source}: is empty")
    except OSError as error:
        raise InputError(f"{source}: cannot be read ({error.strerror})") from None

    if source.suffix.lower() in USD_SUFFIXES:
        from .usd_reader import read_usd_tets

        points, tets, up_axis, metres = read_usd_tets(source)
    else:
        points, tets, up_axis, metres = _read_meshio(source)
    if len(tets) == 0:
        raise InputError(f"{source}: has no tetrahedra")
    if tets.min() < 0 or tets.max() >= len(points):
        row, column = np.argwhere((tets < 0) | (tets >= len(points)))[0]
        raise InputError(
            f"{source}: tetrahedron {row} names point {tets[row, column]} but the points are 0 to {len(points) - 1}"
        )
    points = points * scale
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        bad = int(np.argmin(finite))
        raise InputError(f"{source}: point {bad} has coordinates {points[bad].tolist()}, should be finite")
    # As UTF-8 whatever the locale is; what cannot be shown becomes a question mark.
    name = asset.name if asset else os.fsencode(source.stem).decode("utf-8", "replace")
    return LoadedMesh(points, tets.astype(np.int32), up_axis, metres, name, source)


def _read_meshio(path: Path) -> tuple[NDArray[np.float64], NDArray[Any], str, float]:
    try:
        import meshio
    except ImportError:
        raise InputError(
            f'{path}: reading {path.suffix or "this"} files needs: pip install "warp-corot[mesh]"'
        ) from None

    known = sorted(meshio.extension_to_filetypes)
    if path.suffix.lower() not in known:
        raise InputError(
            f"{path}: unknown format {path.suffix or '(no extension)'}, should be {', '.join(USD_SUFFIXES)} "
            f"or one that meshio reads, such as .msh, .vtk, .vtu, .mesh"
        )
    # meshio prints its complaints, and on a file that none of its readers takes it leaves the interpreter.
    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            mesh = meshio.read(path)
    except (Exception, SystemExit) as error:
        what = " ".join(str(error).split()) if not isinstance(error, SystemExit) else ""
        raise InputError(
            f"{path}: is not a {path.suffix} file that meshio can read{f' ({what[:120]})' if what else ''}"
        ) from None

    blocks = [np.asarray(block.data)[:, :4] for block in mesh.cells if block.type in ("tetra", "tetra10")]
    if any(block.type == "tetra10" and len(block.data) for block in mesh.cells):
        log.warning("%s: second-order tetrahedra are read as first-order ones, by their four corners", path)
    if not sum(len(block) for block in blocks):
        kinds = ", ".join(sorted({block.type for block in mesh.cells})) or "none"
        raise InputError(f"{path}: has no tetrahedra (cell types: {kinds})")
    points = np.asarray(mesh.points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"{path}: points have shape {points.shape}, should be [N, 3]")
    tets = np.concatenate(blocks).astype(np.int64)
    return points, tets, "Z", 1.0
