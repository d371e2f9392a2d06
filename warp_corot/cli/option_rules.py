"""One rule for options: an option without effect on this input is refused, with the reason."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import NamedTuple

from warp_corot.errors import InputError

from .input_file import InputFile


class Rule(NamedTuple):
    """A rule for when options have an effect.

    Attributes:
        options: Their names in Python.
        applies: Whether they have an effect, given the command's arguments and the input.
        purpose: Their purpose, to follow "--NAME is for".
    """

    options: tuple[str, ...]
    applies: Callable[[argparse.Namespace, InputFile], bool]
    purpose: str


RULES = (
    Rule(
        ("skin",),
        lambda args, opened: opened.kind == "surface" or (opened.kind == "scan" and args.skin == "marched"),
        "surfaces",
    ),
    Rule(("level",), lambda _, opened: opened.kind != "tets", "the box, surfaces and scans"),
    Rule(("unit", "up"), lambda _, opened: opened.kind != "box", "files"),
    Rule(("rotation_level",), lambda _, opened: opened.kind != "tets", "box, surfaces and scans"),
    Rule(
        ("join",),
        lambda args, opened: opened.kind == "tets" or len(getattr(opened.loaded, "objects", ())) > 1,
        "surfaces of several objects and meshes of tetrahedra",
    ),
    Rule(("labels", "smoothing"), lambda _, opened: opened.kind == "scan", "scans"),
    Rule(
        ("threshold",),
        lambda args, opened: opened.kind == "scan" and args.labels is None and args.materials is None,
        "scans without --labels and --materials",
    ),
    Rule(
        ("cell_size", "max_level", "surface_error", "tets", "min_layers", "draw_tets"),
        lambda _, opened: opened.kind in ("surface", "scan"),
        "surfaces and scans",
    ),
    Rule(
        ("materials",),
        lambda args, opened: (opened.kind == "scan" and args.labels is None) or opened.has_regions,
        "scans without --labels and meshes of tetrahedra whose file numbers regions",
    ),
    Rule(
        ("regions_by",),
        lambda args, opened: args.materials is not None and opened.has_regions,
        "--materials on meshes of tetrahedra whose file numbers regions",
    ),
    Rule(
        ("draw_labels",),
        lambda args, opened: opened.has_regions or opened.kind == "scan",
        "scans and meshes of tetrahedra whose file numbers regions",
    ),
)


def refuse_options(args: argparse.Namespace, opened: InputFile) -> None:
    """Check that every given option has an effect.

    Raises:
        InputError: An option has none; the message names it and its purpose.
    """
    for rule in RULES:
        for name in rule.options:
            given = getattr(args, name, None)
            if given is not None and given is not False and not rule.applies(args, opened):
                option = f"--{name.replace('_', '-')}"
                instead = "; use --scale" if name == "unit" else ""
                raise InputError(f"{option} is for {rule.purpose}, and {args.input} is not one{instead}")
    if opened.kind != "box" and args.level is not None and (args.tets is not None or args.max_level is not None):
        raise InputError("--level is given, with which neither --tets nor --max-level has an effect")
    if args.labels is not None and args.young is not None:
        raise InputError("--young is given, but --labels gives each label its own")
    if args.draw_labels and args.labels is None and args.materials is None:
        raise InputError("--draw-labels draws the labels that --labels or --materials names")
