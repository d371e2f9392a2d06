"""Imports of many modules."""

from __future__ import annotations

import ast
import gc
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from pathlib import Path

PACKAGE = "warp_corot"


@contextmanager
def uncollected() -> Iterator[None]:
    """Inside, no garbage is collected.

    Imports make many objects that stay, because Warp keeps the syntax tree of each kernel. Collections would find next
    to nothing and take a quarter of the time.
    """
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()


def public_name(name: str) -> object:
    """The object that a name of the public interface stands for; imports no more modules than it needs."""
    from .arguments import explained

    module = modules_of_names()[name]
    if module != PACKAGE and hasattr(source := import_module(module), name):
        return explained(getattr(source, name))
    return import_module(f"{module}.{name}")


@cache
def modules_of_names() -> dict[str, str]:
    """The module from which ``api.py`` imports each of its names."""
    lines = ast.parse(Path(__file__).parents[1].joinpath("api.py").read_text(encoding="utf-8")).body
    found: dict[str, str] = {}
    for line in lines:
        if isinstance(line, ast.ImportFrom):
            module = line.module if line.level == 0 else ".".join(filter(None, (PACKAGE, line.module)))
            found |= {each.name: str(module) for each in line.names}
    return found
