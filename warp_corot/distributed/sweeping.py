"""Sweeps: many runs with different parameters at the same time, which of them are finished, and their results."""

from __future__ import annotations

import itertools
import math
import pickle
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, wait
from contextlib import contextmanager
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_count, checked_path, shown

from .journal import Journal, Row, key_of
from .tables import write_tables
from .workers import local_executor, timed, worker_count

Parameters = Mapping[str, Sequence[Any]] | Sequence[Mapping[str, Any]]
#: The parameters of runs that one call makes, and such a call.
Share = tuple[dict[str, Any], ...]
Call = Callable[[Share], list[Row]]


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
        folder: The folder for the journal, tables (CSV and, with pyarrow, Parquet) and a picture.
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
        write_tables(rows, list(runs[0]), Path(folder))
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
