"""The paper's experiment: the beam of Tagawa, Yamada and Tanaka (IEEE EMBC 2013) sags under its weight with linear,
corotated (rotations at every level of the tree), St. Venant-Kirchhoff and neo-Hookean elements.

Compares the displacement of the free end, the volume and the computation time, and tests the paper's claims. Prints a
table and writes results.json and the counterparts of figures 5 to 8 as PNG, after all models have run. Absolute times
are given for CUDA devices only; a CPU's are relative to linear FEM in the same run:

    python benchmarks/paper.py -o paper --full
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import paper_figures
import warp as wp
from measure import Parser, tell
from paper_beam import FULL_DURATION, SHORT_DURATION, Settings, run_experiment
from paper_report import table, to_json

from warp_corot.cli.verify import write_json
from warp_corot.errors import InputError, UnstableError
from warp_corot.simulation.progress import hidden

RESULTS = "results.json"


def options_of(words: list[str] | None = None) -> argparse.Namespace:
    of = Parser(prog="paper.py", description="The paper's experiment.")
    of.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder; made if necessary")
    long = of.add_mutually_exclusive_group()
    long.add_argument("--full", action="store_true", help=f"the paper's {FULL_DURATION:g} s (minutes on a CPU)")
    long.add_argument("--duration", type=float, default=SHORT_DURATION, help="[s] (default: the beam comes to rest)")
    of.add_argument("--level", type=int, default=6, help="bisections of the mesh (default: the paper's 6)")
    of.add_argument("--dt", type=float, default=2e-4, help="time step [s] (default: 0.0002)")
    of.add_argument("--device", help="cpu, cuda:0, … (default: Warp's)")
    return of.parse_args(words)


def main(words: list[str] | None = None) -> int:
    options, told = options_of(words), ""

    def said(what: str, _: int) -> None:
        nonlocal told
        if what != told:
            tell(told := what)

    wp.config.log_level = wp.LOG_ERROR
    try:
        duration = FULL_DURATION if options.full else options.duration
        settings = Settings(duration=duration, level=options.level, dt=options.dt)
        paper_figures.check_matplotlib()
        options.output.mkdir(exist_ok=True)
        with hidden():
            results = run_experiment(settings, device=options.device, progress=said)
        print(table(results))
        write_json(options.output / RESULTS, to_json(results))
        files = [options.output / RESULTS, *paper_figures.draw_figures(options.output, results)]
    except (InputError, UnstableError, OSError) as error:
        print(f"paper.py: error: {error}", file=sys.stderr)
        return 3 if isinstance(error, UnstableError) else 2 if isinstance(error, InputError) else 1
    print(f"\nWritten to {options.output}: {', '.join(file.name for file in files)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
