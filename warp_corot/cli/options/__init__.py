"""The options of ``warp-corot``, a file for each subcommand. They import neither Warp nor NumPy: help is quick."""

from __future__ import annotations

import argparse
from dataclasses import fields
from importlib import import_module
from typing import Any

from warp_corot.cli.parsing import COMMANDS

from .declared import add_declared


def add_command(subparsers: Any, name: str) -> argparse.ArgumentParser:
    """Add a subcommand to a parser: what its module says, and its options.

    Options that the command lacks and run files may name have their defaults.
    """
    module = import_module(f".{name.replace('-', '_')}", __name__)
    parser: argparse.ArgumentParser = subparsers.add_parser(
        name, help=COMMANDS[name], description=module.DESCRIPTION, epilog=getattr(module, "EPILOG", None)
    )
    add_declared(parser, module.OPTIONS)
    there = {each.name for each in fields(module.OPTIONS)}
    more = fields(module.FILES) if hasattr(module, "FILES") else ()
    parser.set_defaults(**{each.name: each.default for each in more if each.name not in there})
    return parser
