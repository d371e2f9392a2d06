"""Bodies from surfaces and scans: what becomes of INPUT when it is not made of tetrahedra."""

from __future__ import annotations

import argparse
import re
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import InputError
from ..io.assets import ASSETS
from ..io.formats import USD_SUFFIXES
from ..io.surfaces import SURFACE_ASSETS, UP_AXES, find_surface_asset
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
#: What share of the number of tetrahedra asked for is aimed at, which is enough, and after how many meshes any is.
NEAR, NEAR_ENOUGH = 0.95, 0.8
MOST_MESHES = 8

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
        InputError: A USD file that cannot be opened.
    """
    prefix, colon, rest = name.partition(":")
    if prefix == "warp" and colon:
        if rest not in ASSETS:
            find_surface_asset(name)  # complains of one that is not there
        return "surface" if rest in SURFACE_ASSETS else "tets"
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
    asset = find_surface_asset(args.input)
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

    def meshed(error: float | None, target: int | None = None) -> TetForest:
        return TetForest.from_domain(
            domain, size, max_level=level, surface_error=error, target_elements=target, device=args.device
        )

    if count is None:
        return meshed(args.surface_error)
    if args.surface_error is not None or count < 1:
        return meshed(args.surface_error, count)
    try:
        found = _of_size(meshed, count, size)
    except InputError:  # so coarse that nothing is seen of the body, or an option out of its range
        found = None
    try:
        return found or meshed(None, count)
    except InputError as error:
        raise InputError(f"with --tets {count}, {error}") from None


def _of_size(meshed: Callable[[float], TetForest], count: int, size: float) -> TetForest | None:
    """The mesh whose surface is off by no more than need be for so many tetrahedra, None if all have more.

    Begins with few, for which a mesh takes no time, and goes on by the secant of the logarithms: the number goes about
    inversely with the surface error, and less where the levels end.
    """
    best: TetForest | None = None
    tried: list[tuple[float, float]] = []  # logarithms of the error and of the number over the one asked for
    low, high = -np.inf, np.log(0.5 * size)
    slope, error = -1.0, high
    for _ in range(MOST_MESHES):
        mesh = meshed(float(np.exp(error)))
        found = len(mesh.tets)
        if found <= count:
            high = error
            best = mesh if best is None or found > len(best.tets) else best
            if found >= NEAR_ENOUGH * count:
                break
        else:
            low = error
        if best is None:
            return None
        tried.append((error, float(np.log(found / (NEAR * count)))))
        if len(tried) > 1:
            (e0, n0), (e1, n1) = tried[-2:]
            if e1 < e0 and abs(n1 - n0) < 0.01:  # all of the surface is at the last level
                break
            slope = float(np.clip((n1 - n0) / (e1 - e0), -2.0, -0.25))
        error = error - tried[-1][1] / slope
        if not low < error < high:
            error = 0.5 * (low + high) if np.isfinite(low) else high - 1.0
    return best


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
