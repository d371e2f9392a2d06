"""The options of ``warp-corot sweep``."""

from __future__ import annotations

import argparse
from pathlib import Path

from warp_corot.cli.parsing import COMMANDS


def add_parser(subparsers: argparse._SubParsersAction) -> argparse.ArgumentParser:
    """Add the command to ``warp-corot``."""
    parser = subparsers.add_parser(
        "sweep",
        help=COMMANDS["sweep"],
        description="Runs INPUT with every combination of the values of --vary, in several processes. The same command "
        "continues an interrupted sweep.",
        epilog="""examples:
  warp-corot sweep box --vary young=500,1kPa,2kPa -o results
  warp-corot sweep run.toml --vary young=1kPa:100kPa:64:log --vary poisson=0.3,0.45,0.49 -o results

the folder gets table.csv, table.parquet (with pyarrow), results.png, runs.jsonl with the finished runs, and in runs/ a
stage and a table for each run. Results are the last row of each run's table, and the largest displacement.""",
    )
    parser.add_argument("input", metavar="INPUT", help="as for simulate: a run file, a mesh, a surface, a scan or box")
    parser.add_argument(
        "--vary",
        action="append",
        required=True,
        metavar="OPTION=VALUES",
        help="an option of simulate and its values: A,B,C, FIRST:LAST:COUNT or FIRST:LAST:COUNT:log; may be repeated",
    )
    parser.add_argument("--probe", action="append", metavar="WHERE", help="as for simulate: its motion is a result")
    parser.add_argument("--duration", metavar="T", help="as for simulate")
    parser.add_argument("-o", "--output", type=Path, metavar="FOLDER", help="folder for the results")
    parser.add_argument("--workers", type=int, metavar="N", help="processes (default: one a card, or one a core)")
    parser.add_argument(
        "--retries", type=int, default=2, metavar="N", help="how often a failed run is repeated (default: 2)"
    )
    parser.add_argument("--device", help="as for simulate")
    return parser
