"""Trees of plain values and arrays: JSON, and the arrays beside it."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

Arrays = dict[str, np.ndarray]
#: The only key of what stands for an array in JSON; its value is the array's name.
ARRAY = "array"


def split(tree: Any, name: str = "") -> tuple[Any, Arrays]:
    """A tree of dictionaries, lists and tuples without its arrays, and the arrays [any shape], named by the keys and
    numbers on the way to them, with dots; arrays of Warp are read.
    """
    if isinstance(tree, wp.array):
        tree = tree.numpy()
    if isinstance(tree, np.ndarray):
        return {ARRAY: name}, {name: tree}
    if not isinstance(tree, dict | list | tuple):
        return tree, {}
    arrays: Arrays = {}
    plain: list[tuple[Any, Any]] = []
    for key, value in tree.items() if isinstance(tree, dict) else enumerate(tree):
        own, found = split(value, f"{name}.{key}" if name else str(key))
        plain.append((key, own))
        arrays |= found
    return dict(plain) if isinstance(tree, dict) else [own for _, own in plain], arrays


def joined(plain: Any, arrays: Arrays) -> Any:
    """The tree that ``split`` has split, with lists for tuples.

    Raises:
        KeyError: An array is missing.
    """
    if isinstance(plain, dict):
        if plain.keys() == {ARRAY}:
            return arrays[plain[ARRAY]]
        return {key: joined(value, arrays) for key, value in plain.items()}
    return [joined(value, arrays) for value in plain] if isinstance(plain, list) else plain
