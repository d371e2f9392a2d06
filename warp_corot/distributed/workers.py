"""The processes of a sweep on this machine: one for each card, or for each core without cards."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from typing import Any

import numpy as np
import warp as wp

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_count
from warp_corot.inputs.cpu_threads import core_count, share_cores
from warp_corot.inputs.starting import start_warp

#: Number of runs given at a time to a user's engine, whose size is not known.
HANDED_OVER = 256


def worker_count(workers: int | None, runs: int, executor: Executor | None) -> int:
    """The number of runs at a time."""
    if workers is not None:
        return checked_count(workers, "workers", least=1)
    if executor is not None:
        return HANDED_OVER
    return max(min(wp.get_cuda_device_count() or core_count(), runs), 1)


def local_executor(workers: int) -> ProcessPoolExecutor:
    """New processes, because CUDA and Warp do not work in forked ones."""
    context = multiprocessing.get_context("spawn")
    turn = context.Value("i", 0)
    return ProcessPoolExecutor(workers, mp_context=context, initializer=_begin, initargs=(turn, workers))


def timed(function: Callable[..., Any], together: bool, runs: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The results of a function for the parameters of the runs that one call makes, as rows of a table; each has an
    equal share of the time.

    Args:
        function: The function.
        together: Whether it takes and returns lists for all runs; otherwise there is one run.
        runs: The parameters of each run.

    Raises:
        InputError: The function returns neither numbers nor dictionaries of numbers and texts, or no lists of them.
    """
    began = time.perf_counter()
    found = function(**({name: [run[name] for run in runs] for name in runs[0]} if together else runs[0]))
    seconds = (time.perf_counter() - began) / len(runs)
    found = found if isinstance(found, Mapping) else {"result": found}
    for name, values in found.items() if together else ():
        if isinstance(values, str) or not hasattr(values, "__len__") or len(values) != len(runs):
            raise InputError(f"the function gives {name} = {values!r}; it must be a list of {len(runs)}, one a run")
    return [
        {name: _checked(values[k] if together else values, name, run) for name, values in found.items()}
        | {"seconds": seconds}
        for k, run in enumerate(runs)
    ]


def _checked(value: Any, name: str, run: Mapping[str, Any]) -> Any:
    """A number or text of Python's own."""
    value = value.item() if isinstance(value, np.generic) else value
    if name in run or name in ("seconds", "error") or not isinstance(value, str | int | float | bool | None):
        raise InputError(f"the function gives {name} = {value!r}; it must be a number or text of another name")
    return value


def _begin(turn: Any, workers: int) -> None:
    """Choose a card for this process, if there are cards, and its share of the cores."""
    share_cores(workers)
    with turn.get_lock():
        number, turn.value = turn.value, turn.value + 1
    wp.config.log_level = wp.LOG_ERROR
    start_warp()
    count = wp.get_cuda_device_count()
    if count:
        wp.set_device(f"cuda:{number % count}")
