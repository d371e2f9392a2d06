"""Attributes that an object has from another one, which it wraps."""

from __future__ import annotations

from collections.abc import Callable
from operator import attrgetter
from typing import TypeVar

C = TypeVar("C")


def forwards(to: str, *names: str) -> Callable[[type[C]], type[C]]:
    """Decorate a class whose attributes of these names are those of its attribute ``to``."""

    def decorate(cls: type[C]) -> type[C]:
        for name in names:
            setattr(cls, name, property(attrgetter(f"{to}.{name}")))
        return cls

    return decorate
