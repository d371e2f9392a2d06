"""The user's choice of nodes: by rest position, by a mask or by indices, in all copies of a body or in some."""

from __future__ import annotations

import keyword
import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.elements import Mesh
from warp_corot.errors import InputError, depth_of_user
from warp_corot.inputs.checks import FLOAT32, checked_indices, shown
from warp_corot.inputs.device import vectors_on_device
from warp_corot.inputs.selection import CONSTANTS, FUNCTIONS, REGIONS, select_nodes

#: Names with a meaning of their own in expressions.
TAKEN = {"x", "y", "z", *(f"{axis}{end}" for axis in "xyz" for end in ("min", "max"))}
TAKEN |= {*CONSTANTS, *FUNCTIONS, *REGIONS}
#: A choice of nodes: a mask, indices, an expression (``select_nodes``), or a function of the rest positions [m],
#: float64 [N, 3], that gives a mask bool [N].
Nodes = npt.ArrayLike | str | Callable[[npt.NDArray[np.float64]], npt.ArrayLike]


def named_nodes(mesh: Mesh) -> dict[str, Callable[[], npt.NDArray[np.bool_]]]:
    """Functions that give the nodes, bool [N], of each label and each node set of a mesh, by their names in
    expressions.

    Characters other than letters, digits and underscores become underscores; names that expressions use get a suffix
    "_set".
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
    """A mask bool [N] in place of an expression or a function; any other value unchanged.

    An expression that holds nowhere warns, except on a part of a mesh, and unless it says "none".
    In expressions ``zmin`` and the other bounds are those of nodes of elements; names of the mesh's labels and node
    sets can be used, too (`named_nodes`).

    Args:
        nodes: The user's argument.
        mesh_of: Gives the mesh; it is called only if needed.

    Raises:
        InputError: An invalid expression, or a function that does not give true or false for each node.
    """
    if isinstance(nodes, wp.array):
        return nodes.numpy()
    if not isinstance(nodes, str) and not callable(nodes):
        return nodes
    mesh = mesh_of()
    if isinstance(nodes, str):
        chosen = select_nodes(nodes, mesh.points, bounds=_bounds(mesh, nodes), named=named_nodes(mesh))
        if not chosen.any() and "none" not in nodes and getattr(mesh, "bounds", None) is None:
            low, high = (", ".join(f"{x:.3g}" for x in end) for end in _bounds(mesh, nodes))
            message = f"no node is where {nodes!r}; the body lies between ({low}) and ({high}) m"
            warnings.warn(message, UserWarning, stacklevel=depth_of_user())
        return chosen
    count = len(mesh.points)
    try:
        found = np.asarray(nodes(mesh.points.copy()))
    except (TypeError, ValueError, IndexError) as error:
        raise InputError(f"the function for nodes fails at the rest positions [{count}, 3]: {error}") from None
    if found.dtype != bool or found.shape != (count,):
        raise InputError(
            f"the function for nodes gives {found.dtype} of shape {list(found.shape)} at the rest positions "
            f"[{count}, 3]; it must give true or false for each, bool [{count}], like lambda x: x[:, 2] < 0.01"
        )
    return found


def _bounds(mesh: Mesh, expression: str) -> npt.NDArray[np.float64]:
    """The lowest and the highest coordinates of nodes of elements [m], [2, 3]; of the whole mesh, if this is a part."""
    if (given := getattr(mesh, "bounds", None)) is not None:
        mesh.check_expression(expression)  # type: ignore[union-attr]
        return given
    used = mesh.points[np.unique(mesh.tets)]
    return np.stack([used.min(axis=0), used.max(axis=0)])


@dataclass(frozen=True)
class ChosenNodes:
    """The user's choice of nodes in one or more worlds.

    Attributes:
        indices: Indices into the nodes of all worlds [k].
        worlds: Number of worlds.
        each: Number of nodes in each world, or None if the worlds have different ones.
    """

    indices: npt.NDArray[np.intp]
    worlds: int
    each: int | None

    def vectors(self, given: Any, name: str, device: wp.Device) -> npt.NDArray[np.float64] | wp.array:
        """Vectors for the chosen nodes, one for all, one for each, or one for each in each world.

        Returns:
            [3] or [k, 3]; or, for an array on a device, vec3 [1], [k] or [k / worlds] on it.

        Raises:
            InputError: Another shape, or values that are not finite numbers; values on a device are not checked.
        """
        there = vectors_on_device(given, name, (len(self.indices), self.each or len(self.indices)), device)
        if there is not None:
            return there
        if isinstance(given, wp.array):  # of another dtype; read as float64
            given = given.numpy()
        try:
            values = np.asarray(given, dtype=np.float64)
        except (TypeError, ValueError):
            raise InputError(f"{name} is {shown(given)}; it must be finite numbers") from None
        count = len(self.indices)
        shapes: list[tuple[int, ...]] = [(3,), (count, 3)]
        if self.each is not None:
            shapes += [(self.each, 3), (self.worlds, 1, 3), (self.worlds, self.each, 3)]
        if values.shape not in shapes or not np.isfinite(values).all():
            allowed = " or ".join(str(list(shape)) for shape in dict.fromkeys(shapes))
            raise InputError(f"{name} has shape {values.shape}; it must be finite, {allowed}")
        if (np.abs(values) > FLOAT32.max).any():
            raise InputError(f"{name} is {shown(given)}; it must be within the range of float32")
        if self.each is None or values.shape in ((3,), (count, 3)):
            return values
        return np.broadcast_to(values, (self.worlds, self.each, 3)).reshape(count, 3)

    def keyframes(self, given: npt.ArrayLike) -> npt.ArrayLike:
        """Keyframes of the nodes of one world, [K, n, 3], repeated for each world; other keyframes unchanged."""
        try:
            shape = np.shape(given)
        except ValueError:  # rows of different lengths: an error when they are read
            return given
        if self.each is None or len(shape) != 3 or shape[1] != self.each:
            return given
        return np.tile(given, (1, self.worlds, 1))


def chosen_nodes(nodes: npt.ArrayLike, count: int, worlds: int, chosen_worlds: Any = None) -> ChosenNodes:
    """The nodes that a mask or a list of indices gives, in all worlds or in the chosen ones.

    Args:
        nodes: Mask bool [N] or indices into one world's nodes; or a mask of all worlds' nodes, [worlds, N] or
            [worlds * N].
        count: Nodes in one world, N.
        worlds: Number of worlds.
        chosen_worlds: None for all, one index, a mask bool [worlds], or indices.

    Raises:
        InputError: Mask of the wrong length, index out of range, or a mask of all worlds' nodes with chosen worlds.
    """
    try:
        given = np.asarray(nodes)
    except ValueError:
        given = np.empty(0, object)
    if given.dtype == bool and given.shape in ((worlds, count), (worlds * count,)) and given.shape != (count,):
        if chosen_worlds is not None:
            raise InputError("a mask of all worlds' nodes chooses the worlds itself; worlds must not be given as well")
        return ChosenNodes(np.flatnonzero(given), worlds, None)
    own = checked_indices(nodes, count, "node")
    which = np.arange(worlds) if chosen_worlds is None else checked_indices(chosen_worlds, worlds, "world")
    return ChosenNodes((which[:, None] * count + own).ravel(), len(which), len(own))
