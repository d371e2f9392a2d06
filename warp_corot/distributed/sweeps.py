"""Sweeps: many runs with different parameters at the same time, each in a process of its own, and a table of their
results.

A journal has a line of JSON for each finished run, on the disk before the next one is noted.
"""

from __future__ import annotations

import csv
import itertools
import json
import math
import multiprocessing
import os
import pickle
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_count, checked_path, shown
from warp_corot.inputs.cpu_threads import core_count, share_cores
from warp_corot.inputs.processes import start_warp
from warp_corot.io.files.whole import written_whole

Row = dict[str, Any]
Parameters = Mapping[str, Sequence[Any]] | Sequence[Mapping[str, Any]]
#: The parameters of runs that one call makes, and such a call.
Share = tuple[dict[str, Any], ...]
Call = Callable[[Share], list[Row]]

#: Number of runs given at a time to a user's engine, whose size is not known.
HANDED_OVER = 256


def sweep(
    function: Callable[..., Any],
    parameters: Parameters,
    *,
    folder: str | PathLike[str] | None = None,
    workers: int | None = None,
    retries: int = 2,
    together: int | None = None,
    executor: Executor | None = None,
    progress: bool | None = None,
) -> list[Row]:
    """Call a function with every combination of parameters, in several processes.

    With a folder, each result is noted there as soon as it is known. Called again with the same folder, the sweep
    continues: it does not repeat finished runs, and tries failed ones again.

    Args:
        function: Called as ``function(young=1e3, poisson=0.45)``; returns a number, or a dictionary of numbers and
            texts. It must be at the top of a module, because other processes must find it.
        parameters: Values of each parameter, for all combinations; or a list with the parameters of each run.
        folder: The folder for the journal and the table, ``table.csv``.
        workers: Number of processes; None: one for each card, or for each core without cards.
        retries: How often a run is repeated that failed or whose process died.
        together: How many runs one call makes at most, such as the worlds of one simulation: the function is called
            with a list of values for each parameter, and returns a list of results, or a dictionary of such lists.
            After a call that fails, its runs are made one by one. None: one run a call, without lists.
        executor: Another engine in place of processes of this machine: any ``concurrent.futures.Executor``, such as
            ``mpi4py.futures.MPIPoolExecutor()`` or ``dask.distributed.Client(…).get_executor()``.
        progress: Whether to show a bar; None: on a terminal.

    Returns:
        For each run, in order, a dictionary of its parameters, results, ``seconds`` and ``error`` (empty if it
        succeeded).

    Raises:
        InputError: No parameters, values that are neither numbers nor texts, a folder that cannot be written to, or
            numbers out of range.
    """
    runs = combinations(parameters)
    checked_count(retries, "retries", least=0)
    if not callable(function):
        raise InputError(f"function is {shown(function)}; it must be a function of the parameters")
    if executor is None:
        _check_sent(function)
    size = 1 if together is None else checked_count(together, "together", least=1)
    window = worker_count(workers, -(-len(runs) // size), executor)
    journal = Journal(None if folder is None else checked_path(folder, "folder"))
    left = [run for run in runs if not journal.is_done(run)]
    with _bar(len(runs), progress) as show:
        show(len(runs) - len(left))
        of_runs = partial(timed, function, together is not None)
        shares = [tuple(left[k : k + size]) for k in range(0, len(left), size)]
        for done in _made(of_runs, shares, executor, window, retries):
            journal.note({name: done[name] for name in runs[0]}, done)
            show(1)
    rows = [journal.row(run) for run in runs]
    if folder is not None:
        _write_table(rows, list(runs[0]), Path(folder) / "table.csv")
    return rows


def combinations(parameters: Parameters) -> list[dict[str, Any]]:
    """The parameters of each run.

    Raises:
        InputError: There are none, or they have another form.
    """
    if isinstance(parameters, Mapping):
        for name, values in parameters.items():
            if isinstance(values, str) or not hasattr(values, "__iter__"):
                raise InputError(f"{name} is {values!r}; it must be a list of values")
        values = [[_plain(value) for value in each] for each in parameters.values()]
        runs = [dict(zip(parameters, each, strict=True)) for each in itertools.product(*values)]
    else:
        given = list(parameters) if isinstance(parameters, Iterable) else [None]
        if not all(isinstance(run, Mapping) for run in given):
            raise InputError(
                f"parameters is {shown(parameters)}; it must be lists of values by name, {{'young': [1e3, 2e3]}}, "
                "or a list of dictionaries, one a run"
            )
        runs = [{name: _plain(value) for name, value in run.items()} for run in given]
    if not runs or not runs[0]:
        raise InputError("there are no parameters to vary")
    if any(run.keys() != runs[0].keys() for run in runs):
        raise InputError("runs have parameters of different names; each must have all of them")
    if len({key_of(run) for run in runs}) < len(runs):
        raise InputError("two runs have the same parameters; each can be made once only")
    return runs


def _check_sent(function: Any) -> None:
    """Check that a function can be sent to other processes.

    Raises:
        InputError: It cannot.
    """
    try:
        pickle.dumps(function)
    except Exception as error:  # any error of what the function holds
        raise InputError(
            f"function is {shown(function)}, which cannot be sent to other processes ({shown(str(error))}); "
            "it must be at the top of a module, and hold no arrays of a device"
        ) from None


def _plain(value: Any) -> Any:
    """A number or text of Python's own."""
    value = value.item() if hasattr(value, "item") else value
    if not isinstance(value, str | int | float | bool) or (isinstance(value, float) and not math.isfinite(value)):
        raise InputError(f"a parameter is {value!r}; it must be a finite number or a text")
    return value


def _made(
    of_runs: Call, shares: Sequence[Share], executor: Executor | None, workers: int, retries: int
) -> Iterator[Row]:
    """Rows of runs as they finish. The package's own engine is made again if a worker has died."""
    waiting = deque((share, 0) for share in shares)
    while waiting:
        engine = local_executor(workers) if executor is None else executor
        try:
            yield from _until_broken(of_runs, engine, waiting, workers, retries)
        finally:
            if executor is None:
                engine.shutdown(wait=False, cancel_futures=True)
        if waiting and executor is not None:
            raise InputError("the engine of the sweep has broken; start it again, and the sweep with the same folder")


def _until_broken(
    of_runs: Call, engine: Executor, waiting: deque[tuple[Share, int]], window: int, retries: int
) -> Iterator[Row]:
    """Rows of runs as they finish, until none waits or a worker has died."""
    under_way: dict[Future[list[Row]], tuple[Share, int]] = {}
    broken = False
    while under_way or (waiting and not broken):
        # No more calls at a time than workers: when a worker dies, one of the running calls may have killed it.
        while waiting and not broken and len(under_way) < window:
            share, tries = waiting.popleft()
            try:
                under_way[engine.submit(of_runs, share)] = (share, tries)
            except BrokenExecutor:
                waiting.appendleft((share, tries))
                broken = True
        for future in wait(under_way, return_when=FIRST_COMPLETED).done:
            share, tries = under_way.pop(future)
            error = future.exception()
            broken = broken or isinstance(error, BrokenExecutor)
            if error is None:
                for run, found in zip(share, future.result(), strict=True):
                    yield {**run, **found, "error": ""}
            elif len(share) > 1:
                waiting.extend(((run,), tries) for run in share)
            elif tries < retries:
                waiting.append((share, tries + 1))
            else:
                what = "its process died" if isinstance(error, BrokenExecutor) else " ".join(str(error).split())
                yield {**share[0], "error": f"{type(error).__name__}: {what}"}


@contextmanager
def _bar(count: int, wanted: bool | None) -> Iterator[Callable[[int], Any]]:
    from tqdm import tqdm

    with tqdm(desc="sweep", total=count, unit="run", disable=None if wanted is None else not wanted) as bar:
        yield bar.update


# --- processes of this machine: one for each card, or for each core without cards -----------------------------------


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


# --- journal and tables ---------------------------------------------------------------------------------------------


def key_of(run: Mapping[str, Any]) -> str:
    """The name of a run: its parameters, in any order."""
    return json.dumps(dict(run), sort_keys=True)


class Journal:
    """Rows of runs, kept in a folder.

    Args:
        folder: The folder, made if necessary; None: rows are kept in memory only.

    Raises:
        InputError: The folder or its journal cannot be written to, or the journal is of another kind.
    """

    NAME = "runs.jsonl"

    def __init__(self, folder: Path | None):
        self._rows: dict[str, Row] = {}
        self._path = None if folder is None else folder / self.NAME
        if self._path is None:
            return
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._path.touch()
            data = self._path.read_bytes()
        except OSError as error:
            raise InputError(f"{self._path}: {error.strerror or error}") from None
        whole, _, torn = data.rpartition(b"\n")
        for number, line in enumerate(whole.splitlines(), start=1):
            try:
                found = json.loads(line)
                self._rows[key_of(found["parameters"])] = found["row"]
            except (ValueError, KeyError, TypeError):
                raise InputError(f"{self._path}, line {number}: is no line of a sweep's journal") from None
        if torn:  # a sweep was ended within a line
            os.truncate(self._path, len(data) - len(torn))

    def is_done(self, run: Mapping[str, Any]) -> bool:
        """Whether a run has succeeded."""
        return self._rows.get(key_of(run), {"error": "not made"})["error"] == ""

    def row(self, run: Mapping[str, Any]) -> Row:
        """The row of a run."""
        return self._rows[key_of(run)]

    def note(self, run: Mapping[str, Any], row: Row) -> None:
        """Keep the row of a run; it is on the disk when the call returns.

        Raises:
            OSError: It cannot be written, for example because the disk is full.
        """
        self._rows[key_of(run)] = row
        if self._path is not None:
            with self._path.open("a", encoding="utf-8") as file:
                file.write(json.dumps({"parameters": dict(run), "row": row}) + "\n")
                file.flush()
                os.fsync(file.fileno())


def _write_table(rows: Sequence[Row], parameters: Sequence[str], path: Path) -> None:
    """Write the rows of all runs to a CSV file, whole; the parameters come first."""
    names = list(dict.fromkeys([*parameters, *(name for row in rows for name in row)]))
    names = [name for name in names if name not in ("seconds", "error")] + ["seconds", "error"]
    with written_whole(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, names, restval="")
        table.writeheader()
        table.writerows(rows)
