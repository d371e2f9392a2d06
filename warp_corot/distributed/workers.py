"""The processes of a sweep on this machine: one for each card, or for each core without cards."""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from typing import Any

import numpy as np
import warp as wp

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_count
from warp_corot.inputs.starting import start_warp

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


def timed(function: Callable[..., Any], runs: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The results of a function for the parameters of one run as a row of a table, with its time.

    Raises:
        InputError: The function returns neither a number nor a dictionary of numbers and texts.
    """
    (run,) = runs
    began = time.perf_counter()
    found = _named(function(**run))
    seconds = time.perf_counter() - began
    return [{name: _checked(value, name, run) for name, value in found.items()} | {"seconds": seconds}]


def timed_together(function: Callable[..., Any], runs: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The same of several runs that one call makes; each has an equal share of the time.

    Raises:
        InputError: The function returns neither a list for all runs nor a dictionary of such lists.
    """
    began = time.perf_counter()
    given = _named(function(**{name: [run[name] for run in runs] for name in runs[0]}))
    seconds = (time.perf_counter() - began) / len(runs)
    for name, values in given.items():
        if isinstance(values, str) or not hasattr(values, "__len__") or len(values) != len(runs):
            raise InputError(f"the function gives {name} = {values!r}; it must be a list of {len(runs)}, one a run")
    return [
        {name: _checked(values[k], name, run) for name, values in given.items()} | {"seconds": seconds}
        for k, run in enumerate(runs)
    ]


def _named(given: Any) -> Mapping[str, Any]:
    return given if isinstance(given, Mapping) else {"result": given}


def _checked(value: Any, name: str, run: Mapping[str, Any]) -> Any:
    """A number or text of Python's own."""
    value = value.item() if isinstance(value, np.generic) else value
    if name in run or name in ("seconds", "error") or not isinstance(value, str | int | float | bool | None):
        raise InputError(f"the function gives {name} = {value!r}; it must be a number or text of another name")
    return value


def _begin(turn: Any) -> None:
    """Choose a card for this process, if there are cards."""
    with turn.get_lock():
        number, turn.value = turn.value, turn.value + 1
    wp.config.log_level = wp.LOG_ERROR
    start_warp()
    count = wp.get_cuda_device_count()
    if count:
        wp.set_device(f"cuda:{number % count}")
