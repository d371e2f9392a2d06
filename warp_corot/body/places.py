"""Nodes named by where they are at rest: an expression or a function of the rest position, as materials take one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.elements import Mesh
from warp_corot.errors import InputError
from warp_corot.inputs.selection import select_nodes

#: Nodes as users name them: a mask, indices, an expression (``select_nodes``), or a function of the rest positions [m],
#: float64 [N, 3], that gives a mask bool [N].
Nodes = npt.ArrayLike | str | Callable[[npt.NDArray[np.float64]], npt.ArrayLike]


def nodes_at(nodes: Nodes, mesh_of: Callable[[], Mesh]) -> Any:
    """A mask bool [N] in place of an expression or a function; anything else as it is.

    In expressions ``zmin`` and the like are bounds of the nodes that elements name.

    Args:
        nodes: What a user gave.
        mesh_of: Gives the mesh, which is asked for only if it is needed.

    Raises:
        InputError: Not such an expression, or the function gives something else than a truth for each node.
    """
    if isinstance(nodes, wp.array):
        return nodes.numpy()
    if not isinstance(nodes, str) and not callable(nodes):
        return nodes
    mesh = mesh_of()
    if isinstance(nodes, str):
        used = mesh.points[np.unique(mesh.tets)]
        return select_nodes(nodes, mesh.points, bounds=[used.min(axis=0), used.max(axis=0)])
    count = len(mesh.points)
    try:
        found = np.asarray(nodes(mesh.points.copy()))
    except (TypeError, ValueError, IndexError) as error:
        raise InputError(f"the function for nodes fails at the rest positions [{count}, 3]: {error}") from None
    if found.dtype != bool or found.shape != (count,):
        raise InputError(
            f"the function for nodes gives {found.dtype} of shape {list(found.shape)} at the rest positions "
            f"[{count}, 3]; it must give true or false for each, bool [{count}], as lambda x: x[:, 2] < 0.01 does"
        )
    return found
