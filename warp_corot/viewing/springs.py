"""Springs between hands and the shown surfaces: forces of the system, launched within each step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.kernels.viewing import hands as kernels
from warp_corot.simulation.simulation import Simulation

from .shown import Shown

#: Maximum number of hands on a body at the same time, and of points in a patch: one thread loops over them.
MOST_HANDS, MOST_POINTS = 8, 64
#: The square of the spring's own frequency times the longest step; the limit is 4, of which elasticity takes up to 3.3.
STIFF = 0.2
#: Damping of the spring over critical damping.
DAMPED = 0.1
#: The largest force on a patch over Young's modulus and the patch's area: beyond that, elements turn over for good.
HARDEST = 0.5


@dataclass(frozen=True, eq=False)
class HeldPatch:
    """Points of a shown surface, and the weight of each.

    Attributes:
        points: int32 [k], at most MOST_POINTS.
        shares: The points' weights, which sum to one, float64 [k].
        area: Area of the surface around the points at rest [m^2].
    """

    points: npt.NDArray[np.int32]
    shares: npt.NDArray[np.float64]
    area: float


class AllSprings:
    """The springs of all hands of a simulation. ``sim.system.forces`` has one of these.

    Args:
        sim: The simulation.
        shown: The shown surface of each body.

    Attributes:
        revision: Changes when a body is first held, since its launches then begin.
    """

    def __init__(self, sim: Simulation, shown: Sequence[Shown]):
        self.sim, self.shown, self.revision = sim, shown, 0
        self._bodies: dict[int, BodySprings] = {}
        sim.system.forces.append(self)

    def _springs_of(self, body: int) -> BodySprings:
        """The springs that hold a body, none yet."""
        raise NotImplementedError

    def close(self) -> None:
        """Let everything go and leave the simulation."""
        self.sim.system.forces.remove(self)
        self._bodies.clear()

    def add_forces(self) -> None:
        """Launch the forces of all hands; may be recorded."""
        for springs in self._bodies.values():
            springs.launch()

    def hold(self, body: int, patch: HeldPatch, *, rigid: bool, strength: float = 1.0) -> Spring:
        """Take hold of a patch as it is now.

        Args:
            body: The number of the body.
            patch: Points of its shown surface.
            rigid: Whether every point is held; otherwise only their mean is.
            strength: Stiffness over the largest stable one at the time step, 0 to 1.

        Raises:
            LookupError: The maximum number of hands hold the body already.
        """
        if body not in self._bodies:
            self._bodies[body] = self._springs_of(body)
            self.revision += 1
        return self._bodies[body].hold(patch, rigid, strength)

    def refit(self) -> None:
        """Find the stiffness again if the meshes or their nodes' masses have changed."""
        for springs in self._bodies.values():
            springs.refit()


class Springs(AllSprings):
    """The springs of explicit steps, which count their work themselves."""

    def _springs_of(self, body: int) -> ExplicitSprings:
        return ExplicitSprings(self.sim, self.shown[body])

    def complete_work(self) -> None:
        """Launch the count of the work of all hands up to the present state; may be recorded."""
        for springs in self._bodies.values():
            springs.launch_completion()


