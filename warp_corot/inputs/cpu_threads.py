"""Threads of a CPU that compute the parts of a launch side by side; see ``kernels.stepping.team``."""

from __future__ import annotations

import atexit
import ctypes
import functools
import itertools
import os
import sys
import threading
from collections.abc import Callable, Hashable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from warp._src import context

from warp_corot.kernels.stepping import team as kernels

from .processes import process_count

#: Inputs and outputs of a part's launch, from its number and a function that takes its entries.
Arguments = Callable[[int, Callable[[Any], Any]], tuple[list, list]]
#: With fewer elements for each thread, waiting for one another takes longer than they save. More than two threads gain
#: less, and on some machines, in contact, nothing: without ``threads`` each has twice as many elements.
LEAST_ELEMENTS = 2048
#: Launches for things that differ in cost have so many parts for each core; fewer things are not worth a second core.
PARTS, LEAST_THINGS = 4, 8192
#: The most threads, and the lines of their words; see ``kernels/native/team.h``.
MOST = 1023
_LOCK, _STOP, _CALLS, _PIPE, _OWN = 4, 6, slice(7, 10), 10, 11
#: At the end, how many processes share the cores.
_processes = [1]
#: In ``launches``, those of the part that the thread records.
_recording = threading.local()


def core_count() -> int:
    """Cores that this process may use, by its affinity and by the quota of its container; MPI's processes and those of
    a sweep share them."""
    allowed = getattr(os, "process_cpu_count", os.cpu_count)() or 1
    if hasattr(os, "sched_getaffinity"):
        allowed = min(allowed, len(os.sched_getaffinity(0)))
    try:
        quota, period = Path("/sys/fs/cgroup/cpu.max").read_text(encoding="ascii").split()
        allowed = min(allowed, int(quota) // int(period))
    except (OSError, ValueError):  # another system, or "max"
        pass
    return max(allowed // max(process_count(), _processes[-1]), 1)


def share_cores(processes: int) -> None:
    """Let so many processes share the cores, this one among them."""
    _processes.append(processes)


def launch(kernel: wp.Kernel, dim: int | tuple[int, ...], inputs: list, outputs: Sequence = (), **options: Any) -> None:
    """``wp.launch``, or, inside a phase of a ``Region``, one launch of the part."""
    launches = getattr(_recording, "launches", None)
    if launches is None:
        wp.launch(kernel, dim, inputs, outputs, **options)
    elif dim:
        launches.append(wp.launch(kernel, dim, inputs, outputs, record_cmd=True, **options))


class _Threads:
    """The threads that work for others; they sleep when there is no work."""

    def __init__(self) -> None:
        lines = _OWN + MOST
        self._memory = (ctypes.c_uint64 * (8 * (lines + 1)))()
        self.address = -(-ctypes.addressof(self._memory) // 64) * 64
        first = (self.address - ctypes.addressof(self._memory)) // 8
        self._words = np.ctypeslib.as_array(self._memory)[first : first + 8 * lines].reshape(lines, 8)
        system = ctypes.CDLL(None)
        calls = (system.sched_yield, system.usleep, system.write)
        self._words[_CALLS, 0] = [ctypes.cast(call, ctypes.c_void_p).value for call in calls]
        self._begin(1)
        os.register_at_fork(after_in_child=lambda: self._begin(self._count))  # a forked process has none of them
        atexit.register(self._stop)

    def _begin(self, count: int) -> None:
        self._pipe, self._count = os.pipe(), 1
        self._threads: list[threading.Thread] = []
        self._words[_LOCK, 0], self._words[_PIPE, 0] = 0, self._pipe[1]
        self._words[_OWN:] = 2 * self._words[0, 0] + 1, 1, *[0] * 6
        self.grow(count)

    def grow(self, count: int) -> None:
        """Let there be so many threads at least, with the caller."""
        for k in range(self._count, count):
            call = _call_of(wp.launch(kernels.serve, 1, [self.address, k], device="cpu", record_cmd=True))
            self._threads.append(threading.Thread(target=self._serve, args=(call,), daemon=True))
            self._threads[-1].start()
            self._count += 1

    def _serve(self, call: tuple[int, Any, Any]) -> None:
        entry, *arguments = call
        serve = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)(entry)
        while not self._words[_STOP, 0]:
            os.read(self._pipe[0], 1)
            serve(*map(ctypes.addressof, arguments))

    def _stop(self) -> None:
        """End the threads, before Python unloads the kernel in which they wait."""
        self._words[_STOP, 0] = 1
        os.write(self._pipe[1], bytes(self._count))
        for thread in self._threads:
            thread.join(1.0)


class Team:
    """Threads that compute as many parts: the one that launches, and some of those that all teams share.

    Args:
        parts: Number of parts, at most ``MOST``.
        threads: Number of threads; None: as many as parts.

    Attributes:
        parts: As given.
        address: Of the words in ``kernels/native/team.h``; 0 if there is one part.
    """

    def __init__(self, parts: int, threads: int | None = None):
        self.parts, self.address = parts, 0
        if parts > 1:
            _threads().grow(threads or parts)
            self.address = _threads().address

    def bounds(self, count: int, step: int = 1, worlds: int = 1) -> list[tuple[int, int]]:
        """The beginning and the end of each part of ``count`` things, about equal ones; each begins at a multiple of
        ``step``, and with several ``worlds`` at that of one of them."""
        if worlds > 1:
            step = max(count // worlds, 1)
        steps = -(-count // step)
        edges = [min(step * (steps * part // self.parts), count) for part in range(self.parts + 1)]
        return list(itertools.pairwise(edges))


class Region:
    """Launches side by side, in phases: no part begins a phase before all parts have ended the one before.

    Args:
        team: The threads.
        phases: Functions that make the launches of a part, by ``launch`` of this module. Parts of a phase write to
            different places.
    """

    def __init__(self, team: Team, phases: Sequence[Callable[[int], None]]):
        self._team, each = team, [_recorded(phase, part) for phase in phases for part in range(team.parts)]
        starts = 3 + len(each) + 3 * np.cumsum([0, *map(len, each)])
        self._calls = [_call_of(command) for commands in each for command in commands]
        words = [word for entry, *given in self._calls for word in (entry, *map(ctypes.addressof, given))]
        self._table = np.array([len(phases), team.parts, *starts, *words], np.uint64)

    def launch(self) -> None:
        """Launch all parts, recorded or at once. The region must exist as long as the recording."""
        wp.launch(kernels.run, 1, [self._team.address, self._table.ctypes.data], device="cpu")


class Regions:
    """Launches side by side, which recordings keep as long as they exist.

    Args:
        team: The threads. If there is one, it makes the launches as they are.
        device: The device of the launches; a team on CUDA is one thread.
    """

    def __init__(self, team: Team, device: wp.Device):
        self.team, self.device = team, device

    def launch(self, key: Hashable, *phases: Callable[[int], None]) -> None:
        """Launch the phases of a ``Region``, recorded or at once.

        Args:
            key: The same for the same launches of one recording.
            phases: As for ``Region``.
        """
        if self.team.parts == 1:
            for phase in phases:
                phase(0)
            return
        recording = vars(context.runtime._apic_graph).setdefault("regions", {}) if self.device.is_capturing else {}
        if (self, key) not in recording:
            recording[self, key] = Region(self.team, phases)
        recording[self, key].launch()

    def launch_over(self, kernel: wp.Kernel, count: int, arguments: Arguments, *key: Hashable) -> None:
        """Launch a kernel with a thread for each of ``count`` things, each part with arrays of its own things.

        Args:
            kernel, count: The kernel and the number of its threads.
            arguments: Gives inputs and outputs; its argument is a function that takes what has an entry for each thing,
                an array or a struct, to the part of it. Others are the same for all parts.
            key: As for ``launch``.
        """
        bounds = self.team.bounds(count)

        def phase(part: int) -> None:
            begin, end = bounds[part]
            inputs, outputs = arguments(part, lambda whole: part_of(whole, begin, end))
            launch(kernel, end - begin, inputs, outputs, device=self.device)

        self.launch((kernel, *key), phase)

    def launch_from(
        self, kernel: wp.Kernel, dim: int | tuple[int, int], inputs: list, outputs: list, *key: Hashable
    ) -> None:
        """Launch a kernel with so many threads, or so many for each world, whose first input is the number from which
        these count; ``key`` as for ``launch``."""
        *worlds, count = dim if isinstance(dim, tuple) else (dim,)
        first, *others = inputs
        bounds = self.team.bounds(count)

        def phase(part: int) -> None:
            begin, end = bounds[part]
            launch(kernel, (*worlds, end - begin), [first + begin, *others], outputs, device=self.device)

        self.launch((kernel, *key), phase)


def launch_side_by_side(
    kernel: wp.Kernel,
    count: int,
    arguments: Callable[[Callable[[Any], Any]], tuple[list, list]],
    device: wp.Device,
) -> None:
    """Launch a kernel with a thread for each of ``count`` things, on all cores if ``device`` is the CPU; ``arguments``
    as for ``Regions.launch_over``, without the part's number."""
    cores = core_count() if device.is_cpu and count >= LEAST_THINGS and sys.platform != "win32" else 1
    team = team_of(1) if cores == 1 else team_of(min(PARTS * cores, MOST), cores)
    Regions(team, device).launch_over(kernel, count, lambda _, own: arguments(own))


def part_of(whole: Any, begin: int, end: int) -> Any:
    """Some entries of an array, or of the arrays of a struct that have one for each element, as views; or the number of
    a thing, counted from ``begin``."""
    if isinstance(whole, (int, np.integer)):
        return whole - begin
    if isinstance(whole, wp.array):
        return whole if begin == 0 and end == len(whole) else whole[begin:end]
    part = type(whole)()
    part.assign(whole)
    of_elements = ("nodes", "targets", "code", "first", "rest_inverse", "volume", "numbers", "shared")
    for name in ("mu", "lam") if getattr(whole, "stride", 0) else of_elements:
        if getattr(whole, name, None):
            setattr(part, name, getattr(whole, name)[begin:end])
    if hasattr(whole, "shared"):
        part.isotropic = part_of(whole.isotropic, begin, end)
    return part


team_of = functools.cache(Team)


@functools.cache
def _threads() -> _Threads:
    return _Threads()


def team_for(threads: int | None, elements: int, worlds: int = 1) -> Team:
    """The team for a body on the CPU: as many threads as are worth it, ``threads`` at most; None: all cores. Threads
    take whole worlds, each of which then moves as it would alone in one thread."""
    most = min(core_count() if threads is None else threads, MOST if worlds == 1 else worlds)
    worth = elements // LEAST_ELEMENTS
    if threads is None:
        worth = min(worth, max(worth // 2, 2))
    return team_of(1 if sys.platform == "win32" else max(min(most, worth), 1))


def _recorded(phase: Callable[[int], None], part: int) -> list[wp.Launch]:
    launches: list[wp.Launch] = []
    _recording.launches = launches
    try:
        phase(part)
    finally:
        del _recording.launches
    return launches


def _call_of(command: wp.Launch) -> tuple[int, Any, Any]:
    """A kernel's entry on the CPU, and its two arguments."""
    bounds, *values = command.params
    arguments = _arguments(tuple(type(value) for value in values))(*values)
    arguments.command = command  # owns what the values refer to
    return ctypes.cast(command.hooks.forward, ctypes.c_void_p).value or 0, bounds, arguments


@functools.cache
def _arguments(types: tuple[type, ...]) -> type:
    """The struct of a kernel's arguments."""
    return type("Arguments", (ctypes.Structure,), {"_fields_": [(f"_{k}", of) for k, of in enumerate(types)]})
