"""``warp-corot warm-up``: the kernels of frequent runs, compiled before they are needed."""

from __future__ import annotations

import argparse
import io
import sys
import time
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from tempfile import TemporaryDirectory

from warp_corot.inputs.checks import checked_device

from . import make_parser, simulate
from .options import CHOICES

EXPLICIT, IMPLICIT = (["--integrator", name] for name in ("symplectic-euler", "backward-euler"))
#: Options of runs, by what they are called.
RUNS = {
    "an organ, explicit steps": ["warp:bunny", *EXPLICIT],
    "an organ, implicit steps": ["warp:bunny", *IMPLICIT],
    "compressible tissue": ["warp:bunny", "--poisson", "0.4", *IMPLICIT],
    "an organ on a ground, explicit steps": ["warp:bunny", "--ground", *EXPLICIT],
    "an organ on a ground, implicit steps": ["warp:bunny", "--ground", *IMPLICIT],
    "tetrahedra from a file": ["warp:bear", *EXPLICIT],
    "a box": ["box", *EXPLICIT],
}
#: The same for ``--all``.
MORE = {
    **{f"the model {name}": ["box", "--model", name, *EXPLICIT] for name in CHOICES},
    "remeshing": ["box", "--remesh", *EXPLICIT],
    "a state of rest": ["box", "--static"],
    "a body that touches itself": ["warp:bunny", "--tets", "3000", "--ground", "--self-contact", *EXPLICIT],
}


def run(args: argparse.Namespace) -> int:
    """Run the command; returns the exit status: that of the first run that failed, with what it said."""
    checked_device(args.device)
    runs = RUNS | (MORE if args.all else {})
    device = [] if args.device is None else ["--device", args.device]
    with TemporaryDirectory() as folder:
        for number, (name, options) in enumerate(runs.items(), 1):
            print(f"{number} of {len(runs)}: {name} ...", end=" ", flush=True)
            words = ["simulate", *options, *device, "--duration", "0.05", "-o", str(Path(folder) / f"{number}.usd")]
            asked = make_parser(("simulate",)).parse_args(words)
            asked.command_line, started, said = "", time.perf_counter(), io.StringIO()
            with redirect_stdout(io.StringIO()), redirect_stderr(said):
                status = simulate.run(asked)
            print(f"{time.perf_counter() - started:.1f} s", flush=True)
            if status:
                sys.stderr.write(said.getvalue())
                return status
    return 0
