"""The options of ``warp-corot paper``."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from warp_corot.inputs.choices import SHORT_DURATION

DESCRIPTION = """\
Simulates the beam of Tagawa, Yamada and Tanaka (IEEE EMBC 2013) under its own
weight with linear, corotated (rotations at every level of the tree),
St. Venant-Kirchhoff and neo-Hookean elements; compares the displacement of its
free end, its volume and the computation time; tests the paper's claims.
Prints a table and writes results.json and the counterparts of figures 5 to 8 as PNG."""
EPILOG = """\
Absolute times are given for CUDA devices only; a CPU's are relative to linear
FEM in the same run. Nothing is written before all models have run."""


@dataclass(kw_only=True)
class PaperOptions:
    """All options.

    Attributes:
        output (DIR): folder; made if necessary
        full: the paper's {FULL_DURATION:g} s (minutes on a CPU)
        duration (S): simulated time [s] (default: {SHORT_DURATION:g}, in which the beam comes to rest)
        level (L): bisections of the mesh (default: the paper's 6)
        dt (S): time step [s] (default: 0.0002)
        device: "cpu", "cuda:0", ... (default: Warp's choice)
    """

    output: Path = field(metadata={"flags": ("-o", "--output")})
    full: bool = field(default=False, metadata={"exclusive": True})
    duration: float = field(default=SHORT_DURATION, metadata={"exclusive": True})
    level: int = 6
    dt: float = 2e-4
    device: str | None = None


OPTIONS = PaperOptions
