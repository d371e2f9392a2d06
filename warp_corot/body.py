"""A soft body: a mesh, a material and the state of its nodes on a device."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from .activation import Activation, ElementActivation, activate
from .anisotropy import Anisotropic
from .checks import check_float32, checked_count
from .device import checked_device
from .elements import Mesh, device_elements, element_kind, parts, repeated
from .errors import InputError
from .kernels.integrate import adopt_positions, publish_positions, reset_nodes
from .materials import Isotropic, Material
from .trajectory import Trajectory
from .worlds import World, chosen_nodes

#: Elements, and with them nodes, are numbered in 32 bits.
MOST_ELEMENTS = 2**31 - 1


class SoftBody:
    """The state of one body: displacements, velocities, masses, constraints and loads of its nodes.

    Nodal vectors live in 16-byte vec4 arrays, the fourth lane unused, so that a node is one load and, where the card
    can, one reduction. The state proper is the displacement from rest, which keeps the digits of small strains: the
    static end of a linear beam comes out to 1e-6 of its deflection, from float32 positions to 4e-6 with the beam at the
    origin and to 3e-5 with it one metre away. ``positions`` are published after each run of steps, and positions that
    you write are taken over before the next.

    With ``worlds`` there are that many copies of the body, each with its own state, material, loads and fixed nodes,
    stepped together; they do not meet. Nodal arrays are [worlds * N], world after world, and ``world`` is one's view.

    Args:
        mesh: A ``TetForest`` or ``TetMesh``.
        material: Uniform, or with values that broadcast to [worlds, elements]: one per element, [T]; one per world,
            [worlds, 1]; or all, [worlds, T]. Functions of the rest position are evaluated at the elements' centroids.
        worlds: How many copies.
        device: "cpu", "cuda:0", …; None for Warp's default.

    Attributes:
        mesh, worlds, device: As given.
        material: As given, with values in place of functions.
        masses: Lumped nodal masses [kg], float64 [worlds * N]; zero at nodes that no element names.

    Raises:
        InputError: The device is not there, a material array does not have one value per element, stiffness, mass or
            size are beyond the range of float32, or there are more than 2**31 elements in all.
    """

    def __init__(self, mesh: Mesh, material: Material, *, worlds: int = 1, device: str | wp.Device | None = None):
        self.mesh = mesh
        self.material: Any = material.at(centroids(mesh)) if material.functions else material
        self.worlds = checked_count(worlds, "worlds", least=1)
        self.device = checked_device(device)
        if self.element_count > MOST_ELEMENTS:
            raise InputError(
                f"worlds is {worlds}: that is {self.element_count} elements; there can be {MOST_ELEMENTS} at most"
            )
        self.material.check_shapes(self.worlds, len(mesh.tets))
        isotropic = self.material.isotropic
        check_float32(2.0 * isotropic.mu + np.abs(isotropic.lam), "the stiffness 2 mu + |lambda|", "Pa")
        check_float32(mesh.volumes, "the volume of an element", "m^3")
        self.element_kind = element_kind(mesh)
        self.elements = device_elements(mesh, self.device, self.worlds)
        self.fill = getattr(mesh, "fill", None)
        #: Lamé's parameters [Pa] and their stride, 0 or 1; then the same times the filled share, for the forces.
        self.lame = self._lame_arrays(isotropic, None)
        self.mu, self.lam, self.material_stride = self._lame_arrays(isotropic, self.fill)
        self.masses = lumped_masses(mesh, self.material, self.worlds)
        check_float32(self.masses[self.masses > 0], "the mass of a node", "kg")

        n = self.node_count
        self.node_rest = wp.array(_padded(self.rest_positions), dtype=wp.vec4, device=self.device)
        self.node_positions = wp.clone(self.node_rest)
        self.node_displacements = wp.zeros(n, dtype=wp.vec4, device=self.device)
        self.node_velocities = wp.zeros(n, dtype=wp.vec4, device=self.device)
        self.node_forces = wp.zeros(n, dtype=wp.vec4, device=self.device)
        self.node_reactions = wp.zeros(n, dtype=wp.vec4, device=self.device)
        self.node_loads = wp.zeros(1, dtype=wp.vec4, device=self.device)
        self.node_mass = wp.array(self.masses, dtype=wp.float32, device=self.device)
        self.node_inverse_mass = wp.empty(n, dtype=wp.float32, device=self.device)
        self.trajectories: list[Trajectory] = []
        self.element_activation = wp.zeros(1, dtype=wp.float32, device=self.device)
        self.activations: list[ElementActivation] = []
        #: Time steps done when each world was last reset, int64 [worlds].
        self.world_starts = wp.zeros(self.worlds, dtype=wp.int64, device=self.device)
        #: Changes whenever the launches of a step do, so that recorded steps can be recorded anew.
        self.revision = 0
        self._constrained = np.zeros(n, bool)
        #: Displacements and velocities that worlds are reset to; None for rest.
        self.initial_state: tuple[wp.array, wp.array] | None = None
        self._update_inverse_mass()

    # --- state -----------------------------------------------------------------------------------------------------

    @property
    def world_node_count(self) -> int:
        """Nodes of one world, N."""
        return len(self.mesh.points)

    @property
    def node_count(self) -> int:
        """Nodes of all worlds."""
        return self.worlds * self.world_node_count

    @property
    def element_count(self) -> int:
        """Elements of all worlds."""
        return self.worlds * len(self.mesh.tets)

    @property
    def is_uniform(self) -> bool:
        """Whether the elements of a world are all alike in what forces are made of."""
        isotropic = self.material.isotropic
        shapes = [np.shape(value) for value in (isotropic.young, isotropic.poisson)]
        return self.fill is None and all(not shape or shape[-1] == 1 for shape in shapes)

    @property
    def rest_positions(self) -> npt.NDArray[np.float64]:
        """Rest positions of the nodes of all worlds [m], float64 [worlds * N, 3]."""
        return repeated(self.mesh.points, self.worlds)

    def world(self, index: int) -> World:
        """One world's part of the arrays below.

        Raises:
            InputError: There is no such world.
        """
        try:
            number = -1 if isinstance(index, bool) else int(index)
        except (TypeError, ValueError, OverflowError):
            number = -1
        if number != index or not 0 <= number < self.worlds:
            raise InputError(f"world is {index!r}; it must be a whole number from 0 to {self.worlds - 1}")
        return World(self, number)

    @property
    def positions(self) -> wp.array:
        """Nodal positions [m], vec3 [worlds * N], in the mesh's order. A view of the live array: write to it
        between steps, or set the property, and the next step starts from there."""
        return vec3_view(self.node_positions)

    @positions.setter
    def positions(self, values: npt.ArrayLike) -> None:
        # In float64 and by way of the displacement, so that no digit of what is given is lost.
        self._set_displacements(self._checked_vectors(values, "positions") - self.rest_positions)

    @property
    def displacements(self) -> wp.array:
        """Nodal displacements from rest [m], vec3 [worlds * N]: a copy; set the property to change them."""
        self.adopt_positions()
        return wp.clone(vec3_view(self.node_displacements))

    @displacements.setter
    def displacements(self, values: npt.ArrayLike) -> None:
        self._set_displacements(self._checked_vectors(values, "displacements"))

    @property
    def velocities(self) -> wp.array:
        """Nodal velocities [m/s], vec3 [worlds * N]: a view of the live array."""
        return vec3_view(self.node_velocities)

    @velocities.setter
    def velocities(self, values: npt.ArrayLike) -> None:
        self.node_velocities.assign(_padded(self._checked_vectors(values, "velocities")))

    @property
    def reactions(self) -> wp.array:
        """Forces of the supports on fixed and prescribed nodes in the last step [N], vec3 [worlds * N]; zero elsewhere.

        A support carries its node's own weight too. Inertia of a prescribed node is not included.
        """
        return vec3_view(self.node_reactions)

    @property
    def loads(self) -> wp.array:
        """External nodal forces [N], vec3 [worlds * N]: a view of the live array, made on first use."""
        self._ensure_loads()
        return vec3_view(self.node_loads)

    def adopt_positions(self) -> None:
        """Take over positions that somebody wrote since they were last published."""
        self._launch(adopt_positions, [self.node_rest, self.node_positions], [self.node_displacements])

    def publish_positions(self) -> None:
        """Write positions from displacements."""
        self._launch(publish_positions, [self.node_rest, self.node_displacements], [self.node_positions])

    def set_initial_state(self) -> None:
        """Make the present state the one that ``Simulation.reset`` goes back to; at first that is rest."""
        self.adopt_positions()
        self.initial_state = (wp.clone(self.node_displacements), wp.clone(self.node_velocities))

    def reset(self, chosen: wp.array, clock: wp.array) -> None:
        """Put chosen worlds back to their initial state; ``Simulation.reset`` does more and is what to call.

        Args:
            chosen: Not zero for worlds to be reset, int32 [worlds].
            clock: Time steps done, int64 [1].
        """
        kept = self.initial_state is not None
        u, v = self.initial_state or (self.node_displacements, self.node_velocities)
        inputs = [chosen, self.world_node_count, int(kept), u, v, self.node_rest, self.node_inverse_mass, clock]
        outputs = [self.node_displacements, self.node_velocities, self.node_positions, self.node_reactions]
        self._launch(reset_nodes, inputs, [*outputs, self.world_starts])

    # --- constraints and loads -------------------------------------------------------------------------------------

    def fix(self, nodes: npt.ArrayLike, *, worlds: npt.ArrayLike | None = None) -> None:
        """Hold nodes where they are.

        Args:
            nodes: Mask bool [N] or indices into one world's nodes; or a mask of all worlds' nodes, bool [worlds, N].
            worlds: In which worlds: None for all, an index, indices or a mask bool [worlds].

        Raises:
            InputError: Mask of the wrong length or index out of range.
        """
        chosen = self.node_indices(nodes, worlds)
        self._stop_following(chosen)
        self._constrain(chosen, np.zeros(3))

    def release(self, nodes: npt.ArrayLike, *, worlds: npt.ArrayLike | None = None) -> None:
        """Let fixed or prescribed nodes go, with the velocity they have. Nodes and worlds as in ``fix``."""
        chosen = self.node_indices(nodes, worlds)
        self._stop_following(chosen)
        self._constrained[chosen] = False
        self._update_inverse_mass()
        reactions = self.node_reactions.numpy().copy()
        reactions[chosen] = 0.0
        self.node_reactions.assign(reactions)

    def prescribe(
        self,
        nodes: npt.ArrayLike,
        *,
        velocity: npt.ArrayLike | None = None,
        times: npt.ArrayLike | None = None,
        displacements: npt.ArrayLike | None = None,
        worlds: npt.ArrayLike | None = None,
    ) -> None:
        """Move nodes as told, whatever the forces: at a velocity, or along keyframes.

        Args:
            nodes: n nodes of each world, as in ``fix``.
            velocity: Constant velocity [m/s], [3], [n, 3] or [worlds, n, 3].
            times: Increasing times of keyframes [s], [K], at least two, in the time of the simulation, from a world's
                last reset.
            displacements: Displacements from rest at these times [m], [K, 3] for all nodes alike or [K, n, 3]; linear
                in between, constant before and after.
            worlds: As in ``fix``.

        Raises:
            InputError: Neither or both ways given, wrong shapes, times that do not increase, or non-finite values.
        """
        named = chosen_nodes(nodes, self.world_node_count, self.worlds, worlds)
        chosen = named.indices
        if (velocity is None) == (times is None and displacements is None):
            raise InputError("prescribe takes either velocity, or times and displacements")
        if velocity is not None:
            values = named.vectors(velocity, "velocity")
            self._stop_following(chosen)
            self._constrain(chosen, values)
            return
        self.follow(chosen, times, None if displacements is None else named.keyframes(displacements))

    def follow(
        self, indices: npt.NDArray[np.integer], times: npt.ArrayLike | None, displacements: npt.ArrayLike | None
    ) -> None:
        """``prescribe`` along keyframes for nodes by their indices among those of all worlds."""
        trajectory = Trajectory.of_keys(indices, times, displacements, self.device)
        self._stop_following(indices)
        self._constrain(indices, np.zeros(3))
        if len(indices):
            self.trajectories.append(trajectory)
            self.revision += 1

    def load(self, nodes: npt.ArrayLike, force: npt.ArrayLike, *, worlds: npt.ArrayLike | None = None) -> None:
        """Set the external force on nodes, from the next step on.

        Args:
            nodes: n nodes of each world, as in ``fix``.
            force: Force on each node [N], [3], [n, 3], [worlds, 1, 3] or [worlds, n, 3].
            worlds: As in ``fix``.

        Raises:
            InputError: Wrong shape or non-finite values.
        """
        chosen = chosen_nodes(nodes, self.world_node_count, self.worlds, worlds)
        values = chosen.vectors(force, "force")
        self._ensure_loads()
        loads = self.node_loads.numpy().copy()
        loads[chosen.indices, :3] = values
        self.node_loads.assign(loads)

    @property
    def activation(self) -> wp.array:
        """Active stress along the fibres [Pa], float32 [worlds * T]: the live array, made on first use.

        Positive stress contracts. Write to it between steps; elements that follow an ``Activation`` have in it what
        they had in the last step.

        Raises:
            InputError: The material has no fibres.
        """
        if not isinstance(self.material, Anisotropic):
            raise InputError(
                "activation needs a material with a direction, TransverselyIsotropic or Orthotropic; "
                f"the body's is {type(self.material).__name__}"
            )
        if not self.has_activation:
            self.element_activation = wp.zeros(self.element_count, dtype=wp.float32, device=self.device)
            self.revision += 1
        return self.element_activation

    def activate(
        self,
        stress: float | npt.ArrayLike | Activation,
        elements: npt.ArrayLike | None = None,
        *,
        worlds: npt.ArrayLike | None = None,
    ) -> None:
        """Set the active stress along the fibres, from the next step on: P = s (F d) d^T in an element of direction d.

        It pulls whatever the fibre's length, so that it puts work in and has no energy. It stiffens the fibres: a
        stress beyond Young's modulus along them can need a smaller step than was found without it.

        Args:
            stress: Positive contracts [Pa]: a number, [n], [worlds, n] or [worlds, 1], or keyframes that are followed
                over time.
            elements: n elements of each world, mask bool [T] or indices; None for all.
            worlds: As in ``fix``.

        Raises:
            InputError: The material has no fibres, wrong shapes, or values that are not finite.
        """
        activate(self, stress, elements, worlds)

    @property
    def has_activation(self) -> bool:
        return len(self.element_activation) == self.element_count and isinstance(self.material, Anisotropic)

    @property
    def constrained(self) -> npt.NDArray[np.bool_]:
        """Which nodes are fixed or prescribed, bool [worlds * N] (a copy)."""
        return self._constrained.copy()

    @property
    def has_loads(self) -> bool:
        return len(self.node_loads) == self.node_count

    # --- pieces ----------------------------------------------------------------------------------------------------

    def node_indices(self, nodes: npt.ArrayLike, worlds: npt.ArrayLike | None = None) -> npt.NDArray[np.intp]:
        """Indices, among the nodes of all worlds, of those named as in ``fix``.

        Raises:
            InputError: Mask of the wrong length, index out of range, or neither.
        """
        return chosen_nodes(nodes, self.world_node_count, self.worlds, worlds).indices

    def _lame_arrays(self, material: Isotropic, fill: npt.NDArray[np.float64] | None) -> tuple[wp.array, wp.array, int]:
        mu, lam = np.broadcast_arrays(np.atleast_1d(material.mu), np.atleast_1d(material.lam))
        if fill is None and mu.size == 1:
            return self._floats(mu.ravel()), self._floats(lam.ravel()), 0
        shape = (self.worlds, len(self.mesh.tets))
        share = 1.0 if fill is None else fill
        mu, lam = (np.broadcast_to(a, shape) * share for a in (mu, lam))
        return self._floats(mu.ravel()), self._floats(lam.ravel()), 1

    def _floats(self, values: np.ndarray) -> wp.array:
        return wp.array(np.ascontiguousarray(values), dtype=wp.float32, device=self.device)

    def _checked_vectors(self, values: npt.ArrayLike, name: str) -> npt.NDArray[np.float64]:
        given = np.asarray(values.numpy() if isinstance(values, wp.array) else values, dtype=np.float64)
        n = self.world_node_count
        if given.shape in ((n, 3), (self.worlds, n, 3)):
            given = np.broadcast_to(given, (self.worlds, n, 3)).reshape(-1, 3)
        if given.shape != (self.node_count, 3):
            raise InputError(f"{name} has shape {given.shape}; it must be [{self.node_count}, 3]")
        bad = np.flatnonzero(~np.isfinite(given).all(axis=1))
        if len(bad):
            raise InputError(f"{name} of node {bad[0]} are {given[bad[0]].tolist()}; they must be finite")
        return given

    def _set_displacements(self, values: npt.NDArray[np.float64]) -> None:
        self.node_displacements.assign(_padded(values))
        self.publish_positions()

    def _launch(self, kernel: wp.Kernel, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim=self.node_count, inputs=inputs, outputs=outputs, device=self.device)

    def _ensure_loads(self) -> None:
        if not self.has_loads:
            self.node_loads = wp.zeros(self.node_count, dtype=wp.vec4, device=self.device)
            self.revision += 1

    def _constrain(self, chosen: np.ndarray, velocity: np.ndarray) -> None:
        self._constrained[chosen] = True
        self._update_inverse_mass()
        velocities = self.node_velocities.numpy().copy()
        velocities[chosen, :3] = velocity
        self.node_velocities.assign(velocities)

    def _update_inverse_mass(self) -> None:
        inverse = np.zeros(self.node_count)
        free = ~self._constrained & (self.masses > 0)
        inverse[free] = 1.0 / self.masses[free]
        self.node_inverse_mass.assign(inverse.astype(np.float32))

    def _stop_following(self, chosen: np.ndarray) -> None:
        """Take nodes out of the trajectories they follow."""
        kept = [trajectory.without(chosen) for trajectory in self.trajectories]
        if any(now is not before for now, before in zip(kept, self.trajectories, strict=True)):
            self.trajectories = [trajectory for trajectory in kept if trajectory]
            self.revision += 1


def _padded(vectors: np.ndarray) -> npt.NDArray[np.float32]:
    """[N, 3] as the float32 [N, 4] that nodal arrays hold."""
    padded = np.zeros((len(vectors), 4), np.float32)
    padded[:, :3] = vectors
    return padded


def vec3_view(a: wp.array) -> wp.array:
    """The first three lanes of a vec4 array as a live (strided) vec3 array."""
    return a.view(wp.float32)[:, :3].view(wp.vec3)


def centroids(mesh: Mesh) -> npt.NDArray[np.float64]:
    """Centroids of the elements [m], float64 [T, 3]."""
    found = np.empty((len(mesh.tets), 3))
    for part in parts(len(mesh.tets)):
        found[part] = mesh.points[mesh.tets[part]].mean(axis=1)
    return found


def lumped_masses(mesh: Mesh, material: Material, worlds: int = 1) -> npt.NDArray[np.float64]:
    """A quarter of the mass that each element holds, at each of its nodes [kg], float64 [worlds * N]."""
    fill = getattr(mesh, "fill", None)
    density = np.atleast_2d(material.density)
    masses = np.zeros((len(density), len(mesh.points)))
    for of_world, row in zip(masses, np.broadcast_to(density, (len(density), len(mesh.tets))), strict=True):
        for part in parts(len(mesh.tets)):
            quarter = mesh.volumes[part] * row[part] / 4.0
            if fill is not None:
                quarter = quarter * fill[part]
            np.add.at(of_world, mesh.tets[part].ravel(), np.repeat(quarter, 4))
    return np.broadcast_to(masses, (worlds, len(mesh.points))).ravel()
