"""Active stress of a changing mesh, and the keyframes that it follows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.body.keyframes import Activation, Followed, followed_stress
from warp_corot.discretization.changing.pools import DeviceForest
from warp_corot.kernels.remesh.anisotropic import READ_LEAVES, WRITE_LEAVES
from warp_corot.kernels.remesh.state import NO_ROW

from .carried_material import ACTIVATION, ACTIVATION_ROW

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody


@dataclass(frozen=True, eq=False)
class Keys:
    """Keyframes of rows ``first`` and following: times [s], [K], and active stress [Pa], [K, rows]."""

    first: int
    times: npt.NDArray[np.float64]
    stress: npt.NDArray[np.float32]

    @property
    def end(self) -> int:
        return self.first + self.stress.shape[1]

    def follow(self, rows: npt.NDArray[np.int32]) -> npt.NDArray[np.bool_]:
        """Which elements have a row in these keyframes."""
        return (rows >= self.first) & (rows < self.end)


class CarriedActivation:
    """Active stress that elements carry, passed between body and pools; bodies without active stress are left alone.

    Args:
        body: The body.
        forest: Its pools.

    Attributes:
        keys: The keyframes that elements follow, or followed on the mesh that ``put_back`` restores.
    """

    def __init__(self, body: SoftBody, forest: DeviceForest):
        self._body = body
        self._forest = forest
        self.keys: list[Keys] = []
        self._made: list[Followed] = []

    def note(self, kept_rows: wp.array | None) -> None:
        """Read the user's changes.

        Args:
            kept_rows: Rows that ``put_back`` may write, whose keyframes must be kept.
        """
        body = self._body
        if not body.discretization.has_activation:
            return
        self._write(ACTIVATION, body.discretization.activation[: body.element_count])
        now = body.conditions.activations
        if len(now) != len(self._made) or any(a is not b for a, b in zip(now, self._made, strict=True)):
            self._write(ACTIVATION_ROW, self._adopt(now, kept_rows))

    def kept(self) -> dict[str, wp.array]:
        """The data for ``put_back``, on the current mesh."""
        if not self._body.discretization.has_activation:
            return {}
        return {name: self._read(name) for name in (ACTIVATION, ACTIVATION_ROW)}

    def put_back(self, kept: dict[str, wp.array]) -> None:
        """Write the data into the mesh from which they came; the pools hold that mesh already."""
        for name in (ACTIVATION, ACTIVATION_ROW):
            if name in kept:
                self._write(name, kept[name])

    def follow(self) -> None:
        """Tell the host which elements follow keyframes after a pass."""
        if self.keys:
            self.serve()

    def serve(self) -> None:
        """Make the body's elements follow the keyframes of the rows that they carry."""
        rows = self._read(ACTIVATION_ROW).numpy()
        self._made = [made for keys in self.keys if (made := _of_keys(keys, rows, self._body.device))]
        self._body.conditions.set_activations(self._made)

    def _adopt(self, activations: Sequence[Followed], kept_rows: wp.array | None) -> wp.array:
        """Number these keyframes, and return the row that each element follows, int32 [T]."""
        rows = np.full(self._body.element_count, int(NO_ROW), np.int32)
        wanted = np.empty(0, np.int32) if kept_rows is None else kept_rows.numpy()
        self.keys = [keys for keys in self.keys if keys.follow(wanted).any()]
        for activation in activations:
            first, elements = max((keys.end for keys in self.keys), default=0), activation.host_numbers
            keys = Keys(first, activation.times.numpy(), activation.values.numpy())
            rows[elements] = first + (np.arange(len(elements)) if keys.end - first > 1 else 0)
            self.keys.append(keys)
        self._made = list(activations)
        return wp.array(rows, dtype=wp.int32, device=self._body.device)

    def _write(self, name: str, given: wp.array) -> None:
        columns, number = self._columns(name)
        inputs = [self._forest.pools.leaves, given, number]
        wp.launch(WRITE_LEAVES[given.dtype], len(given), inputs, [columns], device=self._body.device)

    def _read(self, name: str) -> wp.array:
        columns, number = self._columns(name)
        count = self._body.element_count
        found = wp.empty(count, dtype=columns.dtype, device=self._body.device)
        inputs = [self._forest.pools.leaves, columns, number]
        wp.launch(READ_LEAVES[found.dtype], count, inputs, [found], device=self._body.device)
        return found

    def _columns(self, name: str) -> tuple[wp.array, int]:
        carriage = self._forest.carriage
        if name in carriage.names:
            return carriage.arrays.values, carriage.names.index(name)
        return carriage.arrays.numbers, carriage.number_names.index(name)


def _of_keys(keys: Keys, rows: npt.NDArray[np.int32], device: wp.Device) -> Followed | None:
    """The elements that follow these keyframes; None if there are none."""
    elements = np.flatnonzero(keys.follow(rows))
    if not len(elements):
        return None
    stress = keys.stress if keys.end - keys.first == 1 else keys.stress[:, rows[elements] - keys.first]
    return followed_stress(elements, Activation(keys.times, stress), device)
