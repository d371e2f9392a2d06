"""The options of ``warp-corot paper``."""

from __future__ import annotations

import argparse
from pathlib import Path

from warp_corot.cli.parsing import COMMANDS
from warp_corot.inputs.choices import FULL_DURATION, SHORT_DURATION


def add_parser(subparsers: argparse._SubParsersAction) -> argparse.ArgumentParser:
    """Add the command to ``warp-corot``."""
    parser = subparsers.add_parser(
        "paper",
        help=COMMANDS["paper"],
        description="""\
Simulates the beam of Tagawa, Yamada and Tanaka (IEEE EMBC 2013) under its own
weight with linear, corotated (rotations at every level of the tree),
St. Venant-Kirchhoff and neo-Hookean elements; compares the displacement of its
free end, its volume and the computation time; tests the paper's claims.
Prints a table and writes results.json and the counterparts of figures 5 to 8 as PNG.""",
        epilog="""\
Absolute times are given for CUDA devices only; a CPU's are relative to linear
FEM in the same run. Nothing is written before all models have run.""",
    )
    parser.add_argument("-o", "--output", required=True, type=Path, metavar="DIR", help="folder; made if necessary")
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--full", action="store_true", help=f"the paper's {FULL_DURATION:g} s (minutes on a CPU)")
    length.add_argument(
        "--duration",
        type=float,
        default=SHORT_DURATION,
        metavar="S",
        help=f"simulated time [s] (default: {SHORT_DURATION:g}, in which the beam comes to rest)",
    )
    parser.add_argument(
        "--level", type=int, default=6, metavar="L", help="bisections of the mesh (default: the paper's 6)"
    )
    parser.add_argument("--dt", type=float, default=2e-4, metavar="S", help="time step [s] (default: 0.0002)")
    parser.add_argument("--device", help='"cpu", "cuda:0", ... (default: Warp\'s choice)')
    return parser
