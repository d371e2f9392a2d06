"""Energies of a simulation's worlds, the work that was put into them, and two copies of the state on the device."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.kernels.distributed.exchange import forget_length
from warp_corot.kernels.stepping import balance as kernels
from warp_corot.kernels.stepping import pace as clock
from warp_corot.kernels.stepping.pace import Pace

from .implicit.conjugate_gradients import WorldSums
from .pace import Mapped
from .system import NEVER, System

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody
    from warp_corot.elasticity import ForceField


#: The most warps of all worlds.
WARPS = 2048

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Energies:
    """The energies of free nodes at one time, for each world [worlds], and what else the device finds then.

    Attributes:
        kinetic, gravitational: [J]; gravitational about the rest shape.
        exact: The elastic energy plus symplectic Euler's own kinetic energy, of the velocities half a step behind times
            those half a step ahead: a linear body keeps this sum to rounding [J]. Meaningless without elastic energies.
        untimely: The kinetic energy at the time of the displacements minus that in ``exact`` [J].
        loads: Work of loads since the last good state [J].
        supports: Work of all moving supports, and of the world's constraints, since the beginning [J].
        supports_absolute: The sum of its absolute values [J].
        worked, worked_absolute: The part of the constraints in these [J].
        reach: The largest displacement [m].
        has_changed: Whether the state was changed between the run before and the one that ended.
        bad_step: The first step after which something was not finite, or NEVER.
    """

    kinetic: Floats
    gravitational: Floats
    exact: Floats
    untimely: Floats
    loads: Floats
    supports: Floats
    supports_absolute: Floats
    worked: Floats
    worked_absolute: Floats
    reach: Floats
    has_changed: bool
    bad_step: int


class Balance:
    """Adds up energies, world by world, and reports them with the clock.

    Args:
        system: The simulation's system.
        copies: The copies of its state.
    """

    def __init__(self, system: System, copies: Copies):
        self.system, self.bodies, self.fields, self._copies = system, system.bodies, system.fields, copies
        self.worlds, self.device = system.worlds, system.device
        self._ranks, sizes = system.ranks, [body.sizes for body in self.bodies]
        count = max(each.launch_nodes for each in sizes)
        if self._ranks.is_reproducible:
            # Elements are addends, too.
            count = max(count, *(each.launch_elements for each in sizes))
        sizes_of_sums = (self.worlds, max(count // self.worlds, 1), kernels.COLUMNS)
        self._sums = WorldSums(*sizes_of_sums, self.device, self._ranks, most=WARPS)
        self._addends = wp.zeros_like(self._sums.parts) if self._ranks.is_reproducible else None
        self._energies: list[wp.array] = [wp.empty(0, dtype=wp.float64, device=self.device) for _ in self.bodies]
        self._field_states: list[dict[str, wp.array]] = [{} for _ in self.bodies]
        self._mapped = Mapped(self.worlds * kernels.COLUMNS + kernels.NUMBERS, self.device)
        numbers = self.worlds * kernels.COLUMNS
        self._totals = self._mapped.array[:numbers].reshape((self.worlds, kernels.COLUMNS))
        self._numbers = self._mapped.array[numbers:]

    @property
    def is_closed(self) -> bool:
        """Whether only gravity, loads and supports do work; active stress does work, too."""
        return not any(body.discretization.has_activation for body in self.bodies)

    def prepare(self) -> None:
        """Make room for the energies of the present elements; not while launches are recorded."""
        for k, field in enumerate(self.fields):
            if len(self._energies[k]) != field.energy_count:
                self._energies[k] = wp.empty(field.energy_count, dtype=wp.float64, device=self.device)
            kept = self._field_states[k]
            if {name: len(array) for name, array in field.state.items()} != {name: len(a) for name, a in kept.items()}:
                self._field_states[k] = {name: wp.empty_like(array) for name, array in field.state.items()}

    def launch(
        self,
        *,
        whole: bool,
        keeps: bool = False,
        at: Sequence[tuple[wp.array, wp.array]] | None = None,
        seconds: Sequence[float] | None = None,
        accounts: Sequence[wp.array] | None = None,
    ) -> None:
        """Launch sums and their report; may be recorded.

        Args:
            whole: Whether to compute elastic energies, which takes as long as some steps.
            keeps: Whether the same launches keep the state.
            at: Displacements and velocities of each body in place of the present ones.
            seconds: Times of the clock in place of the present ones [3].
            accounts: Accounts of the constraints' work in place of the present ones.
        """
        system, copies = self.system, self._copies
        pace = system.pace.arrays
        if at is None:
            system.complete_work()
        if seconds is not None:
            pace = Pace()
            pace.counts = system.pace.arrays.counts
            pace.seconds = wp.array(np.array(seconds), dtype=wp.float64, device=self.device)
        for k, (body, field) in enumerate(zip(self.bodies, self.fields, strict=True)):
            u, v = (body.state.displacements, body.state.velocities) if at is None else at[k]
            if whole:
                self._add_elastic(k, body, field, u)
            self._add_nodal(k, u, v, pace, keeps)
            if whole:
                body.state.forces.zero_()
        for account in system.accounts if accounts is None else accounts:
            self._add_rows(account, kernels.WORKED)
        if self._addends is not None:
            wp.copy(self._addends, self._sums.parts)
        inputs = [self._sums.arrays, system.pace.orders, system.support_work, system.bad_step, copies.changed]
        inputs += [system.pace.control, system.pace.arrays]
        dim = (self.worlds, kernels.COLUMNS, self._sums.lanes)
        wp.launch(kernels.report, dim, inputs, [self._totals, self._numbers], device=self.device)

    def wait(self) -> Energies:
        """The report; waits for the device once."""
        wp.synchronize_stream(self.device)
        numbers = self._mapped.values[self.worlds * kernels.COLUMNS :]
        total = self._mapped.values[: self.worlds * kernels.COLUMNS].reshape(self.worlds, kernels.COLUMNS).copy()
        self.system.pace.saw(numbers)
        ranks = self._ranks
        reach = ranks.max(total[:, int(kernels.REACH)])
        total = ranks.sum(total, None if self._addends is None else np.moveaxis(self._addends.numpy(), 1, 0))
        kinetic, ahead, gravitational, loads, supports, _, elastic, untimely, worked, worked_absolute = total.T
        return Energies(
            kinetic=kinetic,
            gravitational=gravitational,
            exact=kinetic + ahead + elastic,
            untimely=untimely,
            loads=loads,
            supports=numbers[int(kernels.WORK)] + supports.sum() + worked,
            supports_absolute=numbers[int(kernels.WORK_ABSOLUTE)] + worked_absolute,
            worked=worked,
            worked_absolute=worked_absolute,
            reach=reach,
            has_changed=bool(numbers[int(kernels.CHANGED)]),
            bad_step=-ranks.max(-min(int(numbers[int(kernels.BAD_STEP)]), NEVER)),
        )

    def rounding(self) -> Floats:
        """Energies that float32 cannot distinguish from zero, for each world [J]: those of strains of about 4e-4."""
        found = np.zeros(self.worlds)
        for stiffness, volume in (self._ranks.owned(body).bulk for body in self.bodies):
            found += 1e-7 * stiffness * volume
        return found

    def _add_elastic(self, k: int, body: SoftBody, field: ForceField, u: wp.array) -> None:
        """Add strain energies to the sums, and elastic forces to ``node_forces``."""
        energies, kept = self._energies[k], self._field_states[k]
        energies.zero_()
        for name, array in field.state.items():
            wp.copy(kept[name], array)
        field.write_energies(u, energies)
        self._ranks.owned(body).clear_copies(energies)
        field.add_forces(u, body.state.forces)
        for name, array in field.state.items():
            wp.copy(array, kept[name])
        self._add_rows(energies.reshape((1, len(energies))), kernels.ELASTIC)

    def _add_rows(self, rows: wp.array, column: int) -> None:
        self._sums.launch(kernels.sum_rows, [rows, rows.shape[1] // self.worlds, column])

    def _add_nodal(self, k: int, u: wp.array, v: wp.array, pace: Pace, keeps: bool) -> None:
        """Add the sums over the nodes of a body, and keep its state beside the last good one."""
        system, body, copies = self.system, self.bodies[k], self._copies
        pushing, dynamics = system.pushing(k), system.dynamics(body, 0.0)
        dynamics.u, dynamics.v = u, v
        count = body.sizes.launch_nodes // self.worlds
        inputs = [pace, wp.float64(system.lag), dynamics, body.conditions.mass, count]
        inputs += [int(pushing is not None), u if pushing is None else pushing]
        inputs += [int(body.state.is_touched), body.state.contact_forces, system.pace.orders, int(keeps)]
        self._sums.launch(kernels.sum_nodes, [*inputs, copies.u[k], copies.v[k]])


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
