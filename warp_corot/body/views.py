"""Views of nodal arrays, which are valid while the mesh stays the same and raise an error afterwards."""

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
        """Return the same view, registered for ``expire``."""
        self._arrays.add(view)
        return view

    def expire(self) -> None:
        """Make every use of these views an error from now on."""
        for view in tuple(self._arrays):
            view.__class__ = _StaleView
        self._arrays.clear()


class _StaleView(wp.array):
    """A view whose nodes the body no longer has."""

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
        return "<a view of a former mesh of a body>"

    __str__ = __repr__

    def __del__(self) -> None:
        """Do nothing: a view owns no memory."""
