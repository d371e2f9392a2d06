"""The user's controls of a body: choosing, holding, moving and loading nodes, and active stress of fibres."""

from __future__ import annotations

import keyword
import re
import warnings
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.elements import Mesh
from warp_corot.discretization.sizes import Sizes, vec3_view
from warp_corot.errors import InputError, depth_of_user
from warp_corot.inputs.checks import FLOAT32, checked_indices, shown, vectors_on_device
from warp_corot.inputs.selection import CONSTANTS, FUNCTIONS, REGIONS, select_nodes
from warp_corot.inputs.simulation_lock import under_lock
from warp_corot.materials.anisotropic import Directional
from warp_corot.materials.isotropic import Material

from .arrays import Views
from .keyframes import Activation, NodeKeyframes, constant_stress
from .state import Conditions, State

#: Names with a meaning of their own in expressions.
TAKEN = {"x", "y", "z", *(f"{axis}{end}" for axis in "xyz" for end in ("min", "max"))}
TAKEN |= {*CONSTANTS, *FUNCTIONS, *REGIONS}
#: A choice of nodes: a mask, indices, an expression (``select_nodes``), or a function of the rest positions [m],
#: float64 [N, 3], that gives a mask bool [N].
Nodes = npt.ArrayLike | str | Callable[[npt.NDArray[np.float64]], npt.ArrayLike]


def named_nodes(mesh: Mesh) -> dict[str, Callable[[], npt.NDArray[np.bool_]]]:
    """Functions that give the nodes, bool [N], of each label and each node set of a mesh, by their names in
    expressions.

    Characters other than letters, digits and underscores become underscores; names that expressions use get a suffix
    "_set".
    """
    labels = {name: partial(mesh.nodes_of, name) for name in getattr(mesh, "label_names", ())}
    sets = {name: partial(np.array, nodes) for name, nodes in getattr(mesh, "node_sets", {}).items()}
    found: dict[str, Callable[[], npt.NDArray[np.bool_]]] = {}
    for name, nodes in (sets | labels).items():
        known = re.sub(r"\W", "_", name)
        known = known if known.isidentifier() and not keyword.iskeyword(known) else f"_{known}"
        found[f"{known}_set" if known in TAKEN else known] = nodes
    return found


def nodes_at(nodes: Nodes, mesh_of: Callable[[], Mesh]) -> Any:
    """A mask bool [N] in place of an expression or a function; any other value unchanged.

    An expression that holds nowhere warns, except on a part of a mesh, and unless it says "none".
    In expressions ``zmin`` and the other bounds are those of nodes of elements; names of the mesh's labels and node
    sets can be used, too (`named_nodes`).

    Args:
        nodes: The user's argument.
        mesh_of: Gives the mesh; it is called only if needed.

    Raises:
        InputError: An invalid expression, or a function that does not give true or false for each node.
    """
    if isinstance(nodes, wp.array):
        return nodes.numpy()
    if not isinstance(nodes, str) and not callable(nodes):
        return nodes
    mesh = mesh_of()
    if isinstance(nodes, str):
        chosen = select_nodes(nodes, mesh.points, bounds=_bounds(mesh, nodes), named=named_nodes(mesh))
        if not chosen.any() and "none" not in nodes and getattr(mesh, "bounds", None) is None:
            low, high = (", ".join(f"{x:.3g}" for x in end) for end in _bounds(mesh, nodes))
            message = f"no node is where {nodes!r}; the body lies between ({low}) and ({high}) m"
            warnings.warn(message, UserWarning, stacklevel=depth_of_user())
        return chosen
    count = len(mesh.points)
    try:
        found = np.asarray(nodes(mesh.points.copy()))
    except (TypeError, ValueError, IndexError) as error:
        raise InputError(f"the function for nodes fails at the rest positions [{count}, 3]: {error}") from None
    if found.dtype != bool or found.shape != (count,):
        raise InputError(
            f"the function for nodes gives {found.dtype} of shape {list(found.shape)} at the rest positions "
            f"[{count}, 3]; it must give true or false for each, bool [{count}], like lambda x: x[:, 2] < 0.01"
        )
    return found


