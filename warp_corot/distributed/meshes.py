"""Meshes of which each rank gets a part: boxes that ranks make in parts, and any mesh that rank 0 makes and divides."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from os import PathLike
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_corot.discretization.elements import Mesh
from warp_corot.errors import InputError
from warp_corot.inputs.checks import shown
from warp_corot.io.checkpoint.contents import box_level
from warp_corot.mesh import TetForest, TetMesh
from warp_corot.mesh.lattice import LATTICE_BITS, checked_box
from warp_corot.mesh.tree import Tree
from warp_corot.mesh.uniform import SUBTREE_DEPTH, halvings, subtrees_around, uniform_part, vertices_of

from . import mpi
from .divided_mesh import DividedForest, DividedTetMesh, Numbers, divide, whole_of
from .partition import Longs, Partition, checked_shares, nobody_empty, numbered_points

Ints = npt.NDArray[np.int32]

#: Elements and grid points of the whole box are numbered in 64 bits.
MOST_ELEMENTS = 2**58
#: The tag of the messages that bring parts.
TAG = 77


def box(
    cells: tuple[int, int, int] = (1, 1, 1),
    cell_size: float = 1.0,
    level: int = 3,
    *,
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
    up_axis: str = "Y",
    costs: npt.ArrayLike | None = None,
) -> DividedForest:
    """This rank's part of the mesh that ``TetForest.box`` makes; all ranks must call this.

    A rank makes only the leaves that it computes: its share along the order of the tree, and the leaves around the
    nodes that it moves. ``SoftBody`` and ``Simulation`` take the part like a whole mesh. A run has the results of the
    whole mesh; with ``deterministic=True`` they are the same bits on the CPU. Nodes and elements of the body are those
    of the part; ``gather`` puts nodal arrays together on rank 0 in the order of the whole mesh. In expressions,
    ``zmin`` and the other bounds are those of the whole box.

    Args:
        cells, cell_size, origin, up_axis: As for ``TetForest.box``.
        level: As there, but at least 3.
        costs: The cost of an element on each rank, in any unit, [ranks]; None: the same everywhere.

    Raises:
        InputError: MPI is not installed, an argument is out of its range, a part has too many elements, or there are
            fewer groups of eight elements than ranks.
    """
    comm = mpi.world()
    cells, cell_size, level, origin = checked_box(cells, cell_size, level, origin, up_axis)
    if level < SUBTREE_DEPTH:
        raise InputError(f"level is {level}; a box in parts needs at least {SUBTREE_DEPTH}: TetForest.box makes others")
    count = 6 * math.prod(cells) << level
    if count > MOST_ELEMENTS:
        raise InputError(f"level is {level}, which gives {count} tetrahedra; there must be at most {MOST_ELEMENTS}")
    cut = cut_box(cells, level, comm.size, comm.rank, costs)
    nodes, node_count = numbered_points(cut.owner, cut.keys, comm)
    numbers = Numbers(nodes, cut.elements, cut.owner, cut.counted, node_count)
    highest = (np.array(cells) << LATTICE_BITS) * (cell_size / 2**LATTICE_BITS)
    return DividedForest(
        cells,
        cell_size,
        origin,
        cut.lattice << (LATTICE_BITS - halvings(level)),
        cut.ends,
        cut.tree,
        up_axis,
        leaf_groups=np.arange(len(cut.elements), dtype=np.int32) >> SUBTREE_DEPTH,
        of_whole={
            "numbers": numbers,
            "element_count": count,
            "is_box": True,
            "bounds": np.array([origin, np.asarray(origin) + highest]),
        },
    )


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

    def parts() -> Iterator[Any]:
        mesh = make()
        if not isinstance(mesh, TetForest | TetMesh):
            raise InputError(f"make gives {shown(mesh)}; it must give a TetForest or a TetMesh")
        if (given := _box_of(mesh)) is not None:
            return (given | {"costs": costs} for _ in range(comm.size))
        division, whole = dealt(mesh, comm.size, costs), whole_of(mesh)
        return (divide(mesh, division, rank, whole) for rank in range(comm.size))

    part = _handed_out(parts, comm)
    return box(**part) if isinstance(part, dict) else part


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


def part_of_whole(mesh: Mesh, comm: Any) -> DividedForest | DividedTetMesh:
    """This rank's part of a mesh that all ranks have; all ranks must call this.

    Raises:
        InputError: As ``Partition.of``.
    """
    if (given := _box_of(mesh)) is not None:
        return box(**given)
    return divide(mesh, dealt(mesh, comm.size), comm.rank, whole_of(mesh))


def dealt(mesh: Mesh, ranks: int, costs: npt.ArrayLike | None = None) -> Partition:
    """The division of a mesh of which ranks keep parts. Elements that may share their dilatation stay together.

    Raises:
        InputError: As ``Partition.of``.
    """
    return Partition.of(mesh, ranks, costs, grouped=isinstance(mesh, TetMesh))


def _box_of(mesh: Mesh) -> dict[str, Any] | None:
    """The arguments of ``box`` for a mesh that it makes in parts; None for others."""
    level = box_level(mesh) if isinstance(mesh, TetForest) else None
    if level is None or level < SUBTREE_DEPTH:
        return None
    assert isinstance(mesh, TetForest)
    return {"level": level} | {name: getattr(mesh, name) for name in ("cells", "cell_size", "origin", "up_axis")}


def _handed_out(make: Callable[[], Iterator[Any]], comm: Any) -> Any:
    """What an iterator on rank 0 yields for this rank; all ranks must call this.

    The other ranks wait as long as rank 0 needs, without keeping cores busy.

    Raises:
        InputError: On all ranks, if ``make`` or the iterator raises one.
    """
    if comm.rank > 0:
        mine = mpi.awaited(comm.unwatched, 0, TAG)
    else:
        try:
            given = make()
            mine = next(given)
            for rank, part in enumerate(given, start=1):
                comm.send(part, rank, TAG)
        except InputError as error:
            mine = error
            for rank in range(1, comm.size):
                comm.send(InputError(str(error)), rank, TAG)
    if isinstance(mine, InputError):
        raise mine
    return mine


# --- boxes -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Cut:
    """The elements around the nodes that a rank moves, and its own elements.

    Attributes:
        lattice: Grid coordinates of the nodes and the tree's other corners, 2**halvings(level) intervals a cube edge.
        ends, tree: As in ``TetForest``.
        elements: The leaves' numbers in the whole box, int64 [t].
        counted: Which of the leaves this rank counts, bool [t].
        owner: The rank that moves each node, int32 [n].
        keys: A number for each node, from its coordinates, int64 [n].
    """

    lattice: Ints
    ends: Ints
    tree: Tree
    elements: Longs
    counted: npt.NDArray[np.bool_]
    owner: Ints
    keys: Longs


def cut_box(cells: tuple[int, int, int], level: int, ranks: int, rank: int, costs: npt.ArrayLike | None = None) -> Cut:
    """The part that ``Partition`` and ``numbered_part`` make of ``TetForest.box``, with the same order.

    The leaves are divided in subtrees of eight along the order of the tree. A node is moved by the rank of the first
    leaf around it in this order.

    Args:
        cells, level: As for ``TetForest.box``; at least three levels.
        ranks, rank: The number of ranks, and the number of this rank.
        costs: The cost of an element on each rank, in any unit, [ranks]; None: the same everywhere.

    Raises:
        InputError: Fewer subtrees than ranks, or costs that are not positive.
    """
    depth, intervals = level - SUBTREE_DEPTH, 1 << halvings(level)
    starts = dealt_starts(6 * int(np.prod(cells, dtype=object)) << depth, ranks, costs)
    first, end = int(starts[rank]), int(starts[rank + 1])
    own = np.arange(first, end, dtype=np.int64)
    vertices = vertices_of(cells, level, own)
    node, subtree = subtrees_around(vertices, cells, intervals, depth, (first, end))
    is_others = np.zeros(len(vertices), bool)
    is_others[node[subtree < first]] = True
    copies = np.unique(subtree[(subtree >= end) & ~is_others[node]])
    needed = np.concatenate([own, copies])
    lattice, ends, tree = uniform_part(cells, level, needed)
    nodes = lattice[: int(tree.leaf_tets.max()) + 1]
    keys = keys_of(nodes, cells, intervals)
    owner = np.full(len(nodes), rank, np.int32)
    ghosts = np.flatnonzero(~np.isin(keys, keys_of(vertices[~is_others], cells, intervals)))
    place, subtree = subtrees_around(nodes[ghosts], cells, intervals, depth, (0, 0))
    of_first = np.full(len(ghosts), starts[-1])
    np.minimum.at(of_first, place, subtree)
    owner[ghosts] = np.searchsorted(starts, of_first, side="right") - 1
    elements = ((needed << SUBTREE_DEPTH)[:, None] + np.arange(1 << SUBTREE_DEPTH)).ravel()
    counted = np.repeat(needed < end, 1 << SUBTREE_DEPTH)
    return Cut(lattice, ends, tree, elements, counted, owner, keys)


def dealt_starts(subtrees: int, ranks: int, costs: npt.ArrayLike | None) -> Longs:
    """The first subtree of each rank, then the number of subtrees; int64 [ranks + 1].

    Raises:
        InputError: As for ``cut_box``.
    """
    shares = checked_shares(ranks, costs)
    if subtrees < ranks:
        raise InputError(f"the body has {subtrees} groups of elements for {ranks} ranks; take fewer ranks")
    leaves, half = 1 << SUBTREE_DEPTH, 1 << (SUBTREE_DEPTH - 1)
    # A subtree belongs to the rank whose share contains its middle.
    bounds = np.cumsum(shares)[:-1] * (leaves * subtrees)
    starts = np.concatenate([[0], np.ceil((bounds - half) / leaves)]).astype(np.int64)
    return np.append(nobody_empty(starts, subtrees), subtrees)


def keys_of(nodes: Ints, cells: tuple[int, int, int], intervals: int) -> Longs:
    """The places of grid points among all grid points of the box, int64 [n]."""
    _, ny, nz = (np.int64(n * intervals + 1) for n in cells)
    x, y, z = nodes.astype(np.int64).T
    return (x * ny + y) * nz + z
