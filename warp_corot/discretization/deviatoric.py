"""A discretization whose elements do not resist changes of volume: a law's forces without the terms in lambda."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import warp as wp

if TYPE_CHECKING:
    from .discretization import Discretization
    from .plan import FlatLeaves


def deviatoric(whole: Discretization) -> Discretization:
    """A discretization with zero in place of lambda; all other data are those of ``whole`` and follow its changes."""
    return cast("Discretization", _Deviatoric(whole))


class _Deviatoric:
    def __init__(self, whole: Discretization):
        self._whole, self._zeros = whole, dict[str, tuple[wp.array, wp.array]]()

    def __getattr__(self, name: str) -> Any:
        return getattr(self.__dict__["_whole"], name)

    @property
    def discretization(self) -> _Deviatoric:
        return self

    @property
    def lam(self) -> wp.array:
        return self._none_of("all", self._whole.lam)

    def lame_of_flat(self, flat: FlatLeaves) -> tuple[wp.array, wp.array] | None:
        given = self._whole.lame_of_flat(flat)
        return None if given is None else (given[0], self._none_of("flat", given[1]))

    def _none_of(self, which: str, lam: wp.array) -> wp.array:
        known = self._zeros.get(which)
        if known is None or known[0] is not lam:
            known = self._zeros[which] = (lam, wp.zeros_like(lam))
        return known[1]
