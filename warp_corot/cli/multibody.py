"""Several bodies of one file: separate, or as one with ``--join``."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from warp_corot.errors import InputError
from warp_corot.io.read.surfaces import LoadedSurface
from warp_corot.io.read.tetrahedra import LoadedMesh

from .input_file import InputFile, longest_side
from .options.defaults import TETS

#: More objects are joined: otherwise each would be a body with its own mesh.
MOST_BODIES = 32
#: Minimum number of tetrahedra of each of several bodies that share a number.
FEWEST_TETS = 100
#: Points of an object that are closer than this fraction of its length are merged.
SAME = 1.0e-6


def bodies_in(opened: InputFile, args: argparse.Namespace) -> list[tuple[InputFile, argparse.Namespace]]:
    """The bodies of an input with their options.

    The objects of a surface's file are separate bodies if each is closed, none is a cavity of another, and
    ``--join`` is not given. They share the number of tetrahedra by volume. Prims, blocks and instances of
    tetrahedra are separate bodies, too.
    """
    if opened.kind == "tets":
        return [(part, args) for part in _of_tets(opened, args.join)]
    surface = opened.surface
    if surface is None or args.join or not 2 <= len(surface.objects) <= MOST_BODIES:
        return [(opened, args)]
    from warp_corot.domain.closing import close_surface

    parts = _parts(surface)
    try:
        whole, *closed = (close_surface(part.points, part.triangles) for part in (surface, *parts))
    except InputError:
        return [(opened, args)]
    if whole.cavities or any(part.caps for part in closed):
        return [(opened, args)]
    volumes = np.array([part.volume for part in closed])
    opened.notes.append(_told(parts))
    found = []
    for place, (part, share) in enumerate(zip(parts, volumes / volumes.sum(), strict=True)):
        own = argparse.Namespace(**vars(args))
        fineness = (args.level, args.max_level, args.surface_error, args.cell_size)
        if args.tets is not None or all(given is None for given in fineness):
            own.tets = max(FEWEST_TETS, int((args.tets or TETS) * share))
        found.append((replace(opened, surface=part, notes=opened.notes if place == 0 else []), own))
    return found


def _of_tets(opened: InputFile, join: bool) -> list[InputFile]:
    """The parts of a file with tetrahedra, which share no nodes."""
    loaded = opened.tets
    assert loaded is not None
    if join or not 2 <= len(loaded.objects) <= MOST_BODIES:
        return [opened]
    ends = np.cumsum([count for _, count in loaded.objects])
    parts = [
        _part(loaded, name, tets)
        for (name, _), tets in zip(loaded.objects, np.split(np.arange(len(loaded.tets)), ends[:-1]), strict=True)
    ]
    opened.notes.append(_told(parts))
    return [replace(opened, tets=part, notes=opened.notes if place == 0 else []) for place, part in enumerate(parts)]


def _part(loaded: LoadedMesh, name: str, chosen: npt.NDArray[np.integer]) -> LoadedMesh:
    """The body with some of the tetrahedra."""
    used, tets = np.unique(loaded.tets[chosen], return_inverse=True)
    sets = {known: np.flatnonzero(np.isin(used, nodes)) for known, nodes in loaded.node_sets.items()}
    regions = loaded.regions
    if regions is not None:
        regions = replace(regions, of_tet=regions.of_tet[chosen])
    return replace(
        loaded,
        points=loaded.points[used],
        tets=tets.reshape(-1, 4).astype(np.int32),
        name=name,
        regions=regions,
        notes=loaded.notes if not chosen[0] else [],
        node_sets={known: nodes for known, nodes in sets.items() if len(nodes)},
        objects=[],
    )


def _told(parts: Sequence[LoadedMesh] | Sequence[LoadedSurface]) -> str:
    names = ", ".join(part.name for part in parts[:8]) + (", ..." if len(parts) > 8 else "")
    return f"{len(parts)} separate bodies: {names} (--join makes them one)"


def merged_nodes(
    points: npt.NDArray[np.float64], tets: npt.NDArray[np.int32]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int32], npt.NDArray[np.int64]]:
    """Tetrahedra with coincident nodes merged, and the new node of each point."""
    kept, place = _welded(points)
    return points[kept], place[tets].astype(np.int32), place


def _welded(points: npt.NDArray[np.float64]) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """The first point at each position, and the position of each point among them."""
    step = SAME * longest_side(points) or 1.0
    _, kept, place = np.unique(np.round(points / step), axis=0, return_index=True, return_inverse=True)
    return kept, place.reshape(-1)


def _parts(surface: LoadedSurface) -> list[LoadedSurface]:
    ends = np.cumsum([count for _, count in surface.objects])
    parts = []
    for (name, _), triangles in zip(surface.objects, np.split(surface.triangles, ends[:-1]), strict=True):
        used, renumbered = np.unique(triangles, return_inverse=True)
        points, own = surface.points[used], renumbered.reshape(-1, 3).astype(np.int32)
        parts.append(replace(surface, points=points, triangles=own, name=name, objects=[]))
    return [part for part in parts if len(part.triangles)]
