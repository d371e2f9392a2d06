"""A rank's part of a body, and the copies between it and the body that users hold on every rank."""

from __future__ import annotations

import dataclasses
import functools
import gc
import operator
import weakref
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.body.keyframes import Followed
from warp_corot.body.soft_body import SoftBody
from warp_corot.discretization.discretization import Discretization
from warp_corot.discretization.elements import Mesh
from warp_corot.errors import InputError
from warp_corot.inputs.checks import shown
from warp_corot.materials.isotropic import Material

from .divided_mesh import DividedMesh, divide
from .exchange import Places, in_worlds
from .partition import Partition, places_of

Ints = npt.NDArray[np.int32]
M = TypeVar("M", bound=Material)

#: The nodal arrays that a step changes.
STATE = ("displacements", "velocities", "reactions")


class Part(SoftBody):
    """A rank's part of a body. Ghosts have no mass, so steps do not move them.

    Args:
        whole: The body.
        partition: The division of its mesh; None if this rank holds only its part.
        rank: The rank of the part.
        device: The device of the part; None: that of the body.

    Attributes:
        numbers: The numbers of its nodes and elements in the whole mesh.
        places, element_places: Their places in ``whole``, int32 [n] and [t].
        is_own: Whether this rank moves each node, bool [worlds * n].
    """

    def __init__(self, whole: SoftBody, partition: Partition | None, rank: int, device: wp.Device | None = None):
        self._whole = whole
        mesh, material = whole.mesh, whole.material
        if not isinstance(mesh, DividedMesh):
            assert partition is not None
            mesh = divide(mesh, partition, rank)
            material = part_of_material(material, mesh.numbers.elements, mesh.element_count)
        self.numbers = mesh.numbers
        numbers = self.numbers.nodes, self.numbers.elements
        is_whole = mesh is not whole.mesh
        self.places, self.element_places = (
            (each if is_whole else np.arange(len(each))).astype(np.int32) for each in numbers
        )
        self.is_own = np.tile(self.numbers.owner == rank, whole.worlds)
        super().__init__(mesh, material, worlds=whole.worlds, device=device or whole.device, threads=1)
        self.threads = whole.threads  # for checkpoints
        of_whole = whole.mesh if isinstance(whole.mesh, DividedMesh) else whole.discretization
        self.discretization.smallest_volume = of_whole.smallest_volume

    def _discretized(self, mesh: Mesh, material: Material) -> Discretization:
        shared = mesh is self._whole.mesh and self.device == self._whole.device
        return self._whole.discretization if shared else super()._discretized(mesh, material)

    @property
    def masses(self) -> npt.NDArray[np.float64]:
        """Lumped masses of the nodes that this rank moves [kg], float64 [worlds * n]; zero for ghosts."""
        if isinstance(self._whole.mesh, DividedMesh):
            return np.where(self.is_own, super().masses, 0.0)
        # Nodes of a remeshed body have what they carry.
        return np.where(self.is_own, self._whole.masses[self.numbers.in_worlds(self._whole.worlds)], 0.0)

    @property
    def surface_faces(self) -> tuple[Ints, Ints]:
        """The triangles of the whole body's surface around the nodes that this rank moves, int32 [f, 3], in the whole
        body's order; and the element of each, [f]."""
        return self._surface[1:]

    @property
    def surface_here(self) -> Ints:
        """The numbers of ``surface_faces`` among the triangles of the whole body's surface, int32 [f]."""
        return self._surface[0]

    @functools.cached_property
    def _surface(self) -> tuple[Ints, Ints, Ints]:
        triangles, parents = self._whole.surface_faces
        number = np.full(self._whole.world_node_count, -1, np.int32)
        own = self.is_own[: len(self.numbers.nodes)]
        number[self.places[own]] = 1
        here = np.flatnonzero((number[triangles] >= 0).any(axis=1)).astype(np.int32)
        number[self.places] = np.arange(len(self.numbers.nodes), dtype=np.int32)
        elements = np.searchsorted(self.element_places, parents[here]).astype(np.int32)
        return here, number[triangles[here]], elements


