"""The conditions of a body on the device: held, moved and loaded nodes, and active fibres."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.discretization import Discretization
from warp_corot.discretization.sizes import Clock, same_array
from warp_corot.kernels.stepping.integrate import (
    LOAD_NODES,
    follow_activation,
    follow_trajectory,
    free_nodes,
    hold_nodes,
    release_nodes,
)

from .arrays import PatchArrays
from .keyframes import Activation, Followed, NodeKeyframes, followed_stress
from .state import State


class Conditions:
    """Supports, loads, keyframes and active stress.

    The cost of a change depends on the patch, not on the body. Changes that keep all launches of a step (other held
    nodes, other loads, other velocities, keyframes in place of as many others) do not invalidate recorded steps.

    Args:
        discretization: The mesh.
        state: The state of the nodes.
        mass: Mass of each node [kg], float32.

    Attributes:
        mass: The argument; zero at nodes of no element.
        held: Nonzero for fixed and prescribed nodes, uint8.
        inverse_mass: Inverse mass of free nodes [1/kg], float32; zero for others.
        loads: External forces [N], vec4, or another program's array; one entry until there are loads.
        has_loads: Whether there are loads.
        trajectories: Keyframes that nodes follow.
        activations: Keyframes that active stress follows.
        world_starts: The time when each world was last reset [s], float64 [worlds].
        revision: Changes whenever the launches of a step change, so that steps must be recorded again.
        rewritten: Changes whenever keyframes change that existing launches read.
    """

    def __init__(self, discretization: Discretization, state: State, mass: wp.array):
        self.discretization, self.sizes = discretization, discretization.sizes
        self.state, self.device, self.mass = state, state.device, mass
        self.held = wp.zeros(len(mass), dtype=wp.uint8, device=self.device)
        self.inverse_mass = wp.empty(len(mass), dtype=wp.float32, device=self.device)
        self.loads = wp.zeros(1, dtype=wp.vec4, device=self.device)
        self.has_loads = False
        self.trajectories: list[Followed] = []
        self.activations: list[Followed] = []
        self.world_starts = wp.zeros(self.sizes.worlds, dtype=wp.float64, device=self.device)
        self.revision = self.rewritten = 0
        self.patches = PatchArrays(self.device)
        self.find_inverse_masses()

    def move_into(self, held: wp.array, mass: wp.array, inverse_mass: wp.array, loads: wp.array) -> None:
        """Use other arrays from now on, of at least the same size; ``mass`` already has its values."""
        count = self.sizes.nodes
        wp.copy(held, self.held, count=count)
        if self.has_loads:
            wp.copy(loads, self.loads, count=count)
        self.held, self.mass, self.inverse_mass, self.loads = held, mass, inverse_mass, loads
        self.find_inverse_masses()

    # --- supports --------------------------------------------------------------------------------------------------

    def held_mask(self) -> npt.NDArray[np.bool_]:
        """Which nodes are held, bool [worlds * N]; waits for the device."""
        return self.held[: self.sizes.nodes].numpy() != 0

    def find_inverse_masses(self) -> None:
        """Set the inverse mass of every free node, and zero for held ones."""
        inputs, outputs = [self.mass, self.held], [self.inverse_mass]
        wp.launch(free_nodes, len(self.inverse_mass), inputs, outputs, device=self.device)

    def hold(self, nodes: wp.array, velocities: wp.array) -> None:
        """Hold nodes and move them at these velocities.

        Args:
            nodes: int32 [k].
            velocities: [m/s], vec3 [k], [1] for all nodes, or [k / worlds] for each world.
        """
        outputs = [self.held, self.inverse_mass, self.state.velocities]
        wp.launch(hold_nodes, len(nodes), [nodes, velocities], outputs, device=self.device)

    def release(self, nodes: wp.array) -> None:
        """Free nodes, int32 [k]; they keep their velocity."""
        outputs = [self.held, self.inverse_mass, self.state.reactions]
        wp.launch(release_nodes, len(nodes), [nodes, self.mass], outputs, device=self.device)

    def follow(self, keys: NodeKeyframes) -> None:
        """Hold nodes and let them follow these keyframes only, in the arrays of former ones if these fit."""
        for k, former in enumerate(self.trajectories):
            there = former.rewritten(keys)
            if there is not None:
                self.trajectories[k] = there
                self.rewritten += 1
                return
        self.stop_following(keys.nodes)
        trajectory = keys.on(self.device)
        self.hold(trajectory.numbers, self.patches.still)
        self.set_trajectories([*self.trajectories, trajectory])

    def stop_following(self, nodes: npt.NDArray[np.integer]) -> None:
        """Remove nodes, [k], from the keyframes that they follow."""
        kept = [trajectory.without(nodes) for trajectory in self.trajectories]
        if any(now is not before for now, before in zip(kept, self.trajectories, strict=True)):
            self.set_trajectories([each for each in kept if each is not None])

    def set_trajectories(self, trajectories: Sequence[Followed]) -> None:
        """Let nodes follow these keyframes only."""
        self.trajectories = list(trajectories)
        self.revision += 1

    # --- loads -----------------------------------------------------------------------------------------------------

    def make_loads(self) -> None:
        """Ensure that there is an array of loads for every node."""
        if not self.has_loads:
            if len(self.loads) < self.sizes.nodes:
                self.loads = wp.zeros(self.sizes.nodes, dtype=wp.vec4, device=self.device)
            self.has_loads = True
            self.revision += 1

    def load(self, nodes: wp.array, forces: wp.array) -> None:
        """Set the loads of nodes.

        Args:
            nodes: int32 [k].
            forces: [N], vec3 [k], [1] for all nodes, or [k / worlds] for each world.
        """
        self.make_loads()
        kernel = LOAD_NODES[self.loads.dtype]
        wp.launch(kernel, len(nodes), [nodes, forces], [self.loads], device=self.device)

    def use_loads(self, loads: wp.array, has_loads: bool) -> None:
        """Read loads from another array from now on."""
        before, self.loads, self.has_loads = (self.loads, self.has_loads), loads, has_loads
        if not (same_array(loads, before[0]) and has_loads == before[1]):
            self.revision += 1

    # --- fibres ----------------------------------------------------------------------------------------------------

    def make_activation(self) -> None:
        """Ensure that there is an active stress for every element."""
        self.revision += int(self.discretization.make_activation())

    def follow_trajectories(self, clock: Clock, offset: int, support_work: wp.array) -> None:
        """Launch the velocities of prescribed nodes in the ``offset``-th step since the clock was last advanced, and
        the count of the work that their supports do against the forces so far."""
        state = self.state
        for each in self.trajectories:
            inputs = [each.numbers, each.times, each.values, clock.arrays, self.world_starts]
            inputs += [self.sizes.world_nodes, offset, state.forces, state.displacements]
            outputs = [state.velocities, support_work]
            wp.launch(follow_trajectory, len(each.numbers), inputs, outputs, device=self.device)

    def follow_activations(self, clock: Clock, offset: int) -> None:
        """Launch the kernel that sets the active stress of elements that follow keyframes.

        Args:
            clock: The simulation's clock.
            offset: Number of launched steps that the clock does not count yet.
        """
        for each in self.activations:
            inputs = [each.numbers, each.times, each.values, clock.arrays, self.world_starts]
            inputs += [self.sizes.world_elements, offset]
            outputs = [self.discretization.activation]
            wp.launch(follow_activation, len(each.numbers), inputs, outputs, device=self.device)

    def activate(self, elements: npt.NDArray[np.integer], stress: Activation | npt.NDArray[np.float64]) -> None:
        """Set keyframes or stresses [Pa], [k], for elements, [k], in place of former keyframes."""
        added = []
        if not isinstance(stress, Activation):
            live = self.discretization.activation[: self.sizes.elements]
            values = live.numpy().copy()
            values[elements] = stress
            live.assign(values)
        elif len(elements):
            added = [followed_stress(elements, stress, self.device)]
        kept = [left for each in self.activations if (left := each.without(elements))]
        # New values in the same array do not change the launches.
        if added or kept != self.activations:
            self.set_activations(kept + added)

    def set_activations(self, activations: Sequence[Followed]) -> None:
        """Let active stress follow these keyframes only."""
        self.activations = list(activations)
        self.revision += 1
