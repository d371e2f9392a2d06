"""Steps on CUDA in which contact sleeps, because nothing is near; see ``kernels.contact.sleep``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from warp_corot.kernels.contact import sleep as kernels

if TYPE_CHECKING:
    from collections.abc import Callable

    from warp_corot.solvers.system import System

    from .obstacles import Obstacles
    from .search import Search
    from .surface import ContactSurface


class Sleep:
    """What steps of awake and of sleeping contact launch.

    Args:
        system: The bodies.
        surface: Their surfaces.
        obstacles: The obstacles.
        search: The search for nearby surfaces.
    """

    def __init__(self, system: System, surface: ContactSurface, obstacles: Obstacles, search: Search):
        self._system, self._surface, self._obstacles = system, surface, obstacles
        self._watch, self._device = search.watch, search.device

    @property
    def is_framed(self) -> bool:
        """Whether margins count motion relative to frames; see ``Search.launch``."""
        return not self._obstacles.count

    def launch(self, offset: int, act: Callable[[], None]) -> None:
        """Launch the motion of obstacles, and what contact does in a step while it is awake.

        Args:
            offset: The number of steps since the clock was last advanced.
            act: Launches that.
        """
        obstacles = self._obstacles
        obstacles.launch_targets()
        for k, body in enumerate(self._system.bodies):
            start, count, nodes = self._surface.nodes_of(k)
            moved = self._system.worlds * obstacles.count if k == 0 else 0
            threads = max(count, moved)
            inputs = [threads, start, count, nodes, int(self.is_framed), moved, obstacles.motions]
            inputs += [body.conditions.world_starts, self._system.pace.arrays, offset]
            inputs += [*self._places(k), body.state.velocities]
            wp.launch(kernels.rouse, threads, inputs, [self._watch], device=self._device)
        # A branch takes longer than launches that end at once.
        act()

    def launch_check(self) -> None:
        """Launch the test after a run whether anything moved too far in its last step."""
        for k in range(len(self._system.bodies)):
            start, count, nodes = self._surface.nodes_of(k)
            inputs = [start, nodes, int(self.is_framed), self._system.pace.arrays, *self._places(k)]
            wp.launch(kernels.check_sleep, count, inputs, [self._watch], device=self._device)

    def _places(self, k: int) -> list[wp.array]:
        """Rest positions and displacements of a body."""
        state = self._system.bodies[k].state
        return [state.rest, state.displacements]
