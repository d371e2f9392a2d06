"""The choice of the array that numbers a file's regions, and the names of the regions."""

from __future__ import annotations

from collections.abc import Mapping
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
    blocks = mesh.solids
    known = dict.fromkeys(name for block in blocks for name in block.data)
    if wanted is not None:
        if wanted not in known:
            raise InputError(f"there is no array {wanted!r} of whole numbers; there are: {', '.join(known) or 'none'}")
        return _regions(mesh, wanted, cells)
    numbers = {name: np.unique(_values(mesh, name)[cells]) for name in known}
    name = likeliest(numbers, mesh.names)
    return None if name is None else _regions(mesh, name, cells)


def likeliest(numbers: Mapping[str, NDArray[np.int64]], names: Mapping[str, Mapping[int, str]]) -> str | None:
    """The array that most likely numbers regions; None if none does.

    Args:
        numbers: The distinct numbers in each array.
        names: Names that a file gives to numbers, by array.
    """
    for name in sorted(numbers, key=_likelihood):
        said = names.get(name, {})
        if 1 <= len(_named(numbers[name], said)) <= MOST and (len(numbers[name]) > 1 or said):
            return name
    return None


def _likelihood(name: str) -> tuple[int, str]:
    lower = name.lower()
    places = [place for place, usual in enumerate(USUAL) if usual in lower]
    return (min(places, default=len(USUAL)), lower)


def _named(there: NDArray[np.int64], said: Mapping[int, str]) -> list[int]:
    """The numbers of regions. Zero without a name means none: a cell of no physical group or set."""
    return [int(number) for number in there if number != 0 or number in said]


def _values(mesh: FileMesh, name: str) -> NDArray[np.int64]:
    """The numbers of all cells in an array."""
    return np.concatenate([block.data.get(name, np.zeros(len(block.nodes), np.int64)) for block in mesh.solids])


def _regions(mesh: FileMesh, name: str, cells: NDArray[np.int64]) -> Regions:
    values = _values(mesh, name)
    return numbered(name, values[cells], np.unique(values), mesh.names.get(name, {}))


def numbered(
    name: str, values: NDArray[np.int64], there: NDArray[np.int64], said: Mapping[int, str] | None = None
) -> Regions:
    """The regions of tetrahedra.

    Args:
        name: The array's name.
        values: The number of each tetrahedron [T].
        there: The distinct numbers of all of them, ascending.
        said: Names of numbers.
    """
    said = said or {}
    numbers = _named(there, said)
    names: list[str] = []
    for number in numbers:
        own = said.get(number, str(number))
        names.append(own if own not in names else f"{own} ({number})")
    place = np.zeros(len(there), np.int32)
    for index, number in enumerate(numbers, start=1):
        place[np.searchsorted(there, number)] = index
    return Regions(name, tuple(names), tuple(numbers), place[np.searchsorted(there, values)])
