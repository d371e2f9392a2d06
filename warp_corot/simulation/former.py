"""Former names of a simulation's members, which warn for one version."""

from __future__ import annotations

import warnings

from .hooks import Hooks


class FormerNames:
    """The part of ``Simulation`` that keeps names from before."""

    hooks: Hooks

    @property
    def hook_intervals(self) -> list[int]:
        """Former name of ``hooks.intervals``."""
        warnings.warn("Simulation.hook_intervals is now hooks.intervals", DeprecationWarning, stacklevel=2)
        return self.hooks.intervals

    def call_hooks(self) -> None:
        """Former name of ``hooks.call``."""
        warnings.warn("Simulation.call_hooks() is now hooks.call(sim)", DeprecationWarning, stacklevel=2)
        self.hooks.call(self)
