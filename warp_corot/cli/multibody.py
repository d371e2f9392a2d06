"""Several bodies of one file: separate, or as one with ``--join``."""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Any

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
    loaded = opened.loaded
    several = isinstance(loaded, LoadedMesh | LoadedSurface) and 2 <= len(loaded.objects) <= MOST_BODIES
    if args.join or not several:
        return [(opened, args)]
    assert isinstance(loaded, LoadedMesh | LoadedSurface)
    parts, shares = _parts(loaded), np.zeros(0)
    if isinstance(loaded, LoadedSurface):
        from warp_corot.domain.closing import close_surface

        try:
            whole, *closed = (close_surface(part.points, part.triangles) for part in (loaded, *parts))
        except InputError:
            return [(opened, args)]
        if whole.cavities or any(part.caps for part in closed):
            return [(opened, args)]
        shares = np.array([part.volume for part in closed])
        shares /= shares.sum()
    names = ", ".join(part.name for part in parts[:8]) + (", ..." if len(parts) > 8 else "")
    opened.notes.append(f"{len(parts)} separate bodies: {names} (--join makes them one)")
    fineness = (args.level, args.max_level, args.surface_error, args.cell_size)
    found = []
    for place, part in enumerate(parts):
        own = argparse.Namespace(**vars(args))
        if len(shares) and (args.tets is not None or all(given is None for given in fineness)):
            own.tets = max(FEWEST_TETS, int((args.tets or TETS) * shares[place]))
        found.append((replace(opened, loaded=part, notes=opened.notes if place == 0 else []), own))
    return found


def _parts(loaded: LoadedMesh | LoadedSurface) -> list[Any]:
    """The objects of a file, which share no nodes."""
    cells = loaded.tets if isinstance(loaded, LoadedMesh) else loaded.triangles
    ends = np.cumsum([count for _, count in loaded.objects])
    parts: list[LoadedMesh | LoadedSurface] = []
    for (name, count), chosen in zip(loaded.objects, np.split(np.arange(len(cells)), ends[:-1]), strict=True):
        if not count:
            continue
        used, renumbered = np.unique(cells[chosen], return_inverse=True)
        own = np.asarray(renumbered.reshape(-1, cells.shape[1]), dtype=np.int32)
        part = replace(loaded, points=loaded.points[used], name=name, objects=[])
        if isinstance(part, LoadedSurface):
            parts.append(replace(part, triangles=own))
            continue
        sets = {known: np.flatnonzero(np.isin(used, nodes)) for known, nodes in part.node_sets.items()}
        regions = part.regions
        parts.append(
            replace(
                part,
                tets=own,
                regions=None if regions is None else replace(regions, of_tet=regions.of_tet[chosen]),
                notes=[] if parts else part.notes,
                node_sets={known: nodes for known, nodes in sets.items() if len(nodes)},
            )
        )
    return parts


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
