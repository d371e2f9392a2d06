"""Bodies from surfaces and scans: what becomes of INPUT when it is not made of tetrahedra."""

from __future__ import annotations

import argparse
import re
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import InputError
from ..io.assets import find_asset
from ..io.formats import USD_SUFFIXES
from ..io.surfaces import UP_AXES
from ..io.volumes import READERS
from ..mesh import TetForest
from .label_materials import numbers_by_name, parse_labels
from .subject import Subject

if TYPE_CHECKING:
    from ..domain import Domain

#: Tetrahedra, about, where nothing is said of their size.
TETS = 20_000
#: So many tetrahedra make a root cube of a length's cube worthwhile: most of them go to the surface.
TETS_PER_CUBE = 30
#: How often cubes are bisected at most. Where the surface is most curved elements are a fifth of a cube long; finer
#: ones would bring the rest of the surface little, and make the time step smaller.
MAX_LEVEL = 7
#: From so many on there are too few elements at the surface for that.
MANY_TETS = 300_000
#: The same where a surface error is to be kept.
MAX_LEVEL_FOR_ERROR = 12
#: Root cubes reach beyond the body by this share of its length.
MARGIN = 1.0e-3
#: Options that only such bodies take.
OPTIONS = (
    "unit",
    "cell_size",
    "max_level",
    "surface_error",
    "tets",
    "labels",
    "smoothing",
    "draw_tets",
    "draw_labels",
)
#: What Python's arguments are called on the command line.
ARGUMENTS = {
    "unit": "--unit",
    "cell_size": "--cell-size",
    "max_level": "--max-level",
    "surface_error": "--surface-error",
    "target_elements": "--tets",
    "smoothing": "--smoothing",
}
FOR_SCANS = ("labels", "smoothing", "draw_labels")


def kind_of(name: str) -> str:
    """What INPUT is: "surface", "scan" or "tets".

    Raises:
        InputError: A USD file that cannot be opened, or no such asset.
    """
    asset = find_asset(name)
    if asset:
        return "surface" if asset.is_surface else "tets"
    path = Path(name)
    if any(path.name.lower().endswith(suffix) for suffix in READERS):
        return "scan"
    if path.suffix.lower() in UP_AXES:
        return "surface"
    if path.suffix.lower() in USD_SUFFIXES and path.is_file() and path.stat().st_size:
        from ..io.usd_look import has_mesh

        return "surface" if has_mesh(path) else "tets"
    return "tets"


def refuse_options(args: argparse.Namespace, kind: str) -> None:
    """See that no option is given that would be of no effect.

    Raises:
        InputError: One is; the message names it.
    """
    organ = kind != "tets"
    foreign = [] if kind == "scan" else list(FOR_SCANS if organ else OPTIONS)
    for name in foreign:
        if getattr(args, name) not in (None, False):
            wanted = "scans" if name in FOR_SCANS else "surfaces and scans"
            other = "; say --scale" if name == "unit" else ""
            raise InputError(f"--{name.replace('_', '-')} is for {wanted}, and {args.input} is not one{other}")
    if organ and args.scale is not None:
        raise InputError(f"--scale is for meshes of tetrahedra; of {args.input} say --unit mm, cm or m")
    if args.labels is not None and args.young is not None:
        raise InputError("--young is given, but --labels gives each label its own")
    if args.draw_labels and args.labels is None:
        raise InputError("--draw-labels draws the labels that --labels names")


def find_organ(args: argparse.Namespace, kind: str) -> Subject:
    """The body that a surface or a scan encloses, meshed.

    Args:
        args: Of the command.
        kind: "surface" or "scan".

    Raises:
        InputError: It encloses none, or an option is out of its range.
    """
    with _as_options():
        started = time.perf_counter()
        entries = parse_labels(args.labels) if args.labels is not None else []
        notes: list[str] = []
        domain = _scan(args, entries, notes) if kind == "scan" else _surface(args)
        meshing = time.perf_counter()
        mesh = _mesh(args, domain)
        surface = mesh.surface()
        done = time.perf_counter()
    asset = find_asset(args.input)
    source = asset.path if asset else Path(args.input)
    subject = Subject(
        mesh,
        asset.name if asset else _title(source),
        source,
        domain=domain,
        surface=surface,
        labels=entries,
        times={"domain": meshing - started, "mesh": done - meshing},
        notes=notes,
    )
    if asset:
        subject.young, subject.poisson, subject.density = asset.young, asset.poisson, asset.density
        subject.fix, subject.damping, subject.duration = asset.fix, asset.damping, asset.duration
    return subject


def _surface(args: argparse.Namespace) -> Domain:
    from ..domain import Domain

    return Domain.from_surface(args.input, unit=args.unit, device=args.device)


def _scan(args: argparse.Namespace, entries: list, notes: list[str]) -> Domain:
    from ..domain import Domain

    numbers: dict[str, Any] | None = None
    if entries:
        numbers, said = numbers_by_name(entries, Path(args.input))
        notes += [said] if said else []
    smoothing = args.smoothing or 0.0
    return Domain.from_labels(args.input, labels=numbers, unit=args.unit, smoothing=smoothing, device=args.device)


def _mesh(args: argparse.Namespace, domain: Domain) -> TetForest:
    count = args.tets
    if count is None and args.max_level is None and args.surface_error is None:
        count = TETS
    size = args.cell_size
    if size is None:
        cubes = max(1, round((max(count or TETS, 1) / TETS_PER_CUBE) ** (1.0 / 3.0)))
        size = float(np.ptp(domain.bounds, axis=0).max()) * (1.0 + MARGIN) / cubes
    level = args.max_level
    if level is None:
        level = MAX_LEVEL_FOR_ERROR if args.surface_error is not None else MAX_LEVEL + (count > MANY_TETS)

    try:
        return TetForest.from_domain(
            domain, size, max_level=level, surface_error=args.surface_error, target_elements=count, device=args.device
        )
    except InputError as error:
        unsaid = count is not None and count >= 1 and args.surface_error is None and "target_elements" not in str(error)
        with_tets = f"with --tets {count}, " if unsaid else ""
        raise InputError(f"{with_tets}{error}") from None


def _title(source: Path) -> str:
    name = source.name
    suffix = next((s for s in READERS if name.lower().endswith(s)), source.suffix)
    return name[: len(name) - len(suffix)].encode(errors="replace").decode()


@contextmanager
def _as_options() -> Iterator[None]:
    """Complaints name options in place of Python's arguments."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            yield
        except InputError as error:
            raise InputError(_with_options(str(error))) from None
    for warning in said:
        warnings.warn(_with_options(str(warning.message)), warning.category, stacklevel=3)


def _with_options(text: str) -> str:
    for name, option in ARGUMENTS.items():
        text = re.sub(rf"(?<![-\w]){name}(?= is )", option, text)
        text = re.sub(rf"(?<![-\w]){name}=", f"{option} ", text)
    return text
