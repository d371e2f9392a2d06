"""Functions that a simulation calls after steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_count, shown

#: A hook that advances the simulation is called within its own call, at most this often.
MOST_NESTED = 50


@dataclass(frozen=True)
class _Hook:
    callback: Callable[[Any], None]
    every: int


class Hooks:
    """The functions and the numbers of steps between their calls."""

    def __init__(self) -> None:
        self._hooks: list[_Hook] = []
        self._nested = 0

    @property
    def intervals(self) -> list[int]:
        """Steps between the calls of each function."""
        return [hook.every for hook in self._hooks]

    def add(self, callback: Callable[[Any], None], every: int) -> None:
        """Call a function after every ``every``-th step.

        Raises:
            InputError: ``every`` is not a positive whole number, or the callback is not callable.
        """
        if not callable(callback):
            raise InputError(f"callback is {shown(callback)}; it must be a function of the simulation")
        self._hooks.append(_Hook(callback, checked_count(every, "every", least=1)))

    def call(self, sim: Any) -> None:
        """Call the functions that are due now, with the simulation.

        Raises:
            InputError: A function advances the simulation, which calls it again, without end.
        """
        steps = sim.steps if self._hooks else 0
        for hook in tuple(self._hooks):
            if steps % hook.every == 0:
                self._call(hook.callback, sim)

    def _call(self, callback: Callable[[Any], None], sim: Any) -> None:
        if self._nested >= MOST_NESTED:
            name = getattr(callback, "__qualname__", shown(callback))
            raise InputError(
                f"the hook {name} advances the simulation, which calls it again and again; "
                "let it return, and advance the simulation outside"
            )
        self._nested += 1
        try:
            callback(sim)
        finally:
            self._nested -= 1
