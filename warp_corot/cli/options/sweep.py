"""The options of ``warp-corot sweep``."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

DESCRIPTION = """Runs INPUT with every combination of the values of --vary, in several processes. The same command \
continues an interrupted sweep."""
EPILOG = """examples:
  warp-corot sweep box --vary young=500,1kPa,2kPa -o results
  warp-corot sweep run.toml --vary young=1kPa:100kPa:64:log --vary poisson=0.3,0.45,0.49 -o results

the folder gets table.csv, runs.jsonl with the finished runs, and in runs/ a stage and a table for each run. Results are
the last row of each run's table, and the largest displacement."""


@dataclass(kw_only=True)
class SweepOptions:
    """All options.

    Attributes:
        input (INPUT): as for simulate: a run file, a mesh, a surface, a scan or box
        vary (OPTION=VALUES): an option of simulate and its values: A,B,C, FIRST:LAST:COUNT or FIRST:LAST:COUNT:log; may
            be repeated
        probe (WHERE): as for simulate: its motion is a result
        duration (T): as for simulate
        output (FOLDER): folder for the results
        workers (N): processes (default: one a card, or one a core)
        retries (N): how often a failed run is repeated (default: 2)
        device: as for simulate
    """

    input: str = field(metadata={"flags": ("input",)})
    vary: list[str]
    probe: list[str] | None = None
    duration: str | None = None
    output: Path | None = field(default=None, metadata={"flags": ("-o", "--output")})
    workers: int | None = None
    retries: int = 2
    device: str | None = None


OPTIONS = SweepOptions