def part_of_material(material: M, elements: npt.NDArray[np.integer], count: int) -> M:
    """The material of some of ``count`` elements."""
    found: dict[str, Any] = {}
    for field in dataclasses.fields(material):  # type: ignore[arg-type]
        values, tail = getattr(material, field.name), material.components.get(field.name, ())
        axis = np.ndim(values) - len(tail) - 1
        if axis >= 0 and np.shape(values)[axis] == count > 1:
            found[field.name] = np.take(values, elements, axis=axis)
    return dataclasses.replace(material, **found) if found else material  # type: ignore[type-var]


class PartSync:
    """Copies users' changes of a whole body to its part, and the results of the part back.

    On each rank the whole body has the present state only of the nodes that this rank moves. Users must make every
    change of the body on all ranks.

    Args:
        whole, part: The body and this rank's part of it.
        comm: The ranks.
    """

    def __init__(self, whole: SoftBody, part: Part, comm: Any):
        self.whole, self.part, self.rank, self._comm = whole, part, comm.rank, comm
        n, count, worlds = len(part.numbers.nodes), whole.world_node_count, whole.worlds
        everywhere = in_worlds(part.places, worlds, count)
        own = np.tile(part.numbers.owner == comm.rank, worlds)
        #: This rank's nodes among those of all worlds of the whole body, and of its part, int32.
        self.own_nodes, self.part_nodes = everywhere[own], np.flatnonzero(own).astype(np.int32)
        devices = whole.device, part.device
        self._all = Places(everywhere, np.arange(worlds * n, dtype=np.int32), *devices)
        self._own = Places(self.own_nodes, self.part_nodes, *devices)
        elements = in_worlds(part.element_places, worlds, whole.world_element_count)
        self._elements = Places(elements, np.arange(len(elements), dtype=np.int32), *devices)
        #: The numbers of this rank's nodes in the whole mesh, int64; and the number of nodes of the whole mesh.
        self.numbers = part.numbers.in_worlds(worlds)[own]
        self._total = worlds * part.numbers.node_count
        self._trajectories: list[Followed] = []
        self._activations: list[Followed] = []
        #: Triangles of the surface around this rank's nodes; None before there is contact.
        self._triangles: Places | None = None
        _known[id(whole)] = self

    @property
    def is_in_parts(self) -> bool:
        """Whether no rank holds the whole mesh."""
        return isinstance(self.whole.mesh, DividedMesh)

    def collect(self, completed: Callable[[str], wp.array]) -> None:
        """Bring the state of all nodes into the body; if no rank holds the whole mesh, of the part's nodes. All ranks
        must call this.

        Args:
            completed: Gives an array of the part's state, by its name, with the values of other ranks' nodes.
        """
        state = self.whole.state
        for name in STATE:
            if self.is_in_parts:
                self._all.to_whole(completed(name), getattr(state, name))
            else:
                getattr(state, name).assign(self._comm.bcast(self.gather(getattr(state, name)), root=0))
        state.publish_positions()
        if self._triangles is None or self.is_in_parts:
            return
        state.contact_forces.assign(self._comm.bcast(self.gather(state.contact_forces), root=0))
        found = state.contact_pressures.numpy()
        own = self._triangles.whole
        for triangles, pressures in self._comm.allgather((own, found[own])):
            found[triangles] = pressures
        state.contact_pressures.assign(found)

    def of_elements(self, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Values of all elements of the body, from those of the part's [worlds * t]; if no rank holds the whole mesh,
        the same. All ranks must call this."""
        if self.is_in_parts:
            return values
        counted = np.flatnonzero(self.part.numbers.counted)
        found = np.zeros((self.whole.worlds, self.whole.world_element_count), values.dtype)
        own = values.reshape(self.whole.worlds, -1)[:, counted]
        for elements, of_rank in self._comm.allgather((self.part.element_places[counted], own)):
            found[:, elements] = of_rank
        return found.ravel()

    def take_over(self) -> None:
        """Copy users' changes to the part: the state, supports, loads and keyframes."""
        whole, part = self.whole, self.part
        whole.state.adopt_positions()
        self._all.to_part(whole.state.displacements, part.state.displacements)
        self._own.to_part(whole.state.velocities, part.state.velocities)
        self._own.to_part(whole.conditions.held, part.conditions.held)
        part.conditions.find_inverse_masses()
        part.state.publish_positions()
        self._take_loads()
        self._take_keyframes()
        self._take_activation()
        part.conditions.world_starts.assign(whole.conditions.world_starts)

    def publish(self) -> None:
        """Copy the state of the nodes that this rank moves to the whole body."""
        whole, part = self.whole, self.part
        for name in STATE:
            self._own.to_whole(getattr(part.state, name), getattr(whole.state, name))
        if self._activations:
            self._elements.to_whole(part.discretization.activation, whole.discretization.activation)
        whole.state.publish_positions()
        whole.conditions.world_starts.assign(part.conditions.world_starts)
        if part.state.is_touched:
            self._publish_touch()

    def _publish_touch(self) -> None:
        """Copy the contact forces of the nodes that this rank moves, and the pressures around them, to the whole
        body."""
        whole, part = self.whole.state, self.part.state
        if self._triangles is None:
            whole.make_contact_forces()
            own_surface = self.part.state.contact_surface
            triangles = self.whole.surface_triangles if own_surface is None else own_surface.triangles
            count = self.whole.worlds * len(triangles)
            whole.contact_pressures = wp.zeros(count, dtype=wp.float32, device=self.whole.device)
            # All ranks find the pressure on all of a body's own surface.
            here = self.part.surface_here if own_surface is None else np.arange(len(triangles), dtype=np.int32)
            whole.contact_surface = own_surface
            everywhere = in_worlds(here, self.whole.worlds, len(triangles))
            is_whole = len(self.part.state.contact_pressures) == count
            own = everywhere if is_whole else np.arange(len(everywhere), dtype=np.int32)
            self._triangles = Places(everywhere, own, self.whole.device, self.part.device)
        self._own.to_whole(part.contact_forces, whole.contact_forces)
        self._triangles.to_whole(part.contact_pressures, whole.contact_pressures)

    def take_contact_forces(self) -> None:
        """Copy contact forces of the last step to the part."""
        self._own.to_part(self.whole.state.contact_forces, self.part.state.contact_forces)

    def take_initial(self) -> None:
        """Copy the state that a reset restores to the part."""
        state = self.whole.state
        given = state.initial
        if self.whole.changing is not None:
            # The whole body has that state already, on its initial mesh.
            given = state.displacements, state.velocities
        if given is None:
            self.part.state.initial = None
            return
        found = []
        for array in given:
            found.append(wp.zeros_like(self.part.state.displacements))
            self._own.to_part(array, found[-1])
        self.part.state.initial = (found[0], found[1])

    def gather(self, array: wp.array) -> npt.NDArray[Any] | None:
        """A nodal array of the whole body on rank 0, with each node's value from the rank that moves it; None
        elsewhere.
        """
        values = array.numpy()
        return self._together(values[self.own_nodes], None if self.is_in_parts else values)

    def gather_part(self, values: npt.NDArray[Any]) -> npt.NDArray[Any] | None:
        """Values of all nodes of the whole body on rank 0, from those of the parts' nodes, [n, …]; zero at nodes of no
        element, and in the room for nodes of a body that is remeshed. None elsewhere.
        """
        room = None if self.is_in_parts else np.zeros((len(self.whole.state.displacements), *values.shape[1:]))
        return self._together(values[self.part_nodes], room)

    def _together(self, own: npt.NDArray[Any], elsewhere: npt.NDArray[Any] | None) -> npt.NDArray[Any] | None:
        given = self._comm.gather((self.numbers, own), root=0)
        if given is None:
            return None
        found = np.zeros((self._total, *own.shape[1:])) if elsewhere is None else elsewhere
        found = found.astype(own.dtype)
        for nodes, values in given:
            found[nodes] = values
        return found

    def part_values(self, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Values of the part's nodes from those of all nodes of the whole mesh; zero at ghosts."""
        found = np.zeros((self.part.node_count, *values.shape[1:]), values.dtype)
        found[self.part_nodes] = values[self.numbers]
        return found

    def owns(self, array: wp.array) -> bool:
        """Whether an array is one of the whole body's nodal ones."""
        state, conditions = self.whole.state, self.whole.conditions
        arrays = (
            state.positions,
            state.displacements,
            state.velocities,
            state.reactions,
            state.rest,
            state.contact_forces,
        )
        return array.ptr in {each.ptr for each in (*arrays, conditions.loads, conditions.mass)}

    # --- pieces ----------------------------------------------------------------------------------------------------

    def _take_loads(self) -> None:
        whole, part = self.whole.conditions, self.part.conditions
        if whole.loads.dtype != wp.vec4 or self.whole.state.positions.dtype != wp.vec4:
            raise InputError("use_loads and use_positions do not work on several ranks; use_…(None) ends them")
        if whole.has_loads:
            part.make_loads()
            self._own.to_part(whole.loads, part.loads)
        elif part.has_loads:
            part.use_loads(part.loads, False)

    def _take_keyframes(self) -> None:
        found = self._followed(self._trajectories, self.whole.conditions.trajectories, self._own)
        if found is not None:
            self.part.conditions.set_trajectories(found)

    def _take_activation(self) -> None:
        whole, part = self.whole, self.part
        if not whole.discretization.has_activation:
            return
        part.conditions.make_activation()
        self._elements.to_part(whole.discretization.activation, part.discretization.activation)
        found = self._followed(self._activations, whole.conditions.activations, self._elements)
        if found is not None:
            part.conditions.set_activations(found)

    def _followed(self, known: list[Followed], given: Sequence[Followed], places: Places) -> list[Followed] | None:
        """The part's share of keyframes of the whole body; None if they are known."""
        if len(given) == len(known) and all(map(operator.is_, given, known)):
            return None
        known[:] = given
        found = []
        for each in given:
            here = places_of(each.host_numbers, places.whole)
            found.append(each.of(here >= 0, places.part[here], self.part.device))
        return [each for each in found if each is not None]


# --- gathering -------------------------------------------------------------------------------------------------------

#: The last ``PartSync`` of each body, by its identity.
_known: weakref.WeakValueDictionary[int, PartSync] = weakref.WeakValueDictionary()


def gather(array: wp.array) -> npt.NDArray[Any] | None:
    """A nodal array of a body, such as ``body.positions``, with the values of all ranks. All ranks must call.

    Args:
        array: An array of a body in a ``Simulation`` of this package, [worlds * N] in the mesh's node order.

    Returns:
        On rank 0 a copy, float32 [worlds * N, 3] for vectors; None on other ranks.

    Raises:
        InputError: The array belongs to no such body.
    """
    if not isinstance(array, wp.array):
        raise InputError(f"array is {shown(array)}; it must be a nodal array of a body, such as body.positions")
    known = [each for each in _known.values() if each.owns(array)]
    if not known:
        # Only the length of a copy, such as body.displacements, tells to which body it belongs. Former ones must go.
        gc.collect()
        known = [each for each in _known.values() if len(array) == each.whole.node_count]
    if len(known) != 1:
        raise InputError(
            f"the array [{len(array)}] is of {'no body' if not known else 'several bodies'} in a simulation on several "
            "ranks; it must be a nodal array of one, such as body.positions"
        )
    return known[0].gather(array)
