"""Uniformly bisected boxes in parts: every rank makes its own part, and no rank the whole box."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from warp_corot.errors import InputError
from warp_corot.mesh.lattice import LATTICE_BITS, checked_box
from warp_corot.mesh.uniform import halvings
from warp_corot.mesh.uniform_part import SUBTREE_DEPTH

from . import mpi
from .cutting import cut_box
from .divided_mesh import DividedForest, Numbers
from .root_cube_partition import numbered_points

#: Elements and grid points of the whole box are numbered in 64 bits.
MOST_ELEMENTS = 2**58


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
            "bounds": np.array([origin, np.asarray(origin) + highest]),
        },
    )
