"""Stages whose frames show the stress by colours, all in one range at the end."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from warp_corot.errors import InputError
from warp_corot.io.pictures.colors import COLORMAP_NAME, round_limit

from .pieces import PieceStore, Samples


class ColoredStage:
    """Frames in a `PieceStore`, coloured by stress.

    The colour range starts at 0 and ends at the 99th percentile of the highest frame so far, rounded up to few digits
    (`colors.round_limit`). On closing, earlier frames are coloured again with the last range. Custom data of the
    default prim name the colour map and its range.

    Args:
        store: Keeps the frames.

    Attributes:
        path: The stage.
        frames: The number of frames so far.
        stress_range: Stresses [Pa] at the two ends of the colour map so far.
    """

    def __init__(self, store: PieceStore):
        self._store, self.path, self.frames = store, store.path, 0
        self.stress_range = (0.0, 0.0)
        self._ranges_used: set[tuple[float, float]] = set()
        self._closed = False

    def widen_range(self, top: float) -> None:
        """Let the colour range reach this stress [Pa]."""
        self.stress_range = (0.0, max(top, self.stress_range[1]))

    @staticmethod
    def range_for(stress: NDArray[np.float32]) -> float:
        """The end of the colour range that a frame with these stresses of its tetrahedra needs [Pa]."""
        if len(stress) == 0:
            return 0.0
        rank = min(len(stress) - 1, int(0.99 * len(stress)))
        return round_limit(float(np.partition(stress, rank)[rank]))

    def flush(self) -> None:
        """Write the frames so far to disk now; the stage plays them.

        Raises:
            OSError: It could not be written, for example because the disk is full; former frames stay and play.
        """
        self._store.flush()

    def close(self) -> None:
        """Join all frames into one file and remove the pieces; further calls do nothing.

        Raises:
            OSError: The joined file could not be written; the pieces stay, and the stage plays them.
        """
        if not self._closed:
            self._closed = True
            self._store.finish(self._colors if self._ranges_used - {self.stress_range} else None)

    def _check_open(self) -> None:
        if self._closed:
            raise InputError(f"{self.path}: is closed; frames must be added before")

    def _add(
        self, samples: Samples, stress: NDArray[np.float32] | None, nodal: NDArray[np.float64] | None = None
    ) -> None:
        """Add a frame with stresses of tetrahedra [T] [Pa], if any, and their averages at nodes [N], if known."""
        if stress is not None:
            self.widen_range(self.range_for(stress))
            self._ranges_used.add(self.stress_range)
            lowest, highest = self.stress_range
            legend = {"map": COLORMAP_NAME, "quantity": "von Mises stress", "unit": "Pa"}
            self._store.custom_data["stressColors"] = legend | {"lowest": lowest, "highest": highest}
            samples |= self._colors(samples, nodal)
        self._store.add(float(self.frames), samples, sum(map(_nbytes, samples.values())))
        self.frames += 1

    def _colors(self, samples: Samples, nodal: NDArray[np.float64] | None = None) -> Samples:
        """Colours for the stresses of a frame, in the present range."""
        raise NotImplementedError


def _nbytes(value: Any) -> int:
    try:
        return memoryview(value).nbytes
    except TypeError:  # a quaternion or a matrix
        return 128
