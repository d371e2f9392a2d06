"""Pairs of test parameters, of which the default run takes some; the others are slow. Each law on each kind of mesh is
a separate kernel, and compiling it takes longer than running it."""

from collections.abc import Callable, Iterable

import pytest


def crossed(first: Iterable, second: Iterable, is_short: Callable[..., bool]) -> list:
    """All pairs of two lists as parameters; those for which ``is_short`` is false are slow."""
    second = list(second)
    marks = {True: (), False: pytest.mark.slow}
    return [pytest.param(a, b, marks=marks[bool(is_short(a, b))]) for a in first for b in second]
