"""Timing and reporting shared by the benchmark scripts.

Every case is recorded in a separate graph and replayed. All cases are timed in turn, round after round, so that
other load on the machine affects all alike; the median and the spread (interquartile range over median) are over the
rounds. On CUDA the clock is a pair of events around the replay, on the CPU the wall clock.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

import warp_corot as wc
from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_device

#: A sample replays its graph for about this long [s].
SAMPLE_SECONDS = {"cuda": 3e-3, "cpu": 3e-2}
MAX_LAUNCHES = 256

#: Size of each of the two arrays of the bandwidth test [bytes]; far larger than any cache.
COPY_BYTES = {"cuda": 1 << 30, "cpu": 1 << 28}

#: A larger relative error is not rounding.
WRONG = 1e-3


@dataclass
class Case:
    """One row of the table.

    Attributes:
        stage, variant: Names of the row.
        run: Launches the work once (``repeats`` times the reported work).
        error: Runs the work once and returns its error against the float64 reference.
        tets: Number of tetrahedra in one repeat.
        bytes: Minimum memory traffic of one tetrahedron [B]; None if unknown.
        flops: Minimum number of additions, multiplications, divisions and roots of one tetrahedron; or None.
        repeats: Number of repeats in ``run``.
        recorded: Whether ``run`` is recorded in a graph here; False if it replays its own graphs, None if
            that is another program's code and recording must be tried.
        reset: Restores the state before each sample, outside the measured time.
        wrong: Errors above this are failures; None where ``error`` measures something else.
        extra: More figures for the table and the JSON.
    """

    stage: str
    variant: str
    run: Callable[[], object]
    error: Callable[[], float]
    tets: int
    bytes: float | None = None
    flops: float | None = None
    repeats: int = 1
    recorded: bool | None = True
    reset: Callable[[], object] | None = None
    wrong: float | None = WRONG
    extra: dict[str, Any] = field(default_factory=dict)


@dataclass
class Result:
    """A case and its samples in ns per tetrahedron, one a round."""

    case: Case
    error: float
    samples: np.ndarray

    @property
    def ns(self) -> float:
        return float(np.median(self.samples))

    @property
    def spread(self) -> float:
        low, high = np.percentile(self.samples, [25, 75])
        return float((high - low) / self.ns)

    @property
    def wrong(self) -> bool:
        return self.case.wrong is not None and not self.error <= self.case.wrong

    def relative_to(self, other: Result) -> float:
        """Time over the other's, round by round; the median."""
        return float(np.median(self.samples / other.samples))

    def as_dict(self, copy_gb_s: float) -> dict[str, Any]:
        case = self.case
        return {
            "stage": case.stage,
            "variant": case.variant,
            "tets": case.tets,
            "ns_per_tet": self.ns,
            "spread": self.spread,
            "gtet_per_s": 1.0 / self.ns,
            "bytes_per_tet": case.bytes,
            "flops_per_tet": case.flops,
            "copy_fraction": None if case.bytes is None else case.bytes / self.ns / copy_gb_s,
            "error": self.error,
            **case.extra,
        }


class Stopwatch:
    """Wall time of launches [s]: events on CUDA, wall clock on the CPU."""

    def __init__(self, device: wp.Device):
        self.device = device
        if device.is_cuda:
            self._events = [wp.Event(device, enable_timing=True) for _ in range(2)]

    def seconds(self, run: Callable[[], object]) -> float:
        wp.synchronize_device(self.device)
        if not self.device.is_cuda:
            start = time.perf_counter()
            run()
            return time.perf_counter() - start
        first, last = self._events
        with wp.ScopedDevice(self.device):
            wp.record_event(first)
            run()
            wp.record_event(last)
        return wp.get_event_elapsed_time(first, last) / 1e3


def kind(device: wp.Device) -> str:
    return "cuda" if device.is_cuda else "cpu"


def copy_bandwidth(device: wp.Device, byte_count: int | None = None) -> float:
    """Rate of a plain copy between two large arrays [GB/s]; bytes read and bytes written both count."""
    count = (COPY_BYTES[kind(device)] if byte_count is None else byte_count) // 16
    source, target = (wp.zeros(count, dtype=wp.vec4, device=device) for _ in range(2))
    watch = Stopwatch(device)
    times = [watch.seconds(lambda: wp.copy(target, source)) for _ in range(12)]
    return 2 * 16 * count / float(np.median(times[2:])) / 1e9


def measure(cases: Sequence[Case], device: wp.Device, rounds: int, tell: Callable[[str], None]) -> list[Result]:
    """Check every case against its reference, then time all of them in turn."""
    watch = Stopwatch(device)
    errors, samplers = [], []
    for case in cases:
        tell(f"{case.stage}: {case.variant}")
        errors.append(float(case.error()))
        samplers.append(_sampler(case, device, watch))
    taken = np.zeros((len(cases), rounds))
    for k in range(rounds):
        tell(f"timing, round {k + 1} of {rounds}")
        for index, (case, (launch, launches)) in enumerate(zip(cases, samplers, strict=True)):
            if case.reset is not None:
                case.reset()
            taken[index, k] = watch.seconds(launch) / (launches * case.repeats * case.tets)
    return [Result(c, e, s) for c, e, s in zip(cases, errors, 1e9 * taken, strict=True)]


