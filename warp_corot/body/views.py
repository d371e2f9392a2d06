"""Views of nodal arrays, which hold as long as the mesh stays the same and say so afterwards."""

from __future__ import annotations

import weakref
from typing import Any

import warp as wp

from warp_corot.errors import StaleViewError


class Views:
    """The views that have been handed out since the mesh last changed."""

    def __init__(self) -> None:
        self._arrays: weakref.WeakSet[wp.array] = weakref.WeakSet()

    def hand_out(self, view: wp.array) -> wp.array:
        """The same view; ``expire`` will find it."""
        self._arrays.add(view)
        return view

    def expire(self) -> None:
        """From now on, whatever is done with these views is an error."""
        for view in tuple(self._arrays):
            view.__class__ = _StaleView
        self._arrays.clear()


class _StaleView(wp.array):
    """What a view becomes when its nodes are no longer the body's."""

    _PLAIN = frozenset({"__class__", "__dict__", "__del__", "__init__", "__repr__", "__str__", "__hash__", "_PLAIN"})

    def __getattribute__(self, name: str) -> Any:
        if name in _StaleView._PLAIN:
            return object.__getattribute__(self, name)
        raise StaleViewError("the body's mesh has changed since this view was made; get it from the body again")

    def __getitem__(self, key: Any) -> Any:
        return self.shape[key]

    def __setitem__(self, key: Any, value: Any) -> None:
        self.shape[key] = value

    def __len__(self) -> int:
        return len(self.shape)

    def __repr__(self) -> str:
        return "<a view of a body's mesh as it was>"

    __str__ = __repr__

    def __del__(self) -> None:
        """A view owns no memory."""
