"""The command ``warp-corot``: its subcommands, one module each, and the handling of their errors."""

from __future__ import annotations

import argparse
import functools
import logging
import os
import re
import shlex
import sys
import time
import warnings
from collections.abc import Collection, Sequence
from importlib import import_module
from importlib.metadata import version
from types import ModuleType
from typing import Any, NoReturn

from warp_corot.errors import InputError, UnstableError
from warp_corot.inputs.arguments import meant
from warp_corot.inputs.importing import uncollected
from warp_corot.inputs.processes import process_number
from warp_corot.inputs.stopwatch import WATCH

from .options import COMMANDS, EXIT_CODES, add_command
from .terminal import (
    REPORTED_WITHIN,
    as_option,
    complain,
    end_others,
    interrupt_status,
    leaving_at_once,
    open_streams,
    silence,
    terminable,
)

#: Exit statuses of runs that failed, and not by a signal.
FAILED = (1, 2, 3)


def subcommand(name: str) -> ModuleType:
    """The module that runs a subcommand; it imports the whole package, which takes a while."""
    return import_module(f".{name.replace('-', '_')}", __name__)


class Parser(argparse.ArgumentParser):
    """Reports errors in one line, and accepts -1e3 as a number, but neither abbreviations nor ``--`` as a value, which
    argparse turns into an empty list."""

    def __init__(self, **options: Any):
        options.setdefault("allow_abbrev", False)
        options.setdefault("formatter_class", argparse.RawDescriptionHelpFormatter)
        super().__init__(**options)
        self._negative_number_matcher = re.compile(r"^-(\d|\.\d|inf|nan)")

    def _get_values(self, action: argparse.Action, arg_strings: list[str]) -> Any:
        if action.option_strings and "--" in arg_strings:
            self.error(f"argument {'/'.join(action.option_strings)}: '--' is not a value")
        return super()._get_values(action, arg_strings)

    def error(self, message: str) -> NoReturn:
        known = re.search(r"invalid choice: '([^']*)' \(choose from (.*)\)$", message)
        if known:
            message += meant(known[1], re.findall(r"[\w.-]+", known[2]))
        complain(f"{message} (see {self.prog} --help)")
        sys.exit(2)

    def parse_known_args(self, args=None, namespace=None):
        """Parse like argparse; the subcommand's parser reports unknown options, since it knows similar ones."""
        found, unknown = super().parse_known_args(args, namespace)
        options = [word for word in unknown if word.startswith("-") and len(word) > 1]
        if options:
            name = options[0].partition("=")[0]
            self.error(f"there is no option {name}{meant(name, self._option_string_actions)}")
        if unknown:
            cure = "names with spaces need quotation marks, and a unit follows its number without one, as in 5kPa"
            self.error(f"{unknown[0]!r} is one word too many; {cure}")
        return found, unknown


def make_parser(needed: Collection[str] = COMMANDS) -> argparse.ArgumentParser:
    """The parser of the command line.

    Args:
        needed: The subcommands whose options it knows. Of the others it has the names, and nothing is imported.
    """
    from warp_corot import __version__

    parser = Parser(
        prog="warp-corot",
        description="Corotational finite elements for soft tissue, on CPU and CUDA.",
        epilog="Example: warp-corot simulate warp:bear -o bear.usd\n\n" + EXIT_CODES,
    )
    parser.add_argument(
        "--version", action="version", version=f"warp-corot {__version__} (warp {version('warp-lang')})"
    )
    subparsers = parser.add_subparsers(dest="command", metavar="COMMAND", required=True, parser_class=Parser)
    for name, command in COMMANDS.items():
        if name in needed:
            add_command(subparsers, name)
        else:
            subparsers.add_parser(name, help=command.line)
    return parser


def main(argv: Sequence[str] | None = None, spent: float = 0.0) -> int:
    """Run the command line; returns the exit status.

    Args:
        argv: The words after the command's name; None: those of this process.
        spent: Time that the process has taken for its start [s].
    """
    WATCH.begin("importing", spent)
    open_streams()
    is_silent = process_number() > 0
    if is_silent:  # from here on: rank 0 prints for all ranks
        sys.stdout = sys.stderr = open(os.devnull, "w")  # noqa: SIM115 (open as long as the process lives)
    status: object = None
    try:
        status = found = _main(argv)
    except SystemExit as end:  # of the parser
        status = end.code
        raise
    finally:
        if "warp" in sys.modules:
            from warp_corot.inputs.loading import give_up

            give_up(settled=True)
        if is_silent and status in FAILED:
            time.sleep(REPORTED_WITHIN)  # `mpirun` ends all others then; rank 0 first reports the error
    if found in FAILED and not is_silent:
        end_others(found)
    return found


def _main(argv: Sequence[str] | None) -> int:
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
    try:
        with terminable(), warnings.catch_warnings():
            # Each warning is printed once.
            once = functools.cache(lambda message: complain(as_option(message), kind="warning"))
            warnings.showwarning = lambda message, *_, **__: once(str(message))
            status = _run(argv)
            sys.stdout.flush()
        return status
    except InputError as error:
        complain(as_option(str(error)))
        return 2
    except UnstableError as error:
        complain(as_option(str(error)))
        return 3
    except KeyboardInterrupt as signalled:
        complain("interrupted", kind="")
        return interrupt_status(signalled)
    except BrokenPipeError:  # the reader of the output has gone, for example `head`
        silence(sys.stdout)
        return 141
    except OSError as error:  # commands handle the files they write: this is stdout, or Warp's kernel cache
        silence(sys.stdout)
        complain(f"{error.filename or 'standard output'}: {error.strerror or error}")
        return 1


def _run(argv: Sequence[str] | None) -> int:
    words = sys.argv[1:] if argv is None else list(argv)
    named = [word for word in words if not word.startswith("-")][:1]
    if not COMMANDS.keys() & named:
        make_parser(()).parse_args(words)  # prints help, the version or an error, and ends
    with leaving_at_once(), uncollected():
        args = make_parser(tuple(named)).parse_args(words)
        args.command_line = shlex.join(["warp-corot", *words])
        import warp as wp

        from warp_corot.inputs.processes import start_warp

        wp.config.log_level = wp.LOG_ERROR  # so that it prints no banner
        # The command differentiates nothing, and Newton's kernels compile in a third of the time without adjoints.
        wp.config.enable_backward = False

        logging.basicConfig(format="warp-corot: warning: %(message)s", level=logging.WARNING)
        try:
            start_warp()
        except OSError as error:
            complain(
                f"Warp's kernel cache {error.filename or ''}: {error.strerror or error}; name a folder that can be "
                "written to in the environment variable WARP_CACHE_PATH"
            )
            return 1
        if args.command in ("simulate", "view"):
            from .terminal import begin_compiling

            begin_compiling(args.device)
        module = subcommand(args.command)
    WATCH.switch("preparing")
    return module.run(args)