def _sampler(case: Case, device: wp.Device, watch: Stopwatch) -> tuple[Callable[[], object], int]:
    """The launches of one sample, and the number of runs in it."""
    if case.reset is not None:
        case.reset()
    once = min(watch.seconds(case.run) for _ in range(2))
    if case.recorded is False:
        return case.run, 1
    launches = int(np.clip(math.ceil(SAMPLE_SECONDS[kind(device)] / max(once, 1e-9)), 1, MAX_LAUNCHES))
    try:
        with wp.ScopedCapture(device=device) as capture:
            for _ in range(launches):
                case.run()
        graph = capture.graph
        wp.capture_launch(graph)
    except Exception:
        if case.recorded:
            raise
        case.extra["graph"] = False
        return case.run, 1
    return lambda: wp.capture_launch(graph), launches


# --- the command line -------------------------------------------------------------------------------------------------


class Parser(argparse.ArgumentParser):
    """Reports errors in one line."""

    def error(self, message: str) -> Any:
        self.exit(2, f"{self.prog}: error: {' '.join(message.split())}\n")


def parser(description: str, prog: str) -> Parser:
    found = Parser(prog=prog, description=description)
    found.add_argument("--device", help="cpu, cuda:0, … (default: Warp's)")
    found.add_argument("--level", type=int, help="level of the bisected cube (default: 21 on CUDA, 15 on the CPU)")
    found.add_argument("--rounds", type=int, help="how often each row is timed (default: 21 on CUDA, 9 on the CPU)")
    found.add_argument("--json", type=Path, metavar="FILE", help="write everything to this file, too")
    return found


def checked(options: argparse.Namespace, of: Parser, levels: range) -> wp.Device:
    """Fill in defaults and report invalid options in one line; returns the device."""
    wp.config.log_level = wp.LOG_ERROR  # before Warp starts, so that it prints no banner
    try:
        device = checked_device(options.device)
    except InputError as error:
        of.error(str(error))
    if options.level is None:
        options.level = 21 if device.is_cuda else 15
    if options.level not in levels:
        of.error(f"--level is {options.level}; it must be from {levels.start} to {levels.stop - 1}")
    if options.rounds is None:
        options.rounds = 21 if device.is_cuda else 9
    if options.rounds < 1:
        of.error(f"--rounds is {options.rounds}; it must be at least 1")
    if options.json is not None:
        folder = options.json.resolve().parent
        if not folder.is_dir() or not os.access(folder, os.W_OK):
            of.error(f"--json: the folder {folder} does not exist or cannot be written to")
        if options.json.is_dir():
            of.error(f"--json: {options.json} is a folder; it must be a file name")
    return device


def tell(message: str) -> None:
    """Print progress on stderr: one line that is overwritten on a terminal."""
    if sys.stderr.isatty():
        print(f"\r\033[K{message}", end="", file=sys.stderr, flush=True)


# --- the report -------------------------------------------------------------------------------------------------------


def machine(device: wp.Device) -> dict[str, Any]:
    return {
        "device": str(device),
        "name": device.name if device.is_cuda else _processor(),
        "warp": wp.__version__,
        "warp_corot": wc.__version__,
        "python": platform.python_version(),
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def table(header: Sequence[str], rows: Sequence[Sequence[str]], left: int) -> str:
    """Columns as wide as they need; the first ``left`` flush left, numbers flush right."""
    lines = [list(header), *map(list, rows)]
    widths = [max(len(line[c]) for line in lines) for c in range(len(header))]
    cells = [
        [x.ljust(w) if c < left else x.rjust(w) for c, (x, w) in enumerate(zip(line, widths, strict=True))]
        for line in lines
    ]
    rule = ["-" * w for w in widths]
    return "\n".join("  ".join(line).rstrip() for line in [cells[0], rule, *cells[1:]])


def number(value: float | None, digits: int = 3) -> str:
    """A figure with some digits; a dash for none."""
    if value is None:
        return "-"
    if not math.isfinite(value):
        return str(value)
    if value == 0:
        return "0"
    if not 1e-3 <= abs(value) < 1e6:
        return f"{value:.1e}"
    decimals = max(0, digits - 1 - math.floor(math.log10(abs(value))))
    return f"{value:.{decimals}f}"


def percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.{1 if value < 0.1 else 0}f} %"


def finish(options: argparse.Namespace, report: dict[str, Any], results: Sequence[Result]) -> int:
    """Write the JSON and name wrong results; returns the exit status."""
    if sys.stderr.isatty():
        print("\r\033[K", end="", file=sys.stderr)
    if options.json is not None:
        save(options.json, report)
    failed = [r for r in results if r.wrong]
    for r in failed:
        print(f"WRONG: {r.case.stage}, {r.case.variant}: error {r.error:.1e} against float64", file=sys.stderr)
    return 1 if failed else 0


def save(path: Path, report: dict[str, Any]) -> None:
    """Write a report, completely or not at all."""
    draft = path.with_name(path.name + ".part")
    draft.write_text(json.dumps(report, indent=1) + "\n")
    draft.replace(path)
    print(f"wrote {path}")
