"""The state of a body's nodes on a device, and the conditions on them: held, moved and loaded nodes, active fibres."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.discretization import Discretization
from warp_corot.discretization.sizes import Clock, Sizes, padded, same_array
from warp_corot.kernels.stepping.integrate import (
    ADOPT_POSITIONS,
    LOAD_NODES,
    PUBLISH_POSITIONS,
    follow_activation,
    follow_trajectory,
    free_nodes,
    hold_nodes,
    release_nodes,
)

from .arrays import PatchArrays
from .keyframes import Activation, Followed, NodeKeyframes, followed_stress

if TYPE_CHECKING:
    from warp_corot.mesh.surfaces.bound import SurfaceMesh


class State:
    """Displacements, velocities and forces of nodes, in 16-byte vec4 arrays whose fourth lane is unused.

    With vec4, a node is one load and, where the GPU supports it, one reduction. The state variable is the displacement
    from rest, which keeps the digits of small strains: the static end of a linear beam is exact to 1e-6 of its
    deflection; with float32 positions, to 4e-6 with the beam at the origin and to 3e-5 one metre away.

    Args:
        sizes: Number of nodes.
        rest: Rest positions of the nodes of all worlds [m], [worlds * N, 3].
        device: The device of the arrays.

    Attributes:
        rest, positions, displacements, velocities: [m], [m/s], vec4. ``positions`` may be another program's array, of
            vec3 or vec4.
        forces: The sum of forces within a step [N], zero between steps.
        reactions: Forces of the supports in the last step [N].
        contact_forces: Contact forces in the last step [N]; one entry until the body may have contact.
        contact_pressures: Contact pressures on the triangles of the surface [Pa], float32; empty until then.
        contact_surface: That surface; None: the boundary of the tetrahedra.
        rebound_contact_surface: Binds it to the nodes of the present mesh; None: the mesh does not change.
        is_touched: Whether the body may have contact.
        initial: Displacements and velocities that a reset restores; None for rest.
        revision: Changes whenever ``positions`` becomes another array.
    """

    def __init__(self, sizes: Sizes, rest: npt.NDArray[np.float64], device: wp.Device):
        self.sizes, self.device = sizes, device
        self.rest = wp.array(padded(rest), dtype=wp.vec4, device=device)
        self.positions = wp.clone(self.rest)
        self.displacements, self.velocities, self.forces, self.reactions = (wp.zeros_like(self.rest) for _ in range(4))
        self.contact_forces, self.is_touched = wp.zeros(1, dtype=wp.vec4, device=device), False
        self.contact_pressures = wp.zeros(0, dtype=wp.float32, device=device)
        self.contact_surface: SurfaceMesh | None = None
        self.rebound_contact_surface: Callable[[], SurfaceMesh] | None = None
        self.initial: tuple[wp.array, wp.array] | None = None
        self.revision = 0

    def move_into(self, rest: wp.array, displacements: wp.array, velocities: wp.array, reactions: wp.array) -> None:
        """Use other arrays from now on, vec4 of at least the same size; ``rest`` already has its values."""
        self.adopt_positions()
        for array, own in (
            (displacements, self.displacements),
            (velocities, self.velocities),
            (reactions, self.reactions),
        ):
            wp.copy(array, own, count=self.sizes.nodes)
        self.rest, self.displacements, self.velocities, self.reactions = rest, displacements, velocities, reactions
        self.positions, self.forces = wp.clone(rest), wp.zeros_like(displacements)

    def make_contact_forces(self) -> None:
        """Ensure that there is a contact force for every node of the current mesh."""
        if len(self.contact_forces) != len(self.displacements):
            self.contact_forces = wp.zeros_like(self.displacements)
            self.revision += 1
        self.is_touched = True

    def set_displacements(self, values: npt.NDArray[np.float64]) -> None:
        """Set the displacements of the nodes of all worlds [m], [worlds * N, 3]."""
        self.displacements[: self.sizes.nodes].assign(padded(values))
        self.publish_positions()

    def set_velocities(self, values: npt.NDArray[np.float64]) -> None:
        """Set the velocities of the nodes of all worlds [m/s], [worlds * N, 3]."""
        self.velocities[: self.sizes.nodes].assign(padded(values))

    def adopt_positions(self) -> None:
        """Adopt positions that were written after they were last published."""
        kernel = ADOPT_POSITIONS[self.positions.dtype]
        self._launch(kernel, [self.rest, self.positions], [self.displacements])

    def publish_positions(self) -> None:
        """Write positions from displacements."""
        kernel = PUBLISH_POSITIONS[self.positions.dtype]
        self._launch(kernel, [self.rest, self.displacements], [self.positions])

    def use_positions(self, positions: wp.array) -> None:
        """Publish positions to this array from now on, and adopt them from it."""
        before, self.positions = self.positions, positions
        self.publish_positions()
        if not same_array(positions, before):
            self.revision += 1

    def remember(self) -> None:
        """Make the current state the one that a reset restores."""
        self.adopt_positions()
        self.initial = (wp.clone(self.displacements), wp.clone(self.velocities))

    def _launch(self, kernel: wp.Kernel, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim=self.sizes.launch_nodes, inputs=inputs, outputs=outputs, device=self.device)


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

    def loads_and_weights(self, gravity: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """Loads and weights of all nodes in gravity [m/s^2], [N], float64 [worlds * N, 3]; waits for the device."""
        found = self.discretization.masses[:, None] * np.asarray(gravity, np.float64)
        return found + self.loads.numpy()[: self.sizes.nodes, :3] if self.has_loads else found

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
