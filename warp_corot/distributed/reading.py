"""Tetrahedral meshes from files, of which each rank reads its piece."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_axis, checked_number, checked_path, shown
from warp_corot.io.read.filemesh import INTERNAL, MOST_SETS, sets_of_numbers, whole_numbers
from warp_corot.io.read.regions import MOST as MOST_REGIONS
from warp_corot.io.read.regions import likeliest, numbered
from warp_corot.mesh import TetMesh

from . import mpi
from .assembling import Homes, assembled, fetched, moved_along_curve
from .divided_mesh import DividedForest, DividedTetMesh
from .scatter_mesh import divided

Longs = npt.NDArray[np.int64]

#: Files in VTK's HDF format, whose arrays can be read piece by piece; and the type of a tetrahedron in them.
SUFFIXES = (".vtkhdf", ".hdf")
TETRAHEDRON = 10
PACKAGE = 'files in VTK\'s HDF format need h5py; pip install "warp-corot[paraview]"'


def load(
    path: str | PathLike[str],
    scale: float = 1.0,
    *,
    unit: str | float | None = None,
    up_axis: str | None = None,
    regions: str | None = None,
) -> DividedForest | DividedTetMesh:
    """This rank's part of a file's tetrahedra, as of ``TetMesh.load``; all ranks must call this.

    Of a ``.vtkhdf`` file with nothing but tetrahedra, each rank reads a piece of the arrays. Ranks then exchange
    elements until each has those along its piece of a space-filling curve, and the neighbours of its nodes; no rank
    ever holds the whole mesh. Its labels and sets of nodes are those of the whole mesh, but its elements cannot share
    their dilatation. All other files are read by rank 0, which divides the mesh, like ``divided``.

    Args:
        path, scale, unit, up_axis, regions: As for ``TetMesh.load``; of ``.vtkhdf`` files, the unit must be None.

    Raises:
        InputError: On all ranks: MPI is not there, the file cannot be read, or there are fewer elements than ranks.
    """
    file, comm = checked_path(path, "path"), mpi.world()
    if file.suffix.lower() not in SUFFIXES or unit is not None:
        return divided(lambda: TetMesh.load(path, scale, unit=unit, up_axis=up_axis, regions=regions))
    checked_axis(up_axis or "Z")
    if not 0 < checked_number(scale, "scale") < np.inf:
        raise InputError(f"scale is {shown(scale)}; it must be a positive number")
    with _same_errors(file, comm) as failed:
        piece = _Piece.of(file, comm.rank, comm.size)
        failed.append(_fault(piece.points, piece.tets, int(piece.node_ends[-1])))
    homes = Homes(piece.points * scale, piece.node_ends, comm)
    elements = piece.element_ends[comm.rank] + np.arange(len(piece.tets), dtype=np.int64)
    of_cells, of_points = (_everywhere(arrays, comm) for arrays in (piece.of_cells, piece.of_points))
    if regions is not None and regions not in of_cells:
        known = ", ".join(of_cells) or "none"
        raise InputError(f"{file}: there is no array {regions!r} of whole numbers; there are: {known}")
    chosen = regions or likeliest(of_cells, {})

    def described(nodes: Longs, elements: Longs) -> dict[str, Any]:
        """The labels and sets of nodes of a part."""
        found: dict[str, Any] = {"node_sets": {}}
        if chosen is not None:
            own = fetched(piece.of_cells[chosen], piece.element_ends, elements, comm)
            named = numbered(chosen, own, of_cells[chosen])
            found |= {"labels": named.of_tet, "label_names": named.names}
        for name, there in of_points.items():
            if np.count_nonzero(there) <= MOST_SETS:
                own = fetched(piece.of_points[name], piece.node_ends, nodes, comm)
                found["node_sets"] |= sets_of_numbers(name, own, there)
        return found

    tets, elements = moved_along_curve(piece.tets, elements, homes, comm)
    if min(comm.allgather(len(tets))) == 0:
        raise InputError(f"{file} has too few elements for {comm.size} ranks; take fewer ranks")
    return assembled(tets, elements, int(piece.node_ends[-1]), homes, comm, described, up_axis=up_axis or "Z")


@dataclass(frozen=True, eq=False)
class _Piece:
    """A rank's piece of a file.

    Attributes:
        points: The coordinates of its nodes.
        tets: The nodes of its elements in the whole mesh, int64 [n, 4].
        node_ends, element_ends: The first node and element of each rank's piece, and the number of all, int64 [ranks
            + 1].
        of_points, of_cells: Its numbers in the file's arrays, int64; None where some are not whole.
    """

    points: npt.NDArray[np.float64]
    tets: Longs
    node_ends: Longs
    element_ends: Longs
    of_points: dict[str, Longs]
    of_cells: dict[str, Longs]

    @classmethod
    def of(cls, file: Path, rank: int, ranks: int) -> _Piece:
        """Read it."""
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
            node_ends, element_ends = (
                count * np.arange(ranks + 1, dtype=np.int64) // ranks for count in (nodes, cells)
            )
            start, stop = element_ends[rank : rank + 2].tolist()
            if (np.asarray(grid["Types"][start:stop]) != TETRAHEDRON).any():
                raise InputError(f"{file} has other cells than tetrahedra; give divided TetMesh.load")
            here = slice(*node_ends[rank : rank + 2].tolist())
            points = np.asarray(grid["Points"][here], np.float64)
            tets = np.asarray(grid["Connectivity"][4 * start : 4 * stop], np.int64).reshape(-1, 4)
            of_points = _numbers(grid.get("PointData", {}), here, nodes)
            of_cells = _numbers(grid.get("CellData", {}), slice(start, stop), cells)
        # The nodes of each of the file's own pieces are numbered from zero.
        own = np.searchsorted(np.cumsum(of_pieces["Cells"]), np.arange(start, stop), side="right")
        firsts = np.cumsum(of_pieces["Points"]) - of_pieces["Points"]
        return cls(points, tets + firsts[own][:, None], node_ends, element_ends, of_points, of_cells)


def _numbers(group: Any, here: slice, count: int) -> dict[str, Longs]:
    """A piece of the arrays of a group that have one whole number for each of ``count`` nodes or cells."""
    found = {}
    for name in sorted(group):
        array = group[name]
        if name not in INTERNAL and getattr(array, "shape", ())[:1] == (count,) and array.dtype.kind in "iubf":
            values = whole_numbers(array[here])
            if values is not None:
                found[name] = values
    return found


def _everywhere(arrays: dict[str, Longs], comm: Any) -> dict[str, Longs]:
    """The distinct numbers of the arrays that have whole numbers on all ranks, ascending."""
    told = comm.allgather({name: _few(values) for name, values in arrays.items()})
    common = [name for name in told[0] if all(name in each and each[name] is not None for each in told)]
    return {name: np.unique(np.concatenate([each[name] for each in told])) for name in common}


def _few(values: Longs) -> Longs | None:
    """The distinct numbers; None if there are more than any regions or sets have."""
    found = np.unique(values)
    return found if len(found) <= MOST_REGIONS + 1 else None


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
