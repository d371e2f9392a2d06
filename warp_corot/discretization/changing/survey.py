"""The decision when the stable step of a changing mesh must be found again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.kernels.plan.changing import begin_counts
from warp_corot.kernels.remesh import survey as kernels

from .pools import DeviceForest

#: A longer step is searched for only after the stiffest element has been softer for this many passes.
PATIENCE = 10
#: Growth of the number of finest elements, and number of passes with changes, after which the step is always found
#: again. An element among equal ones vibrates up to 1.5 times as fast as one among larger ones.
GROWTH = 1.5
MOST_CHANGES = 50
#: Stiffnesses with a smaller relative difference count as equal.
ALIKE = 1e-3


@dataclass
class Findings:
    """The mesh when its step was found last, and the passes since then.

    Attributes:
        stiffness: Of the stiffest element, (2 mu + lambda) / (density volume^(2/3)) [1/s^2].
        finest: Number of elements of the finest level.
        softer_for: Passes in which the stiffest element was softer.
        changes: Passes that changed something.
    """

    stiffness: float = 0.0
    finest: int = 0
    softer_for: int = 0
    changes: int = 0


class Survey:
    """Measures the elements after each pass.

    Args:
        forest: The pools.
        modulus: 2 mu + lambda [Pa], if all elements have the same; else elements carry "mu" and "lam".

    Attributes:
        found: The launches' results, int32, for ``read``.
        last: The mesh when its step was found last.
        finest_level: The finest level of the present mesh.
        stiffness: Of its stiffest element; see ``Findings``.
    """

    def __init__(self, forest: DeviceForest, modulus: float):
        self._forest = forest
        self._modulus = modulus
        self.found = wp.zeros(kernels.PLACES, dtype=wp.int32, device=forest.device)
        self.last = Findings()
        self.finest_level = 0
        self.stiffness, self._finest = 0.0, 0

    def launch(self, goes: wp.array) -> None:
        """Launch the measurement of the elements if ``goes`` [1] is not zero; may be recorded."""
        forest = self._forest
        device, threads = forest.device, forest.threads
        wp.launch(begin_counts, dim=kernels.PLACES, inputs=[goes], outputs=[self.found], device=device)
        inputs = [threads, goes, self._modulus, forest.pools, forest.carriage.arrays]
        wp.launch(kernels.find_stiffest, dim=threads, inputs=inputs, outputs=[self.found], device=device)
        inputs = [threads, goes, forest.pools]
        wp.launch(kernels.count_finest, dim=threads, inputs=inputs, outputs=[self.found], device=device)

    def read(self, found: npt.NDArray[np.int32]) -> None:
        """Take a copy of ``found`` of a mesh that has changed."""
        self.stiffness = float(found[: int(kernels.STIFFEST) + 1].view(np.float32)[-1])
        self.finest_level = int(found[kernels.FINEST_LEVEL])
        self._finest = int(found[kernels.FINEST_COUNTS :].sum())
        self.last.changes += 1

    def step_may_change(self) -> bool:
        """Whether the stable step must be found again; call it once a pass."""
        last = self.last
        softer = self.stiffness < (1.0 - ALIKE) * last.stiffness
        last.softer_for = last.softer_for + 1 if softer else 0
        stiffer = self.stiffness > (1.0 + ALIKE) * last.stiffness
        grown = not softer and self._finest > GROWTH * last.finest
        if not (stiffer or grown or last.softer_for > PATIENCE or last.changes > MOST_CHANGES):
            return False
        self.settle()
        return True

    def settle(self) -> None:
        """Record that the step has been found for the present mesh."""
        self.last = Findings(self.stiffness, self._finest)
