"""The options of ``warp-corot warm-up``."""

from __future__ import annotations

import argparse

from warp_corot.cli.parsing import COMMANDS


def add_parser(subparsers: argparse._SubParsersAction) -> argparse.ArgumentParser:
    """Add the command to ``warp-corot``."""
    parser = subparsers.add_parser(
        "warm-up",
        help=COMMANDS["warm-up"],
        description="""\
Makes short runs of the kinds that simulate and view make most, so that the
kernels of these are in Warp's cache when you need them. Nothing is written
elsewhere. Where they already are, the runs take seconds.""",
    )
    parser.add_argument("--device", help='"cpu", "cuda:0", ... (default: Warp\'s choice)')
    parser.add_argument(
        "--all", action="store_true", help="also all elastic models, remeshing, states of rest and own surfaces"
    )
    return parser
