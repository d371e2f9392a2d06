"""What is done to a body: which nodes are held, moved and loaded, and how fibres pull, on the device."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.clock import Clock
from warp_corot.discretization.discretization import Discretization
from warp_corot.discretization.nodal import same_array
from warp_corot.kernels.stepping.activation import follow_activation
from warp_corot.kernels.stepping.conditions import LOAD_NODES, free_nodes, hold_nodes, release_nodes

from .activation import Activation, ElementActivation
from .state import State
from .trajectory import Trajectory


class Conditions:
    """Supports, loads, keyframes and active stress.

    Each change is launches as large as the patch that is meant, whatever the size of the body. Those that leave every
    launch of a step as it was (other nodes held, other loads, other velocities, keyframes in place of as many others)
    leave recorded steps as they are, too.

    Args:
        discretization: The mesh.
        state: The state of the nodes.
        mass: Of each node [kg], float32.

    Attributes:
        mass: As given; zero at nodes that no element names.
        held: Not zero for nodes that are held or moved as told, uint8.
        inverse_mass: Of nodes that are free to move [1/kg], float32; zero for others.
        loads: External forces [N], vec4, or another program's array; one place until there are any.
        has_loads: Whether there are any.
        trajectories: Keyframes that nodes follow.
        activations: Keyframes that active stress follows.
        world_starts: The time when each world was last reset [s], float64 [worlds].
        revision: Changes whenever the launches of a step do, so that steps must be recorded again.
        rewritten: Changes whenever keyframes do that launches go on with.
    """

    def __init__(self, discretization: Discretization, state: State, mass: wp.array):
        self.discretization, self.sizes = discretization, discretization.sizes
        self.state, self.device, self.mass = state, state.device, mass
        self.held = wp.zeros(len(mass), dtype=wp.uint8, device=self.device)
        self.inverse_mass = wp.empty(len(mass), dtype=wp.float32, device=self.device)
        self.loads = wp.zeros(1, dtype=wp.vec4, device=self.device)
        self.has_loads = False
        self.trajectories: list[Trajectory] = []
        self.activations: list[ElementActivation] = []
        self.world_starts = wp.zeros(self.sizes.worlds, dtype=wp.float64, device=self.device)
        self.revision = self.rewritten = 0
        self.find_inverse_masses()

    def move_into(self, held: wp.array, mass: wp.array, inverse_mass: wp.array, loads: wp.array) -> None:
        """Live in other arrays from now on, with as many places or more; ``mass`` is there already."""
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
        """Give every node that is not held its inverse mass, and none to the others."""
        inputs, outputs = [self.mass, self.held], [self.inverse_mass]
        wp.launch(free_nodes, len(self.inverse_mass), inputs, outputs, device=self.device)

    def hold(self, nodes: wp.array, velocities: wp.array) -> None:
        """Hold nodes that move at these velocities.

        Args:
            nodes: int32 [k].
            velocities: [m/s], vec3 [k], [1] for all alike, or [k / worlds] for each world alike.
        """
        outputs = [self.held, self.inverse_mass, self.state.velocities]
        wp.launch(hold_nodes, len(nodes), [nodes, velocities], outputs, device=self.device)

    def release(self, nodes: wp.array) -> None:
        """Let nodes, int32 [k], go with the velocity they have."""
        outputs = [self.held, self.inverse_mass, self.state.reactions]
        wp.launch(release_nodes, len(nodes), [nodes, self.mass], outputs, device=self.device)

    def follow(self, trajectory: Trajectory) -> None:
        """Have nodes follow keyframes and no others, in the arrays of former ones where these fit."""
        for k, former in enumerate(self.trajectories):
            there = trajectory.in_place_of(former)
            if there is not None:
                self.trajectories[k] = there
                self.rewritten += 1
                return
        self.stop_following(trajectory.host_nodes)
        self.set_trajectories([*self.trajectories, trajectory])

    def stop_following(self, nodes: npt.NDArray[np.integer]) -> None:
        """Take nodes, [k], out of the keyframes that they follow."""
        kept = [trajectory.without(nodes) for trajectory in self.trajectories]
        if any(now is not before for now, before in zip(kept, self.trajectories, strict=True)):
            self.set_trajectories([each for each in kept if each is not None])

    def set_trajectories(self, trajectories: Sequence[Trajectory]) -> None:
        """Have nodes follow these keyframes and no others."""
        self.trajectories = list(trajectories)
        self.revision += 1

    # --- loads -----------------------------------------------------------------------------------------------------

    def make_loads(self) -> None:
        """See that there is an array of loads for every node."""
        if not self.has_loads:
            if len(self.loads) < self.sizes.nodes:
                self.loads = wp.zeros(self.sizes.nodes, dtype=wp.vec4, device=self.device)
            self.has_loads = True
            self.revision += 1

    def load(self, nodes: wp.array, forces: wp.array) -> None:
        """Set the loads of nodes.

        Args:
            nodes: int32 [k].
            forces: [N], vec3 [k], [1] for all alike, or [k / worlds] for each world alike.
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
        """See that there is an active stress for every element."""
        self.revision += int(self.discretization.make_activation())

    def follow_activations(self, clock: Clock, offset: int) -> None:
        """Launch what sets the active stress of elements that follow keyframes.

        Args:
            clock: The simulation's.
            offset: How many steps are launched that it does not count yet.
        """
        for each in self.activations:
            inputs = [each.elements, each.times, each.stress, clock.arrays, self.world_starts]
            inputs += [self.sizes.world_elements, offset]
            outputs = [self.discretization.activation]
            wp.launch(follow_activation, len(each.elements), inputs, outputs, device=self.device)

    def activate(self, elements: npt.NDArray[np.integer], stress: Activation | npt.NDArray[np.float64]) -> None:
        """Have elements, [k], follow keyframes, or have these stresses [Pa], [k]; in place of former keyframes."""
        added = []
        if not isinstance(stress, Activation):
            live = self.discretization.activation[: self.sizes.elements]
            values = live.numpy().copy()
            values[elements] = stress
            live.assign(values)
        elif len(elements):
            added = [ElementActivation.of_keys(elements, stress, self.device)]
        kept = [left for each in self.activations if (left := each.without(elements))]
        # Other numbers in the same array are no other launches.
        if added or kept != self.activations:
            self.set_activations(kept + added)

    def set_activations(self, activations: Sequence[ElementActivation]) -> None:
        """Have active stress follow these keyframes and no others."""
        self.activations = list(activations)
        self.revision += 1
