"""Two copies of a simulation's state on the device: the last good one, and room for the next."""

from __future__ import annotations

import warp as wp

from warp_corot.kernels.distributed.exchange import forget_length
from warp_corot.kernels.stepping import balance as kernels
from warp_corot.kernels.stepping import pace as clock
from warp_corot.solvers.system import System


class Copies:
    """Displacements, velocities and the state of fields and constraints, twice.

    Args:
        system: The simulation's system; the orders of its clock name the last good copy.

    Attributes:
        slot: Which copy is the last good one.
        changed: Whether the state at the beginning of a run differed from that copy, int32 [1].
        revision: Changes whenever the arrays are replaced.
    """

    def __init__(self, system: System):
        self._bodies, self._fields, self._pace, self.device = system.bodies, system.fields, system.pace, system.device
        self._system = system
        self.slot, self.revision = 0, 0
        self.changed = wp.zeros(1, dtype=wp.int32, device=self.device)
        self.u: list[wp.array] = []
        self.v: list[wp.array] = []
        self._inverse_mass: list[wp.array] = []
        self._words: list[wp.array] = []
        self._kept_words: list[wp.array] = []
        self._places: list[tuple[int, int]] = []

    def prepare(self) -> None:
        """Make room for the present arrays; not while launches are recorded."""
        arrays = [array for field in self._fields for array in field.state.values()] + self._system.state
        words = [_words(array) for array in arrays]
        places = [(array.ptr, len(array)) for array in words]
        shapes = [(2, len(body.state.displacements)) for body in self._bodies]
        if places == self._places and shapes == [array.shape for array in self.u]:
            return
        self.u = [wp.zeros(shape, dtype=wp.vec4, device=self.device) for shape in shapes]
        self.v = [wp.zeros(shape, dtype=wp.vec4, device=self.device) for shape in shapes]
        self._inverse_mass = [wp.zeros(shape[1], dtype=wp.float32, device=self.device) for shape in shapes]
        self._words, self._places = words, places
        self._kept_words = [wp.zeros((2, len(array)), dtype=wp.uint32, device=self.device) for array in words]
        self.revision += 1

    def take(self) -> None:
        """Make the present state the last good one."""
        self.prepare()
        for body, u, v, mass in zip(self._bodies, self.u, self.v, self._inverse_mass, strict=True):
            wp.copy(u[self.slot], body.state.displacements)
            wp.copy(v[self.slot], body.state.velocities)
            wp.copy(mass, body.conditions.inverse_mass)
        for words, kept in zip(self._words, self._kept_words, strict=True):
            wp.copy(kept[self.slot], words)

    def put_back(self) -> None:
        """Restore the last good state."""
        for body, u, v in zip(self._bodies, self.u, self.v, strict=True):
            wp.copy(body.state.displacements, u[self.slot])
            wp.copy(body.state.velocities, v[self.slot])
        for words, kept in zip(self._words, self._kept_words, strict=True):
            wp.copy(words, kept[self.slot])

    @property
    def good(self) -> list[tuple[wp.array, wp.array]]:
        """Displacements and velocities of the last good state, of each body."""
        return [(u[self.slot], v[self.slot]) for u, v in zip(self.u, self.v, strict=True)]

    @property
    def good_accounts(self) -> list[wp.array]:
        """The accounts of constraints' work in the last good state."""
        places = [place for place, _ in self._places]
        found = []
        for account in self._system.accounts:
            kept = self._kept_words[places.index(account.ptr)][self.slot]
            found.append(wp.array(ptr=kept.ptr, shape=account.shape, dtype=wp.float64, device=self.device))
        return found

    def flip(self) -> None:
        """Make the other copy, which the last run has written, the last good one."""
        self.slot = 1 - self.slot

    def launch_take_over(self) -> None:
        """Launch the beginning of a run: the present state becomes the last good one, and ``changed`` says whether it
        differed. Positions are adopted."""
        for body, u, v, mass in zip(self._bodies, self.u, self.v, self._inverse_mass, strict=True):
            inputs = [body.state.rest, body.state.positions, body.conditions.inverse_mass, self._pace.orders]
            inputs += [body.state.velocities]
            outputs = [body.state.displacements, u, v, mass, self._pace.arrays, self.changed]
            kernel = kernels.TAKE_OVER[body.state.positions.dtype]
            wp.launch(kernel, body.sizes.launch_nodes, inputs, outputs, device=self.device)
        self._launch_words(beside=False)
        if not self._system.ranks.is_alone:
            self._system.ranks.max(self.changed)
            before = self._pace.arrays.seconds[int(clock.BEFORE) : int(clock.BEFORE) + 1]
            wp.launch(forget_length, 1, [self.changed], [before], device=self.device)

    def launch_keep(self) -> None:
        """Launch the copies of the fields' state at the end of a run; nodes are copied as their energies are summed."""
        self._launch_words(beside=True)

    def _launch_words(self, *, beside: bool) -> None:
        for words, kept in zip(self._words, self._kept_words, strict=True):
            inputs = [words, self._pace.orders, int(beside)]
            wp.launch(kernels.keep_words, len(words), inputs, [kept], device=self.device)


def _words(array: wp.array) -> wp.array:
    """The same memory as words of four bytes."""
    count = array.size * wp.types.type_size_in_bytes(array.dtype) // 4
    return wp.array(ptr=array.ptr, shape=count, dtype=wp.uint32, device=array.device)
