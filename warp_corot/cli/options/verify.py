"""The options of ``warp-corot verify``."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

DESCRIPTION = """\
Runs cases with known answers on this machine: elastic laws, contact, friction
and impacts. Prints a table: each result, its reference, how far they are apart,
how far they may be, and where the reference comes from."""
EPILOG = """\
exit status: 0 if all rows pass, 4 if a row does not, else as of simulate."""


@dataclass(kw_only=True)
class VerifyOptions:
    """All options.

    Attributes:
        cases (CASE): names of cases (default: all)
        list_cases: list the cases, and run none
        full: finer meshes and longer times: minutes on a CPU core, where the quick form takes half a minute
        json (FILE): also write the rows as JSON
        device: "cpu", "cuda:0", ... (default: Warp's choice)
    """

    cases: list[str] | None = field(default=None, metadata={"flags": ("cases",), "action": "store", "nargs": "*"})
    list_cases: bool = field(default=False, metadata={"flags": ("--list",)})
    full: bool = False
    json: Path | None = None
    device: str | None = None


OPTIONS = VerifyOptions
