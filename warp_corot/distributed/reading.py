"""Tetrahedral meshes from files, of which each rank reads its piece."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_axis, checked_number, checked_path, shown
from warp_corot.mesh import TetMesh

from . import mpi
from .assembling import Homes, assembled, moved_along_curve
from .dividing import divided
from .part_meshes import ForestPart, MeshPart

Longs = npt.NDArray[np.int64]

#: Files in VTK's HDF format, whose arrays can be read piece by piece; and the type of a tetrahedron in them.
SUFFIXES = (".vtkhdf", ".hdf")
TETRAHEDRON = 10
PACKAGE = 'files in VTK\'s HDF format need h5py; pip install "warp-corot[paraview]"'


def load(
    path: str | PathLike[str], scale: float = 1.0, *, unit: str | float | None = None, up_axis: str | None = None
) -> ForestPart | MeshPart:
    """This rank's part of a file's tetrahedra, as of ``TetMesh.load``; all ranks must call this.

    Of a ``.vtkhdf`` file with nothing but tetrahedra, each rank reads a piece of the arrays. Ranks then exchange
    elements until each has those along its piece of a space-filling curve, and the neighbours of its nodes; no rank
    ever holds the whole mesh. Such a mesh has no labels and no sets of nodes, and its elements cannot share their
    dilatation. All other files are read by rank 0, which divides the mesh, like ``divided``.

    Args:
        path, scale, unit, up_axis: As for ``TetMesh.load``; of ``.vtkhdf`` files, the unit must be None.

    Raises:
        InputError: On all ranks: MPI is not there, the file cannot be read, or there are fewer elements than ranks.
    """
    file, comm = checked_path(path, "path"), mpi.world()
    if file.suffix.lower() not in SUFFIXES or unit is not None:
        return divided(lambda: TetMesh.load(path, scale, unit=unit, up_axis=up_axis))
    checked_axis(up_axis or "Z")
    if not 0 < checked_number(scale, "scale") < np.inf:
        raise InputError(f"scale is {shown(scale)}; it must be a positive number")
    with _same_errors(file, comm) as failed:
        points, tets, first, ends = _piece(file, comm.rank, comm.size)
        failed.append(_fault(points, tets, int(ends[-1])))
    homes = Homes(points * scale, ends, comm)
    elements = first + np.arange(len(tets), dtype=np.int64)
    tets, elements = moved_along_curve(tets, elements, homes, comm)
    if min(comm.allgather(len(tets))) == 0:
        raise InputError(f"{file} has too few elements for {comm.size} ranks; take fewer ranks")
    return assembled(tets, elements, int(ends[-1]), homes, comm, up_axis=up_axis or "Z")


def _piece(file: Path, rank: int, ranks: int) -> tuple[npt.NDArray[np.float64], Longs, int, Longs]:
    """A rank's piece of a file: the coordinates of its nodes, the nodes of its elements, the number of its first
    element, and the first node of each rank's piece."""
    try:
        import h5py
    except ImportError:
        raise InputError(PACKAGE) from None
    with h5py.File(file, "r") as opened:
        grid = opened["VTKHDF"]
        of_pieces = {
            name: np.asarray(grid[f"NumberOf{name}"], np.int64) for name in ("Points", "Cells", "ConnectivityIds")
        }
        if "Steps" in grid or not np.array_equal(of_pieces["ConnectivityIds"], 4 * of_pieces["Cells"]):
            raise InputError(f"{file} has other cells than tetrahedra, or several times; give divided TetMesh.load")
        nodes, cells = (int(of_pieces[name].sum()) for name in ("Points", "Cells"))
        ends = nodes * np.arange(ranks + 1, dtype=np.int64) // ranks
        start, stop = (cells * each // ranks for each in (rank, rank + 1))
        if (np.asarray(grid["Types"][start:stop]) != TETRAHEDRON).any():
            raise InputError(f"{file} has other cells than tetrahedra; give divided TetMesh.load")
        points = np.asarray(grid["Points"][ends[rank] : ends[rank + 1]], np.float64)
        tets = np.asarray(grid["Connectivity"][4 * start : 4 * stop], np.int64).reshape(-1, 4)
    # The nodes of each of the file's own pieces are numbered from zero.
    own = np.searchsorted(np.cumsum(of_pieces["Cells"]), np.arange(start, stop), side="right")
    firsts = np.cumsum(of_pieces["Points"]) - of_pieces["Points"]
    return points, tets + firsts[own][:, None], start, ends


def _fault(points: npt.NDArray[np.float64], tets: Longs, count: int) -> str | None:
    """What is wrong with a piece, if anything."""
    if not np.isfinite(points).all():
        return "a node has coordinates that are not finite"
    if tets.size and (tets.min() < 0 or tets.max() >= count):
        return f"a tetrahedron names the nodes {tets[((tets < 0) | (tets >= count)).any(axis=1)][0].tolist()}"
    return None


@contextmanager
def _same_errors(file: Path, comm: Any) -> Iterator[list[str | None]]:
    """Collect what is wrong on this rank; all ranks raise the first error of any."""
    failed: list[str | None] = []
    try:
        yield failed
    except InputError as error:
        failed.append(str(error))
    except Exception as error:  # any error of h5py, the system, or missing names
        failed.append(f"{file} cannot be read: {' '.join(str(error).split())[:160]}")
    for each in comm.allgather(next((said for said in failed if said), None)):
        if each is not None:
            raise InputError(each if str(file) in each or each == PACKAGE else f"{file}: {each}")
