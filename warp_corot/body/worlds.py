"""Copies of one body side by side: which of their nodes are meant, and what one of them looks like."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.errors import InputError
from warp_corot.inputs.device_arrays import vectors_on_device
from warp_corot.inputs.indices import checked_indices

if TYPE_CHECKING:
    from .soft_body import SoftBody


@dataclass(frozen=True, eq=False)
class World:
    """One copy's part of a body's arrays: views, so that what is written to them is the body's state.

    Attributes:
        body: The body.
        index: Which copy, from 0.
    """

    body: SoftBody
    index: int

    @property
    def nodes(self) -> slice:
        """Where the copy's nodes are among the body's."""
        count = self.body.world_node_count
        return slice(self.index * count, (self.index + 1) * count)

    @property
    def elements(self) -> slice:
        """Where the copy's elements are among the body's."""
        count = self.body.world_element_count
        return slice(self.index * count, (self.index + 1) * count)

    @property
    def positions(self) -> wp.array:
        """As ``SoftBody.positions`` [m], vec3 [N] of one copy."""
        return self._own(self.body.positions)

    @property
    def displacements(self) -> wp.array:
        """As ``SoftBody.displacements`` [m], vec3 [N] of one copy: itself a copy, not a view."""
        return self._own(self.body.displacements)

    @property
    def velocities(self) -> wp.array:
        """As ``SoftBody.velocities`` [m/s], vec3 [N] of one copy."""
        return self._own(self.body.velocities)

    @property
    def reactions(self) -> wp.array:
        """As ``SoftBody.reactions`` [N], vec3 [N] of one copy."""
        return self._own(self.body.reactions)

    @property
    def loads(self) -> wp.array:
        """As ``SoftBody.loads`` [N], vec3 [N] of one copy."""
        return self._own(self.body.loads)

    def _own(self, array: wp.array) -> wp.array:
        return array if self.body.worlds == 1 else array[self.nodes]


@dataclass(frozen=True)
class ChosenNodes:
    """Nodes that a user names, in one or more worlds.

    Attributes:
        indices: Among the nodes of all worlds [k].
        worlds: In how many worlds.
        each: How many in each of the worlds, or None if not the same ones in each.
    """

    indices: npt.NDArray[np.intp]
    worlds: int
    each: int | None

    def vectors(self, given: Any, name: str, device: wp.Device) -> npt.NDArray[np.float64] | wp.array:
        """Vectors for the chosen nodes, one for all, one for each, or one for each in each world.

        Returns:
            [3] or [k, 3]; or, if they were on a device already, vec3 [1], [k] or [k / worlds] there.

        Raises:
            InputError: Another shape, or values that are not finite numbers, which those on a device may be.
        """
        there = vectors_on_device(given, name, (len(self.indices), self.each or len(self.indices)), device)
        if there is not None:
            return there
        try:
            values = np.asarray(given, dtype=np.float64)
        except (TypeError, ValueError):
            raise InputError(f"{name} is {given!r}; it must be finite numbers") from None
        count = len(self.indices)
        shapes: list[tuple[int, ...]] = [(3,), (count, 3)]
        if self.each is not None:
            shapes += [(self.each, 3), (self.worlds, 1, 3), (self.worlds, self.each, 3)]
        if values.shape not in shapes or not np.isfinite(values).all():
            allowed = " or ".join(str(list(shape)) for shape in dict.fromkeys(shapes))
            raise InputError(f"{name} has shape {values.shape}; it must be finite, {allowed}")
        if self.each is None or values.shape in ((3,), (count, 3)):
            return values
        return np.broadcast_to(values, (self.worlds, self.each, 3)).reshape(count, 3)

    def keyframes(self, given: npt.ArrayLike) -> npt.ArrayLike:
        """Keyframes of the nodes of one world, [K, n, 3], once for each of the worlds; any others as they are."""
        shape = np.shape(given)
        if self.each is None or len(shape) != 3 or shape[1] != self.each:
            return given
        return np.tile(given, (1, self.worlds, 1))


def chosen_nodes(nodes: npt.ArrayLike, count: int, worlds: int, chosen_worlds: Any = None) -> ChosenNodes:
    """The nodes that a mask or a list of indices names, in all worlds or in the chosen ones.

    Args:
        nodes: Mask bool [N] or indices into one world's nodes; or a mask of all worlds' nodes, [worlds, N] or
            [worlds * N].
        count: Nodes in one world, N.
        worlds: How many worlds there are.
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
            raise InputError("a mask of all worlds' nodes says which worlds are meant; worlds cannot be given as well")
        return ChosenNodes(np.flatnonzero(given), worlds, None)
    own = checked_indices(nodes, count, "node")
    which = np.arange(worlds) if chosen_worlds is None else checked_indices(chosen_worlds, worlds, "world")
    return ChosenNodes((which[:, None] * count + own).ravel(), len(which), len(own))
