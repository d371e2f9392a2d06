"""The choice of the array that numbers a file's regions, and the names of the regions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from warp_corot.errors import InputError

from .filemesh import FileMesh

#: Usual names of arrays of region numbers, likeliest first; other arrays qualify if they have few distinct numbers.
USUAL = ("physical group", "material", "element set", "region", "label", "tissue", "attribute", "part", "block")
#: Arrays with more distinct numbers do not number regions.
MOST = 1000


@dataclass(frozen=True)
class Regions:
    """Regions of tetrahedra.

    Attributes:
        array: The file's array of region numbers.
        names: Their names.
        numbers: Their numbers in the file.
        of_tet: Each tetrahedron's region, its index in ``names`` plus one, 0 for none, int32 [T].
    """

    array: str
    names: tuple[str, ...]
    numbers: tuple[int, ...]
    of_tet: NDArray[np.int32]


def find_regions(mesh: FileMesh, cells: NDArray[np.int64], wanted: str | None = None) -> Regions | None:
    """The regions of the tetrahedra of a file.

    Args:
        mesh: The content of the file.
        cells: The cell of each tetrahedron, int64 [T], see `split_solids`.
        wanted: The array to use; None: the likeliest that distinguishes cells or gives them a name.

    Returns:
        The regions; None if no array numbers any.

    Raises:
        InputError: The requested array does not exist; the message lists the arrays.
    """
    known = dict.fromkeys(name for block in mesh.solids for name in block.data)
    if wanted is not None and wanted not in known:
        raise InputError(f"there is no array {wanted!r} of whole numbers; there are: {', '.join(known) or 'none'}")
    for name in sorted(known, key=_likelihood) if wanted is None else [wanted]:
        values = np.concatenate([block.data.get(name, np.zeros(len(block.nodes), np.int64)) for block in mesh.solids])
        there, said = np.unique(values), mesh.names.get(name, {})
        # Zero without a name means none: a cell of no physical group or set.
        numbers = [number for number in there.tolist() if number != 0 or number in said]
        if wanted is None and not (1 <= len(numbers) <= MOST and (len(np.unique(values[cells])) > 1 or said)):
            continue
        names: list[str] = []
        for number in numbers:
            own = said.get(number, str(number))
            names.append(own if own not in names else f"{own} ({number})")
        place = np.zeros(len(there), np.int32)
        place[np.searchsorted(there, numbers)] = np.arange(1, len(numbers) + 1)
        return Regions(name, tuple(names), tuple(numbers), place[np.searchsorted(there, values[cells])])
    return None


def _likelihood(name: str) -> tuple[int, str]:
    lower = name.lower()
    places = [place for place, usual in enumerate(USUAL) if usual in lower]
    return (min(places, default=len(USUAL)), lower)
