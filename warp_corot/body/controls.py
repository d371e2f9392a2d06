"""The user's controls of a body: holding, moving and loading nodes, and active stress of fibres."""

from __future__ import annotations

from abc import abstractmethod

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.elements import Mesh
from warp_corot.discretization.sizes import Sizes, vec3_view
from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_indices
from warp_corot.inputs.simulation_lock import under_lock
from warp_corot.materials.anisotropic import Directional
from warp_corot.materials.isotropic import Material

from .activation import Activation, constant_stress
from .conditions import Conditions
from .places import ChosenNodes, Nodes, chosen_nodes, nodes_at
from .state import State
from .trajectory import NodeKeyframes
from .views import Views


class Controls:
    """The part of ``SoftBody`` for constraints, loads and activation.

    Indices of nodes and elements refer to one world and apply to all worlds, unless ``worlds`` chooses some.
    """

    device: wp.Device
    worlds: int
    sizes: Sizes
    state: State
    conditions: Conditions
    _views: Views

    @property
    @abstractmethod
    def mesh(self) -> Mesh:
        """The mesh."""

    @property
    @abstractmethod
    def material(self) -> Material:
        """The material of the body."""

    @property
    def node_count(self) -> int:
        """Number of nodes of all worlds."""
        return self.sizes.nodes

    @property
    def element_count(self) -> int:
        """Number of elements of all worlds."""
        return self.sizes.elements

    @property
    def world_node_count(self) -> int:
        """Number of nodes of one world."""
        return self.sizes.world_nodes

    @property
    def world_element_count(self) -> int:
        """Number of elements of one world."""
        return self.sizes.world_elements

    @under_lock
    def fix(self, nodes: Nodes, *, worlds: npt.ArrayLike | None = None) -> None:
        """Fix nodes at their current positions.

        Args:
            nodes: Mask bool [N] or indices into one world's nodes; an expression in the rest position, for example
                ``"z < zmin + 0.01"`` (``selection.select_nodes``), or a function of it, ``f(points [N, 3]) -> bool
                [N]`` [m]; or a mask of all worlds' nodes, bool [worlds, N].
            worlds: None for all worlds, an index, indices or a mask bool [worlds].

        Raises:
            InputError: Mask of the wrong length, index out of range, or an invalid expression or function.
        """
        self._hold(self.node_indices(nodes, worlds), self.conditions.patches.still)

    @under_lock
    def release(self, nodes: Nodes, *, worlds: npt.ArrayLike | None = None) -> None:
        """Free fixed or prescribed nodes, which keep their velocity. Nodes and worlds as in ``fix``."""
        chosen = self.node_indices(nodes, worlds)
        self.conditions.stop_following(chosen)
        self.conditions.release(self.conditions.patches.nodes(chosen))

    @under_lock
    def prescribe(
        self,
        nodes: Nodes,
        *,
        velocity: npt.ArrayLike | None = None,
        times: npt.ArrayLike | None = None,
        displacements: npt.ArrayLike | None = None,
        worlds: npt.ArrayLike | None = None,
    ) -> None:
        """Move nodes independently of forces: at a velocity, or along keyframes.

        Args:
            nodes: n nodes of each world, as in ``fix``.
            velocity: Constant velocity [m/s], [3], [n, 3] or [worlds, n, 3]; or an array on the device, as in ``load``.
            times: Increasing times of keyframes [s], [K], at least two, in simulation time since the world's last
                reset.
            displacements: Displacements from rest at these times [m], [K, 3] for all nodes or [K, n, 3]; linear
                in between, constant before and after.
            worlds: As in ``fix``.

        Raises:
            InputError: Neither or both of velocity and keyframes, wrong shapes, times that do not increase, or
                non-finite values.
        """
        named = self._chosen_nodes(nodes, worlds)
        chosen = named.indices
        if (velocity is None) == (times is None and displacements is None):
            raise InputError("prescribe takes either velocity, or times and displacements")
        if velocity is not None:
            self._hold(chosen, named.vectors(velocity, "velocity", self.device))
            return
        self.follow(chosen, times, None if displacements is None else named.keyframes(displacements))

    def follow(
        self, indices: npt.NDArray[np.integer], times: npt.ArrayLike | None, displacements: npt.ArrayLike | None
    ) -> None:
        """``prescribe`` along keyframes, for nodes by their indices among the nodes of all worlds."""
        keys = NodeKeyframes.checked(indices, times, displacements)
        if len(indices):
            self.conditions.follow(keys)

    @under_lock
    def load(self, nodes: Nodes, force: npt.ArrayLike, *, worlds: npt.ArrayLike | None = None) -> None:
        """Set the external force on nodes, from the next step on.

        Args:
            nodes: n nodes of each world, as in ``fix``.
            force: Force on each node [N], [3], [n, 3], [worlds, 1, 3] or [worlds, n, 3]. An array on the device is
                read there without waiting, and its values are not checked: a ``wp.array`` of vec3 [n] or float32
                [n, 3], or a float32 array [n, 3] of PyTorch or JAX.
            worlds: As in ``fix``.

        Raises:
            InputError: Wrong shape or non-finite values.
        """
        chosen = self._chosen_nodes(nodes, worlds)
        values = self._vectors(chosen.vectors(force, "force", self.device))
        if len(chosen.indices):
            self.conditions.load(self.conditions.patches.nodes(chosen.indices), values)
        else:
            self.conditions.make_loads()

    @property
    def activation(self) -> wp.array:
        """Active stress along the fibres [Pa], float32 [worlds * T]: a view of the live array, made on first use.

        Positive stress contracts. You may write to it between steps; elements that follow an ``Activation`` hold the
        value of the last step.

        Raises:
            InputError: The material has no fibres.
        """
        self._make_activation()
        return self._views.hand_out(self.conditions.discretization.activation[: self.element_count])

    @under_lock
    def activate(
        self,
        stress: float | npt.ArrayLike | Activation,
        elements: npt.ArrayLike | None = None,
        *,
        worlds: npt.ArrayLike | None = None,
    ) -> None:
        """Set the active stress along the fibres, from the next step on: P = s (F d) d^T in an element of direction d.

        The stress does not depend on the fibre's length, so it does work and has no energy. It stiffens the fibres: a
        stress beyond Young's modulus along them can need a smaller step than the one found without it.

        Args:
            stress: Positive contracts [Pa]: a number, [n], [worlds, n] or [worlds, 1], or keyframes that it follows
                over time.
            elements: n elements of each world, mask bool [T] or indices; None for all.
            worlds: As in ``fix``.

        Raises:
            InputError: The material has no fibres, a shape is wrong, or values are not finite.
        """
        self._make_activation()
        count = self.world_element_count
        own = np.arange(count) if elements is None else checked_indices(np.asarray(elements), count, "element")
        which = np.arange(self.worlds) if worlds is None else checked_indices(np.asarray(worlds), self.worlds, "world")
        if isinstance(stress, Activation):
            given: Activation | npt.NDArray[np.float64] = stress.repeated(len(which), len(own))
        else:
            given = constant_stress(stress, len(which), len(own)).ravel()
        self.conditions.activate((which[:, None] * count + own).ravel(), given)

    @property
    def constrained(self) -> npt.NDArray[np.bool_]:
        """Which nodes are fixed or prescribed, bool [worlds * N] (a copy); waits for the device."""
        return self.conditions.held_mask()

    @property
    def loads(self) -> wp.array:
        """External nodal forces [N], vec3 [worlds * N]: a view of the live array, made on first use."""
        self.conditions.make_loads()
        return self._views.hand_out(vec3_view(self.conditions.loads[: self.node_count]))

    def node_indices(self, nodes: Nodes, worlds: npt.ArrayLike | None = None) -> npt.NDArray[np.intp]:
        """Indices, among the nodes of all worlds, of nodes given as in ``fix``.

        Raises:
            InputError: Mask of the wrong length, index out of range, or neither.
        """
        return self._chosen_nodes(nodes, worlds).indices

    # --- pieces ----------------------------------------------------------------------------------------------------

    def _chosen_nodes(self, nodes: Nodes, worlds: npt.ArrayLike | None) -> ChosenNodes:
        return chosen_nodes(nodes_at(nodes, lambda: self.mesh), self.world_node_count, self.worlds, worlds)

    def _make_activation(self) -> None:
        """Ensure that there is an active stress for every element."""
        conditions = self.conditions
        if not conditions.discretization.has_activation and not isinstance(self.material, Directional):
            raise InputError(
                "activation needs a material with a direction, TransverselyIsotropic, Orthotropic or FibreReinforced; "
                f"the body's is {type(self.material).__name__}"
            )
        conditions.make_activation()

    def _hold(self, chosen: npt.NDArray[np.intp], velocities: npt.NDArray[np.float64] | wp.array) -> None:
        """Hold nodes that move at these velocities, and remove their keyframes."""
        if len(chosen):
            self.conditions.stop_following(chosen)
            self.conditions.hold(self.conditions.patches.nodes(chosen), self._vectors(velocities))

    def _vectors(self, given: npt.NDArray[np.float64] | wp.array) -> wp.array:
        if isinstance(given, wp.array):
            return given
        return self.conditions.patches.vectors(given.reshape(-1, 3))
