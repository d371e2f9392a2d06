"""Meshes that one rank makes and divides: the other ranks get only their parts."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from os import PathLike
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_corot.contact.skin import has_own_surface
from warp_corot.discretization.elements import Mesh
from warp_corot.errors import InputError
from warp_corot.inputs.checks import shown
from warp_corot.io.checkpoint.mesh import box_level
from warp_corot.mesh import TetForest, TetMesh
from warp_corot.mesh.surfaces.boundary import boundary_faces
from warp_corot.mesh.uniform_part import SUBTREE_DEPTH

from . import mpi
from .boxes import box
from .divided_mesh import DividedForest, DividedTetMesh, Numbers
from .partition import Partition
from .parts import numbered_part

#: The tag of the messages that bring parts.
TAG = 77

#: A rank's part on its way: the class or the function that makes it, its arguments and its options.
Piece = tuple[Callable[..., Any], tuple[Any, ...], dict[str, Any]]


def divided(make: Callable[[], Mesh], *, costs: npt.ArrayLike | None = None) -> DividedForest | DividedTetMesh:
    """This rank's part of a mesh that rank 0 makes; all ranks must call this.

    Only rank 0 calls ``make``, and afterwards it keeps only its part. So one machine holds the whole mesh once, not
    once for each rank. ``SoftBody`` and ``Simulation`` take the part like a whole mesh, as they take that of ``box``;
    the part has the labels of its elements. A run gives the same results as with the whole mesh, and the same bits on
    the CPU with ``deterministic=True``.

    Args:
        make: Makes the mesh, for example ``lambda: TetForest.from_domain(domain, target_elements=10**6)`` or
            ``lambda: TetMesh.load("organ.vtu")``.
        costs: The cost of an element on each rank, in any unit, [ranks]; None: the same everywhere.

    Raises:
        InputError: On all ranks: MPI is not there, ``make`` raises one or gives no mesh, or the mesh has fewer groups
            of elements than ranks.
    """
    comm = mpi.world()

    def pieces() -> Iterator[Piece]:
        mesh = make()
        if not isinstance(mesh, TetForest | TetMesh):
            raise InputError(f"make gives {shown(mesh)}; it must give a TetForest or a TetMesh")
        return (piece for piece, _ in pieces_of(mesh, dealt(mesh, comm.size, costs), costs))

    kind, place, options = handed_out(pieces, comm)
    made: DividedForest | DividedTetMesh = kind(*place, **options)
    return made


def load(
    path: str | PathLike[str],
    scale: float = 1.0,
    *,
    unit: str | float | None = None,
    up_axis: str | None = None,
    regions: str | None = None,
) -> DividedForest | DividedTetMesh:
    """This rank's part of a file's tetrahedra, which rank 0 reads and divides; all ranks must call this.

    Args:
        path, scale, unit, up_axis, regions: As for ``TetMesh.load``.

    Raises:
        InputError: On all ranks: as for ``divided``, or the file cannot be read.
    """
    return divided(lambda: TetMesh.load(path, scale, unit=unit, up_axis=up_axis, regions=regions))


def handed_out(make: Callable[[], Iterator[Any]], comm: Any) -> Any:
    """What an iterator on rank 0 yields for this rank; all ranks must call this.

    The other ranks wait as long as rank 0 needs, without keeping cores busy.

    Raises:
        InputError: On all ranks, if ``make`` or the iterator raises one.
    """
    mine: Any = None
    if comm.rank == 0:
        try:
            given = make()
            mine = next(given)
            for rank, piece in enumerate(given, start=1):
                comm.send(piece, rank, TAG)
        except InputError as error:
            mine = error
            dismiss(error, comm)
    else:
        mine = mpi.awaited(comm.unwatched, 0, TAG)
    if isinstance(mine, InputError):
        raise mine
    return mine


def dismiss(error: InputError, comm: Any) -> None:
    """On rank 0: let ``handed_out`` raise this error on all other ranks."""
    for rank in range(1, comm.size):
        comm.send(InputError(str(error)), rank, TAG)


def dealt(mesh: Mesh, ranks: int, costs: npt.ArrayLike | None = None) -> Partition:
    """The division of a mesh that is handed out. Elements that may share their dilatation stay together.

    Raises:
        InputError: As ``Partition.of``.
    """
    return Partition.of(mesh, ranks, costs, grouped=isinstance(mesh, TetMesh))


def pieces_of(mesh: Mesh, division: Partition, costs: npt.ArrayLike | None = None) -> Iterator[tuple[Piece, Numbers]]:
    """Each rank's part, one after another, and the numbers in it; of a box, how all ranks make their parts."""
    level = box_level(mesh) if isinstance(mesh, TetForest) else None
    outer = boundary_faces(mesh.tets)[0]
    used = mesh.points[np.unique(mesh.tets)]
    whole: dict[str, Any] = {
        "element_count": len(mesh.tets),
        "bounds": np.stack([used.min(axis=0), used.max(axis=0)]),
        "smallest_volume": float(np.min(mesh.volumes)),
    }
    for rank in range(1 + int(division.rank_of_element.max())):
        part, numbers = numbered_part(mesh, division, rank, prunes=True)
        if level is not None and level >= SUBTREE_DEPTH:
            assert isinstance(mesh, TetForest)
            like = {"origin": mesh.origin, "up_axis": mesh.up_axis, "costs": costs}
            yield (box, (mesh.cells, mesh.cell_size, level), like), numbers
            continue
        own = {"numbers": numbers, "outer": _here(outer, numbers.nodes, len(mesh.points))}
        given: dict[str, Any] = {"up_axis": mesh.up_axis, "label_names": mesh.label_names}
        given["labels"] = None if mesh.labels is None else mesh.labels[numbers.elements]
        if isinstance(part, TetForest):
            place: tuple[Any, ...] = (part.cells, part.cell_size, part.origin, part.lattice, part.node_ends, part.tree)
            given |= {"fill": part.fill, "leaf_groups": part.leaf_groups}
            given["of_whole"] = whole | own | {"is_embedded": has_own_surface(mesh)}
            yield (DividedForest, place, given), numbers
        else:
            assert isinstance(mesh, TetMesh)
            sets = {name: mask[numbers.nodes] for name, mask in mesh.node_sets.items()}
            given |= {"element_groups": part.element_groups, "node_sets": sets, "of_whole": whole | own}
            yield (DividedTetMesh, (part.points, part.tets), given), numbers


def _here(faces: npt.NDArray[np.int32], nodes: npt.NDArray[np.integer], count: int) -> npt.NDArray[np.int32]:
    """The triangles with all corners among some nodes, by the numbers that they have there, int32 [F, 3]."""
    number = np.full(count, -1, np.int32)
    number[nodes] = np.arange(len(nodes), dtype=np.int32)
    found = number[faces]
    return found[(found >= 0).all(axis=1)]