def _bounds(mesh: Mesh, expression: str) -> npt.NDArray[np.float64]:
    """The lowest and the highest coordinates of nodes of elements [m], [2, 3]; of the whole mesh, if this is a part."""
    if (given := getattr(mesh, "bounds", None)) is not None:
        mesh.check_expression(expression)  # type: ignore[union-attr]
        return given
    used = mesh.points[np.unique(mesh.tets)]
    return np.stack([used.min(axis=0), used.max(axis=0)])


@dataclass(frozen=True)
class ChosenNodes:
    """The user's choice of nodes in one or more worlds.

    Attributes:
        indices: Indices into the nodes of all worlds [k].
        worlds: Number of worlds.
        each: Number of nodes in each world, or None if the worlds have different ones.
    """

    indices: npt.NDArray[np.intp]
    worlds: int
    each: int | None

    def vectors(self, given: Any, name: str, device: wp.Device) -> npt.NDArray[np.float64] | wp.array:
        """Vectors for the chosen nodes, one for all, one for each, or one for each in each world.

        Returns:
            [3] or [k, 3]; or, for an array on a device, vec3 [1], [k] or [k / worlds] on it.

        Raises:
            InputError: Another shape, or values that are not finite numbers; values on a device are not checked.
        """
        there = vectors_on_device(given, name, (len(self.indices), self.each or len(self.indices)), device)
        if there is not None:
            return there
        if isinstance(given, wp.array):  # of another dtype; read as float64
            given = given.numpy()
        try:
            values = np.asarray(given, dtype=np.float64)
        except (TypeError, ValueError):
            raise InputError(f"{name} is {shown(given)}; it must be finite numbers") from None
        count = len(self.indices)
        shapes: list[tuple[int, ...]] = [(3,), (count, 3)]
        if self.each is not None:
            shapes += [(self.each, 3), (self.worlds, 1, 3), (self.worlds, self.each, 3)]
        if values.shape not in shapes or not np.isfinite(values).all():
            allowed = " or ".join(str(list(shape)) for shape in dict.fromkeys(shapes))
            raise InputError(f"{name} has shape {values.shape}; it must be finite, {allowed}")
        if (np.abs(values) > FLOAT32.max).any():
            raise InputError(f"{name} is {shown(given)}; it must be within the range of float32")
        if self.each is None or values.shape in ((3,), (count, 3)):
            return values
        return np.broadcast_to(values, (self.worlds, self.each, 3)).reshape(count, 3)

    def keyframes(self, given: npt.ArrayLike) -> npt.ArrayLike:
        """Keyframes of the nodes of one world, [K, n, 3], repeated for each world; other keyframes unchanged."""
        try:
            shape = np.shape(given)
        except ValueError:  # rows of different lengths: an error when they are read
            return given
        if self.each is None or len(shape) != 3 or shape[1] != self.each:
            return given
        return np.tile(given, (1, self.worlds, 1))


def chosen_nodes(nodes: npt.ArrayLike, count: int, worlds: int, chosen_worlds: Any = None) -> ChosenNodes:
    """The nodes that a mask or a list of indices gives, in all worlds or in the chosen ones.

    Args:
        nodes: Mask bool [N] or indices into one world's nodes; or a mask of all worlds' nodes, [worlds, N] or
            [worlds * N].
        count: Nodes in one world, N.
        worlds: Number of worlds.
        chosen_worlds: None for all, one index, a mask bool [worlds], or indices.

    Raises:
        InputError: Mask of the wrong length, index out of range, or a mask of all worlds' nodes with chosen worlds.
    """
    try:
        given = np.asarray(nodes)
    except ValueError:
        given = np.empty(0, object)
    if given.dtype == bool and given.shape in ((worlds, count), (worlds * count,)) and given.shape != (count,):
        if chosen_worlds is not None:
            raise InputError("a mask of all worlds' nodes chooses the worlds itself; worlds must not be given as well")
        return ChosenNodes(np.flatnonzero(given), worlds, None)
    own = checked_indices(nodes, count, "node")
    which = np.arange(worlds) if chosen_worlds is None else checked_indices(chosen_worlds, worlds, "world")
    return ChosenNodes((which[:, None] * count + own).ravel(), len(which), len(own))


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
