"""Saying that kernels are being compiled, at the moment the first one is.

Warp speaks of a module when it is done. But for each module that it begins to compile it makes a folder in its kernel
cache, and for none that it finds there; and Python tells whoever listens of every folder that is made (PEP 578).
"""

from __future__ import annotations

import functools
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import warp as wp

from .say import complain

Say = Callable[[str], None]

#: Who wants to be told of the next module that is compiled.
_waiting: list[Callable[[], None]] = []


def say_plainly(text: str) -> None:
    """On stderr, in a line of its own."""
    complain(text, kind="")


@contextmanager
def compiling_said(device: wp.Device, say: Say = say_plainly) -> Iterator[None]:
    """Say in one line that kernels are being compiled, if any are; nothing where all are in Warp's cache.

    Args:
        device: What they are compiled for.
        say: Prints the line.
    """

    def tell() -> None:
        say(f"compiling kernels for {device}, once: this takes some seconds ...")

    _listen()
    _waiting.append(tell)
    try:
        yield
    finally:
        if tell in _waiting:
            _waiting.remove(tell)


@functools.cache
def _listen() -> None:
    """Begin to listen; cached, since listeners cannot be taken away again."""
    sys.addaudithook(_heard)


def _heard(event: str, args: tuple[Any, ...]) -> None:
    if event == "os.mkdir" and _waiting and _in_kernel_cache(args[0]):
        told, _waiting[:] = _waiting[:], []
        for tell in told:
            tell()


def _in_kernel_cache(path: Any) -> bool:
    cache = wp.config.kernel_cache_dir  # set when Warp starts
    return bool(cache) and os.fsdecode(path).startswith(os.path.join(cache, ""))