class Spring:
    """The spring of one hand; see ``AllSprings.hold``.

    Attributes:
        stiffness: Stiffness of the spring, for the whole patch [N/m].
        limit: The largest force on it [N].
        slot: Its place among the hands of the body.
        motion: How far the hand has moved since it took hold [m], float64 [3].
    """

    def __init__(self, owner: BodySprings, slot: int, patch: HeldPatch, rigid: bool, strength: float):
        self._owner, self.slot = owner, slot
        self.patch, self.rigid, self.strength = patch, rigid, strength
        self.stiffness = self.damping = self.limit = 0.0
        self.motion: npt.NDArray[np.float64] = np.zeros(3)
        self.start: npt.NDArray[np.float64] = np.zeros(3)

    def move(self, motion: npt.ArrayLike) -> None:
        """Set the hand's distance from where it took hold [m], [3]."""
        self.motion = np.asarray(motion, dtype=np.float64)
        self._owner.write(self.slot)

    def release(self) -> None:
        """Release; further calls do nothing."""
        self._owner.release(self.slot, self)

    @property
    def force(self) -> npt.NDArray[np.float64]:
        """The force on the body in the last step [N], float64 [3]; waits for the device."""
        return self._owner.found()[self.slot, 0]

    @property
    def ends(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """The middle of the patch, and the place to which the hand pulls it [m], float64 [3] each."""
        middle = self.patch.shares @ self._owner.shown.rest[self.patch.points]
        return middle + self._owner.found()[self.slot, 1], middle + self.start + self.motion


class BodySprings:
    """The springs that hold one body."""

    def __init__(self, sim: Simulation, shown: Shown):
        self.sim, self.shown, self.body = sim, shown, shown.body
        device, size = self.body.device, (MOST_HANDS, MOST_POINTS)
        self._held: list[Spring | None] = [None] * MOST_HANDS
        self._springs = wp.zeros(MOST_HANDS, dtype=kernels.Spring, device=device)
        self._patches = wp.zeros(size, dtype=wp.int32, device=device)
        self._shares = wp.zeros(size, dtype=wp.float32, device=device)
        self._starts = wp.zeros(size, dtype=wp.vec3, device=device)
        self._parts = wp.zeros(size, dtype=wp.vec4, device=device)
        self._found = wp.zeros((MOST_HANDS, 2), dtype=wp.vec3, device=device)

    def launch(self) -> None:
        """Launch the forces of the hands."""
        raise NotImplementedError

    def launch_completion(self) -> None:
        """Launch the count of their work up to the present state, if they count it."""

    def hold(self, patch: HeldPatch, rigid: bool, strength: float) -> Spring:
        if None not in self._held:
            raise LookupError(f"{MOST_HANDS} hands hold the body already")
        slot = self._held.index(None)
        spring = self._held[slot] = Spring(self, slot, patch, rigid, strength)
        count = len(patch.points)
        self._patches[slot, :count].assign(patch.points.astype(np.int32))
        self._shares[slot, :count].assign(patch.shares.astype(np.float32))
        inputs = [self._patches[slot], self.shown.nodes, self.shown.binding.weights, self.body.state.displacements]
        wp.launch(kernels.take_hold, count, inputs, [self._starts[slot]], device=self.body.device)
        spring.start = patch.shares @ self._starts[slot].numpy()[:count]
        self._begin(slot)
        self._fit(spring)
        self.write(slot)
        return spring

    def _begin(self, slot: int) -> None:
        """Forget what an earlier hand left."""

    def release(self, slot: int, spring: Spring) -> None:
        if self._held[slot] is spring:
            self._held[slot] = None
            self.write(slot)

    def refit(self) -> None:
        for slot, spring in enumerate(self._held):
            if spring is not None:
                self._fit(spring)
                self.write(slot)

    def write(self, slot: int) -> None:
        """Copy a hand to the device."""
        spring = self._held[slot]
        of_spring: Any = kernels.Spring
        row: Any = np.zeros(1, dtype=of_spring.numpy_dtype())
        if spring is not None:
            row["motion"], row["stiffness"], row["damping"] = spring.motion, spring.stiffness, spring.damping
            row["limit"], row["rigid"], row["count"] = spring.limit, int(spring.rigid), len(spring.patch.points)
        given = wp.array(row, dtype=kernels.Spring, device=self.body.device)
        wp.copy(self._springs, given, dest_offset=slot, count=1)

    def found(self) -> npt.NDArray[np.float64]:
        """Force [N] and mean displacement [m] of every hand in the last step, float64 [hands, 2, 3]."""
        return self._found.numpy().astype(np.float64)

    def _fit(self, spring: Spring) -> None:
        """The stiffness and the damping that are stable at the time step."""
        # Copied, since a view of a device's array may be the array itself.
        nodes = np.array(self.shown.nodes.numpy()[spring.patch.points])
        weights = np.array(self.shown.binding.weights.numpy()[spring.patch.points], dtype=np.float64)
        weights *= spring.patch.shares[:, None]
        used, place, visits = np.unique(nodes, return_inverse=True, return_counts=True)
        place = place.reshape(nodes.shape)
        self._parts[spring.slot, : len(nodes)].assign((1.0 / visits[place]).astype(np.float32))
        total = np.bincount(place.ravel(), np.abs(weights).ravel(), len(used))
        mass = self.body.masses[used]
        # The largest eigenvalue of the spring over masses for a stiffness of one: exact if the hand holds the mean,
        # else a bound.
        softness = float((total / mass).max() if spring.rigid else (total**2 / mass).sum())
        dt = self._longest_step()
        spring.stiffness = spring.strength * STIFF / (dt**2 * softness)
        spring.limit = HARDEST * float(np.mean(self.body.material.isotropic.young)) * spring.patch.area
        spring.damping = 2.0 * DAMPED * (spring.stiffness / softness) ** 0.5

    def _longest_step(self) -> float:
        """The explicit step that the springs must bear [s]."""
        safe = self.sim.safe_step
        return self.sim.dt if safe is None else safe.at_rest


class ExplicitSprings(BodySprings):
    """The springs that hold one body in explicit steps."""

    def __init__(self, sim: Simulation, shown: Shown):
        super().__init__(sim, shown)
        device = self.body.device
        self._counted = wp.zeros(MOST_HANDS, dtype=wp.float32, device=device)
        self._last = wp.zeros((MOST_HANDS, MOST_POINTS), dtype=wp.vec3, device=device)

    def launch(self) -> None:
        system, state, shown = self.sim.system, self.body.state, self.shown
        inputs = [self._springs, self._patches, self._shares, self._starts, self._parts, shown.nodes]
        inputs += [shown.binding.weights, system.pace.arrays, system.offset, system.gravity]
        inputs += [self.body.conditions.inverse_mass, state.displacements, state.velocities]
        outputs = [self._last, self._counted, state.forces, self._found, system.support_work]
        wp.launch(kernels.pull, MOST_HANDS, inputs, outputs, device=self.body.device)

    def launch_completion(self) -> None:
        system, shown = self.sim.system, self.shown
        inputs = [self._springs, self._patches, shown.nodes, shown.binding.weights]
        inputs += [system.pace.arrays, self.body.state.velocities]
        outputs = [self._last, self._counted, system.support_work]
        wp.launch(kernels.complete_work, MOST_HANDS, inputs, outputs, device=self.body.device)

    def _begin(self, slot: int) -> None:
        self._last[slot].zero_()
