"""``warp-corot verify``: cases with known answers as a table, and as JSON."""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warp_corot.errors import InputError
from warp_corot.inputs.arguments import meant
from warp_corot.io.files.whole import check_output, written_whole

from .terminal import complain

if TYPE_CHECKING:
    from warp_corot.experiments import Row

#: Exit status if a row does not pass.
BEYOND = 4
HEAD = f"{'case':18}{'quantity':38}{'result':>11}{'reference':>11} {'':6}{'error':>9}{'allowed':>9}  "


def run(args: argparse.Namespace) -> int:
    """Run the command; returns the exit status.

    Raises:
        InputError: There is no such case or device, or the file cannot be written; nothing was run.
    """
    from warp_corot.experiments import CASES, Setup, run_case
    from warp_corot.inputs.checks import checked_device
    from warp_corot.simulation.progress import hidden

    from .terminal import tell_compiling

    if args.list:
        for case in CASES.values():
            print(f"{case.name:18}{case.about}\n{'':18}reference: {case.source}")
        return 0
    names = list(dict.fromkeys(args.cases or CASES))
    for name in names:
        if name not in CASES:
            raise InputError(f"there is no case {name}{meant(name, CASES)}; warp-corot verify --list has all")
    if args.json is not None:
        check_output(args.json, ".json")
    device = checked_device(args.device)
    setup = Setup(str(device), full=args.full)
    told: list[dict[str, Any]] = []
    took = 0.0
    print(HEAD + "source")
    tell_compiling(device)
    with hidden():
        for name in names:
            rows, seconds = run_case(name, setup)
            for row in rows:
                print(line(name, row) + CASES[name].source, flush=True)
                more = {"error": float(row.error), "passes": bool(row.passes), "source": CASES[name].source}
                told.append({"case": name, **asdict(row), **more})
            took += seconds
    beyond = sum(not row["passes"] for row in told)
    print(f"{len(told) - beyond} of {len(told)} rows pass on {device}, in {took:.0f} s")
    if args.json is not None:
        finite = [
            {
                key: value if isinstance(value, str | bool | None) else float(value) if math.isfinite(value) else None
                for key, value in row.items()
            }
            for row in told
        ]
        head = {"schema": "warp-corot/verify", "schema_version": 1, "full": args.full, "seconds": round(took, 1)}
        write_json(args.json, {**head, **environment(device), "rows": finite})
    if beyond:
        complain(f"{beyond} rows are beyond what is allowed")
    return BEYOND if beyond else 0


def line(name: str, row: Row) -> str:
    """A row of the table, less its source."""
    error, bound = (f"{100.0 * share:.2g} %" for share in (row.error, row.bound))
    verdict = "" if row.passes else "FAILS "
    return (
        f"{name:18}{row.quantity:38}{row.result:11.5g}{row.reference:11.5g} {row.unit:6}{error:>9}{bound:>9}  {verdict}"
    )


def environment(device: wp.Device) -> dict:
    """Versions, machine and device, as plain values."""
    from warp_corot import __version__

    return {
        "versions": {
            "warp_corot": __version__,
            "warp": wp.config.version,
            "numpy": np.__version__,
            "python": platform.python_version(),
        },
        "machine": {"system": platform.system(), "processor": processor_name(), "cores": os.cpu_count()},
        "device": {"alias": str(device), "name": device_name(device), "cuda": device.is_cuda},
    }


def write_json(path: Path, content: dict) -> None:
    """Write a JSON file to a temporary file and rename it.

    Raises:
        OSError: It could not be written; a former file stays.
    """
    text = json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False)
    with written_whole(path) as part:
        part.write_text(text + "\n", encoding="utf-8")


def device_name(device: wp.Device) -> str:
    """Name of the GPU or the processor."""
    return device.name if device.is_cuda else f"CPU ({processor_name()}, one core)"


def processor_name() -> str:
    """Name of the processor if the system gives it, else its architecture."""
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
