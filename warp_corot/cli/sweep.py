"""``warp-corot sweep``: the same run with many parameters, several at a time, and a table of the results."""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_corot.errors import InputError
from warp_corot.io.files.whole import written_whole

from .terminal import complain, interrupt_status

if TYPE_CHECKING:
    from warp_corot.distributed.sweeps import Row

#: Options that a sweep sets itself.
OWN = ("input", "output", "csv", "preview", "also", "write_run")
#: Where runs write, below the sweep's folder.
RUNS = "runs"


def run(args: argparse.Namespace) -> int:
    """Run the command; returns the exit status.

    Raises:
        InputError: Bad options; nothing was simulated.
    """
    from warp_corot.distributed.sweeps import combinations, sweep

    from .input_file import open_input
    from .run_file import bodies_of

    if args.output is None:
        raise InputError("-o is missing; it must name the folder of the results, for example -o results")
    varied = dict(values_of(text) for text in args.vary)
    if len(varied) < len(args.vary):
        raise InputError("--vary names an option twice")
    given = [(f"--{name}", getattr(args, name)) for name in ("duration", "device") if getattr(args, name)]
    others = [word for pair in given for word in pair]
    others += [word for probe in args.probe or () for word in ("--probe", probe)]
    inputs: set[str] = set()
    for each in combinations(varied):
        inputs |= {body.input for body in bodies_of(options_of(args.input, others, each, args.output))}
    for name in sorted(inputs):
        open_input(name)  # rather than in each run
    try:
        (args.output / RUNS).mkdir(parents=True, exist_ok=True)
        # Finished runs in the folder must have had the same input and options.
        is_file = args.input.lower().endswith(".toml")
        text: object = Path(args.input).read_text(encoding="utf-8") if is_file else ""
        told, path = {"input": args.input, "options": others, "run_file": text}, args.output / "sweep.json"
        if not path.exists():
            with written_whole(path) as part:
                part.write_text(json.dumps(told), encoding="utf-8")
        with contextlib.suppress(ValueError):
            text = json.loads(path.read_text(encoding="utf-8"))
        if text != told:
            raise InputError(f"{args.output} has results of another input or of other options; name another folder")
        function = partial(simulated, _input=args.input, _others=others, _folder=str(args.output))
        rows = sweep(function, varied, folder=args.output, workers=args.workers, retries=args.retries)
    except KeyboardInterrupt as signalled:
        complain(f"interrupted; finished runs are kept in {args.output}, and the same command continues", kind="")
        return interrupt_status(signalled)
    except OSError as error:
        complain(f"{args.output}: {error.strerror or error}")
        return 1
    failed = [row for row in rows if row["error"]]
    print(f"{len(rows) - len(failed)} of {len(rows)} runs, written to {args.output / 'table.csv'}")
    if failed:
        complain(f"{len(failed)} runs failed, the first with {failed[0]['error']}")
    return 3 if failed else 0


def values_of(text: str) -> tuple[str, list[Any]]:
    """The name of an option, and its values: numbers in SI units, or texts.

    Raises:
        InputError: Not of this form, no such option, or a value that it does not take.
    """
    from .run_file import option_of

    name, equals, given = text.partition("=")
    name = name.strip().lstrip("-").replace("-", "_")
    if not equals or not given:
        raise InputError(f"--vary {text!r}: it must be OPTION=VALUES, for example young=1kPa,5kPa")
    if name in OWN:
        raise InputError(f"--vary {text!r}: the sweep sets {name} itself")
    parse = option_of(name)
    pieces = given.split(":")
    if len(pieces) in (3, 4) and pieces[2].isdigit() and "," not in given:
        first, last = (parse(piece) for piece in pieces[:2])
        count, spacing = int(pieces[2]), pieces[3] if len(pieces) == 4 else "linear"
        if spacing not in ("log", "linear") or count < 2 or not isinstance(first, float | int):
            raise InputError(f"--vary {text!r}: it must be FIRST:LAST:COUNT or FIRST:LAST:COUNT:log with two or more")
        if spacing == "log" and not (first > 0 and last > 0):
            raise InputError(f"--vary {text!r}: both ends must be positive for :log")
        make = np.geomspace if spacing == "log" else np.linspace
        return name, make(first, last, count).tolist()
    return name, [parse(piece) for piece in given.split(",")]


def options_of(source: str, others: list[str], values: dict[str, Any], folder: Path) -> argparse.Namespace:
    """The options of one run, checked.

    Raises:
        InputError: A value is out of its range, or the input's run file is wrong.
    """
    from . import Parser
    from .options import add_command

    name = folder / RUNS / name_of(values)
    words = ["simulate", source, *others, "-o", f"{name}.usd", "--csv", f"{name}.csv"]
    for option, value in values.items():
        words += [f"--{option.replace('_', '-')}", f"{value!r}" if isinstance(value, float) else str(value)]
    parser = Parser(prog="warp-corot")
    add_command(parser.add_subparsers(dest="command", parser_class=Parser), "simulate")
    args = parser.parse_args(words)
    args.command_line = "warp-corot " + " ".join(words)
    return args


def name_of(values: dict[str, Any]) -> str:
    """The name of a run's files: the same for the same parameters."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:12]


def simulated(*, _input: str, _others: list[str], _folder: str, **values: Any) -> Row:
    """The result of one run: the last row of its table, and the largest displacement.

    Raises:
        InputError, UnstableError, OSError: As from simulate.
    """
    import csv

    import warp as wp

    from .simulate import Simulated

    wp.config.log_level = wp.LOG_ERROR
    wp.config.enable_backward = False
    folder = Path(_folder)
    args = options_of(_input, _others, values, folder)
    log = (folder / RUNS / f"{name_of(values)}.log").open("w", encoding="utf-8")
    with log, contextlib.redirect_stdout(log), contextlib.redirect_stderr(log):
        made = Simulated(args, alone=False)
        made.record()
    with open(folder / RUNS / f"{name_of(values)}.csv", newline="", encoding="utf-8") as file:
        heads, *rows = csv.reader(file)
    found: Row = {name: float(value) for name, value in zip(heads, rows[-1], strict=True)}
    return found | {"largest displacement [m]": made.done.largest_displacement, "steps": made.done.steps}
