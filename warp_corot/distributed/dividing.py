"""Meshes that one rank makes and divides: the other ranks get only their parts."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_corot.errors import InputError
from warp_corot.inputs.checks import shown
from warp_corot.mesh import TetForest
from warp_corot.mesh.surfaces.boundary import boundary_faces

from . import mpi
from .partition import Partition
from .parts import ForestPart, Numbers, part_of_mesh

#: The tag of the messages that bring parts.
TAG = 77


def divided(make: Callable[[], TetForest], *, costs: npt.ArrayLike | None = None) -> ForestPart:
    """This rank's part of a forest that rank 0 makes; all ranks must call this.

    Only rank 0 calls ``make``, and afterwards it keeps only its part. So one machine holds the whole mesh once, not
    once for each rank. ``SoftBody`` and ``Simulation`` take the part like a whole mesh, as they take that of ``box``;
    the part has the labels of its leaves. A run gives the same results as with the whole mesh, and the same bits on the
    CPU with ``deterministic=True``.

    Args:
        make: Makes the forest, for example ``lambda: TetForest.from_domain(domain, target_elements=10**6)``.
        costs: The cost of an element on each rank, in any unit, [ranks]; None: the same everywhere.

    Raises:
        InputError: On all ranks: MPI is not there, ``make`` raises one or gives no ``TetForest``, or the mesh has fewer
            groups of elements than ranks.
    """
    comm = mpi.world()
    mine: Any = None
    if comm.rank == 0:
        try:
            pieces = _pieces(make, comm.size, costs)
            mine = next(pieces)
            for rank, piece in enumerate(pieces, start=1):
                comm.send(piece, rank, TAG)
        except InputError as error:
            mine = str(error)
            for rank in range(1, comm.size):
                comm.send(mine, rank, TAG)
    else:
        with comm.waiting("its part of a mesh"):
            mine = comm.recv(source=0, tag=TAG)
    if isinstance(mine, str):
        raise InputError(mine)
    place, options = mine
    return ForestPart(*place, **options)


def _pieces(make: Callable[[], TetForest], ranks: int, costs: npt.ArrayLike | None) -> Iterator[Any]:
    """The arguments of each rank's part, one rank after another."""
    mesh = make()
    if not isinstance(mesh, TetForest):
        raise InputError(f"make gives {shown(mesh)}; it must give a TetForest")
    dealt = Partition.of(mesh, ranks, costs)
    outer = boundary_faces(mesh.tets)[0]
    used = mesh.points[np.unique(mesh.tets)]
    whole = {
        "element_count": len(mesh.tets),
        "bounds": np.stack([used.min(axis=0), used.max(axis=0)]),
        "smallest_volume": float(np.min(mesh.volumes)),
        "label_names": mesh.label_names,
    }
    for rank in range(ranks):
        kept = dealt.needed(mesh, rank)
        part, nodes = part_of_mesh(mesh, kept, dealt)
        assert isinstance(part, TetForest)
        elements = np.flatnonzero(kept).astype(np.int32)
        here = [np.arange(len(each), dtype=np.int32) for each in (nodes, elements)]
        counted = dealt.rank_of_element[elements] == rank
        numbers = Numbers(nodes, elements, dealt.rank_of_node[nodes], counted, len(mesh.points), *here)
        place = (part.cells, part.cell_size, part.origin, part.lattice, part.node_ends, part.tree, part.up_axis)
        yield (
            place,
            whole
            | {
                "numbers": numbers,
                "outer": _here(outer, nodes, len(mesh.points)),
                "fill": part.fill,
                "labels": None if mesh.labels is None else mesh.labels[kept],
                "leaf_groups": part.leaf_groups,
            },
        )


def _here(faces: npt.NDArray[np.int32], nodes: npt.NDArray[np.int32], count: int) -> npt.NDArray[np.int32]:
    """The triangles with all corners among some nodes, by the numbers that they have there, int32 [F, 3]."""
    number = np.full(count, -1, np.int32)
    number[nodes] = np.arange(len(nodes), dtype=np.int32)
    found = number[faces]
    return found[(found >= 0).all(axis=1)]
