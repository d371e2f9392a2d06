"""The options of ``warp-corot warm-up``."""

from __future__ import annotations

from dataclasses import dataclass

DESCRIPTION = """\
Makes short runs of the kinds that simulate and view make most, so that the
kernels of these are in Warp's cache when you need them. Nothing is written
elsewhere. Where they already are, the runs take seconds."""


@dataclass(kw_only=True)
class WarmUpOptions:
    """All options.

    Attributes:
        device: "cpu", "cuda:0", ... (default: Warp's choice)
        all: also all elastic models, remeshing, states of rest and own surfaces
    """

    device: str | None = None
    all: bool = False


OPTIONS = WarmUpOptions
