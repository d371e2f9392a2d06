"""What a case is, and what it gives: rows, each a result beside its reference."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any

from warp_corot.errors import ConvergenceError, UnstableError


@dataclass(frozen=True)
class Row:
    """A result, its reference, and how far they may be apart.

    Attributes:
        quantity: What it is.
        result, reference: Both in the unit.
        bound: The largest error with which the case passes.
        unit: Empty for a ratio.
        scale: What errors are relative to; None: the reference.
    """

    quantity: str
    result: float
    reference: float
    bound: float
    unit: str = ""
    scale: float | None = None

    @property
    def error(self) -> float:
        """The difference over the scale."""
        return (self.result - self.reference) / abs(self.reference if self.scale is None else self.scale)

    @property
    def passes(self) -> bool:
        return abs(self.error) <= self.bound


@dataclass
class Setup:
    """How a case is run.

    Attributes:
        device: Alias of the device.
        full: Whether on the finer meshes and for the longer times.
        shown: The bodies and obstacles of the last scene, for pictures.
    """

    device: str
    full: bool = False
    shown: tuple[Sequence[Any], Sequence[Any]] = field(default=((), ()), compare=False)


@dataclass(frozen=True)
class Case:
    """A case of the suite.

    Attributes:
        name: Its name on the command line.
        about: What is shown, in one line.
        source: Where the reference comes from.
        run: Runs it; returns its rows.
    """

    name: str
    about: str
    source: str
    run: Callable[[Setup], list[Row]]


#: All cases by name, in the order of the table.
CASES: dict[str, Case] = {}


def case(name: str, source: str) -> Callable[[Callable[[Setup], list[Row]]], Callable[[Setup], list[Row]]]:
    """Add a function to the suite; the first line of its docstring says what is shown."""

    def add(run: Callable[[Setup], list[Row]]) -> Callable[[Setup], list[Row]]:
        about = (run.__doc__ or "").split("\n\n")[0]
        CASES[name] = Case(name, " ".join(about.split()), source, run)
        return run

    return add


def run_case(name: str, setup: Setup) -> tuple[list[Row], float]:
    """Run a case; returns its rows and the time that it took [s]. One that ends in an error has a row that fails."""
    began = perf_counter()
    try:
        rows = CASES[name].run(setup)
    except (UnstableError, ConvergenceError) as error:
        rows = [Row(f"ended: {error}", math.nan, 1.0, 0.0)]
    return rows, perf_counter() - began
