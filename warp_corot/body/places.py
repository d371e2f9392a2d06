"""Nodes named by where they are at rest: an expression or a function of the rest position, as materials take one."""

from __future__ import annotations

import keyword
import re
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.elements import Mesh
from warp_corot.errors import InputError
from warp_corot.inputs.selection import CONSTANTS, FUNCTIONS, REGIONS, select_nodes

#: Names that expressions have of themselves.
TAKEN = {"x", "y", "z", *(f"{axis}{end}" for axis in "xyz" for end in ("min", "max"))}
TAKEN |= {*CONSTANTS, *FUNCTIONS, *REGIONS}
#: Nodes as users name them: a mask, indices, an expression (``select_nodes``), or a function of the rest positions [m],
#: float64 [N, 3], that gives a mask bool [N].
Nodes = npt.ArrayLike | str | Callable[[npt.NDArray[np.float64]], npt.ArrayLike]


def named_nodes(mesh: Mesh) -> dict[str, Callable[[], npt.NDArray[np.bool_]]]:
    """What gives the nodes, bool [N], of each label and each set of nodes of a mesh, by names as expressions have them.

    All but letters, digits and underscores become underscores; names that expressions have already get a "_set" behind.
    """
    labels = {name: partial(mesh.nodes_of, name) for name in getattr(mesh, "label_names", ())}
    sets = {name: partial(np.array, nodes) for name, nodes in getattr(mesh, "node_sets", {}).items()}
    found: dict[str, Callable[[], npt.NDArray[np.bool_]]] = {}
    for name, nodes in (sets | labels).items():
        known = re.sub(r"\W", "_", name)
        known = known if known.isidentifier() and not keyword.iskeyword(known) else f"_{known}"
        found[f"{known}_set" if known in TAKEN else known] = nodes
    return found


def nodes_at(nodes: Nodes, mesh_of: Callable[[], Mesh]) -> Any:
    """A mask bool [N] in place of an expression or a function; anything else as it is.

    In expressions ``zmin`` and the like are bounds of the nodes that elements name; names of the mesh's labels and sets
    of nodes are known, too (`named_nodes`).

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
        bounds = [used.min(axis=0), used.max(axis=0)]
        return select_nodes(nodes, mesh.points, bounds=bounds, named=named_nodes(mesh))
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
