"""The contact of all bodies as the modules see it that are parts of it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol

import warp as wp

if TYPE_CHECKING:
    from warp_corot.inputs.cpu_threads import Regions
    from warp_corot.kernels.contact.approach import Part
    from warp_corot.kernels.contact.explicit_rows import Rigid
    from warp_corot.kernels.contact.law import Law
    from warp_corot.solvers.system import System

    from .obstacles import Obstacles, RigidForces
    from .search import Pairs, Search
    from .surface import ContactSurface


class AllContacts(Protocol):
    """``contacts.Contacts``, which explains the members."""

    system: System
    device: wp.Device
    obstacles: Obstacles
    surface: ContactSurface
    shared: Any
    law: Law
    search: Search
    pairs: Pairs | None
    rigid: RigidForces | None
    regions: Regions
    split: Any

    @property
    def rigid_arrays(self) -> Rigid: ...

    def part(self, k: int, offset: int = 0, damping: float = 0.0) -> Part: ...

    def take_rooms(self, rooms: Sequence[Sequence[int]], room: int) -> None: ...
