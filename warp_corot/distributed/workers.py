"""The processes of a sweep on this machine: one for each card, or for each core without cards."""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Executor, ProcessPoolExecutor
from typing import Any

import numpy as np
import warp as wp

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_count

#: Number of runs given at a time to a user's engine, whose size is not known.
HANDED_OVER = 256


def worker_count(workers: int | None, runs: int, executor: Executor | None) -> int:
    """The number of runs at a time."""
    if workers is not None:
        return checked_count(workers, "workers", least=1)
    if executor is not None:
        return HANDED_OVER
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(min(wp.get_cuda_device_count() or cores, runs), 1)


def local_executor(workers: int) -> ProcessPoolExecutor:
    """New processes, because CUDA and Warp do not work in forked ones."""
    context = multiprocessing.get_context("spawn")
    turn = context.Value("i", 0)
    return ProcessPoolExecutor(workers, mp_context=context, initializer=_begin, initargs=(turn,))


def timed(function: Callable[..., Any], run: Mapping[str, Any]) -> dict[str, Any]:
    """The results of a function for some parameters as a row of a table, with its time.

    Raises:
        InputError: The function returns neither a number nor a dictionary of numbers and texts.
    """
    began = time.perf_counter()
    given = function(**run)
    seconds = time.perf_counter() - began
    found = given if isinstance(given, Mapping) else {"result": given}
    row = {}
    for name, value in found.items():
        value = value.item() if isinstance(value, np.generic) else value
        if name in run or name in ("seconds", "error") or not isinstance(value, str | int | float | bool | None):
            raise InputError(f"the function gives {name} = {value!r}; it must be a number or text of another name")
        row[name] = value
    return row | {"seconds": seconds}


def _begin(turn: Any) -> None:
    """Choose a card for this process, if there are cards."""
    with turn.get_lock():
        number, turn.value = turn.value, turn.value + 1
    wp.config.quiet = True
    count = wp.get_cuda_device_count()
    if count:
        wp.set_device(f"cuda:{number % count}")
