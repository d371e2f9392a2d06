"""A soft body: a mesh, a material and the state of its nodes on a device."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.discretization import Discretization, FixedMesh, MeshChanges
from warp_corot.discretization.elements import Mesh, repeated
from warp_corot.discretization.sizes import Clock, vec3_view
from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_count, checked_device, checked_numbers, shown
from warp_corot.inputs.cpu_threads import team_for
from warp_corot.inputs.loading import BODY, load
from warp_corot.inputs.simulation_lock import SIMULATION_LOCK, under_lock
from warp_corot.kernels.stepping.integrate import RESET_NODES
from warp_corot.materials.isotropic import Material
from warp_corot.mesh import TetForest
from warp_corot.mesh.surfaces.bodies import boundary_surface
from warp_corot.mesh.surfaces.bound import NOT_OPENED
from warp_corot.mesh.topology import boundary_faces, pieces_of

from .arrays import NodeArrays, SharedArrays, Views
from .controls import Controls
from .state import Conditions, State

if TYPE_CHECKING:
    from warp_corot.discretization.changing.transfer import FollowingBinding
    from warp_corot.mesh.surfaces.bound import DeviceBinding, SurfaceMesh


class SoftBody(Controls, SharedArrays, NodeArrays):
    """The state of one body: displacements, velocities, masses, constraints and loads of its nodes.

    The state variables are displacements from rest (``body.state.State`` says why). ``positions`` are published
    after each run of steps, and positions that you write are adopted before the next one.

    With ``worlds`` there are that many copies of the body, each with its own state, material, loads and fixed nodes,
    stepped together; they do not interact. Nodal arrays are [worlds * N], world after world; ``world`` gives a view of
    one.

    Args:
        mesh: A ``TetForest`` or ``TetMesh``.
        material: Uniform, or with values that broadcast to [worlds, elements]: one per element, [T]; one per world,
            [worlds, 1]; or all, [worlds, T]. Functions of the rest position are evaluated at the elements' centroids.
        worlds: Number of copies.
        device: "cpu", "cuda:0", …; None for Warp's default.
        threads: Most threads that step the body on the CPU; None: as many as this process may use cores, but more than
            two only with 4,096 elements for each. A body takes one for every 2,048 elements at most, no more than it
            has worlds if it has several, and one while it is remeshed. Each number has its own rounding, the same in
            every run.

    A body that is remeshed (``Simulation(…, remesh=…)``) has other nodes after a pass that changed the mesh: read
    ``node_count`` and the arrays again; views from before raise ``StaleViewError``. Its ``node_`` arrays have room for
    the largest number of nodes, and more; only the first ``node_count`` entries are nodes.

    Attributes:
        worlds, device, threads: The arguments.
        discretization: The mesh and the material on the device.
        sizes: Numbers of nodes and elements.
        state: Displacements, velocities and forces of the nodes.
        conditions: Supports, loads and active stress.

    Raises:
        InputError: The mesh or the material has another type, the device does not exist, a material array does not have
            one value per element, stiffness, mass or size are beyond the range of float32, or there are more than 2**31
            elements in all.
    """

    def __init__(
        self,
        mesh: Mesh,
        material: Material,
        *,
        worlds: int = 1,
        device: str | wp.Device | None = None,
        threads: int | None = None,
    ):
        with SIMULATION_LOCK:
            if threads is not None:
                checked_count(threads, "threads", least=1)
            self.threads = threads
            _check_made_of(mesh, material)
            self.worlds = checked_count(worlds, "worlds", least=1)
            self.device = checked_device(device)
            load(BODY, self.device)
            self.discretization: Discretization = self._discretized(mesh, material)
            self.sizes = self.discretization.sizes
            self.discretization.team = team_for(threads, self.sizes.elements if self.device.is_cpu else 0, worlds)
            #: The remeshing that changes the mesh, or None.
            self.changing: MeshChanges | None = None
            self.state = State(self.sizes, self.rest_positions, self.device)
            mass = wp.array(self.masses, dtype=wp.float32, device=self.device)
            self.conditions = Conditions(self.discretization, self.state, mass)
            self._views = Views()
            #: Points that follow the body.
            self.bindings: list[FollowingBinding] = []

    # --- parts -----------------------------------------------------------------------------------------------------

    def _discretized(self, mesh: Mesh, material: Material) -> Discretization:
        return FixedMesh(mesh, material, self.worlds, self.device)

    def __reduce_ex__(self, protocol: object) -> NoReturn:
        raise InputError(
            "a SoftBody lives on a device and can be neither copied nor pickled; "
            "SoftBody(body.mesh, body.material) makes another at rest"
        )

    @property
    def mesh(self) -> Mesh:
        """The mesh; for a body that is remeshed, the current one."""
        return self.discretization.mesh

    @property
    def material(self) -> Any:
        """The material, with values in place of functions; for a body that is remeshed, that of the current
        elements."""
        return self.discretization.material

    @property
    def masses(self) -> npt.NDArray[np.float64]:
        """Lumped nodal masses [kg], float64 [worlds * N]; zero at nodes of no element."""
        return self.discretization.masses

    def follow_mesh(self, changing: MeshChanges, discretization: Discretization) -> None:
        """Let the mesh be the one of these arguments, which changes from now on."""
        self.changing, self.discretization = changing, discretization
        self.conditions.discretization = discretization
        self.expire_views()

    def expire_views(self) -> None:
        """Make views handed out so far stale, because the mesh has changed."""
        self._views.expire()

    @property
    def launch_revision(self) -> int:
        """Changes whenever the launches of a step change, so that steps must be recorded again."""
        return self.conditions.revision + self.state.revision + self.sizes.revision

    @property
    def version(self) -> int:
        """Changes whenever the mesh does; views from before then raise ``StaleViewError``."""
        return self.sizes.version

    # --- state -----------------------------------------------------------------------------------------------------

    @property
    def rest_positions(self) -> npt.NDArray[np.float64]:
        """Rest positions of the nodes of all worlds [m], float64 [worlds * N, 3]."""
        return repeated(self.mesh.points, self.worlds)

    def world(self, index: int) -> World:
        """One world's part of the arrays below.

        Raises:
            InputError: There is no world with this index.
        """
        try:
            number = -1 if isinstance(index, bool) or index != int(index) else int(index)
        except (TypeError, ValueError, OverflowError):
            number = -1
        if not 0 <= number < self.worlds:
            raise InputError(f"world is {shown(index)}; it must be a whole number from 0 to {self.worlds - 1}")
        return World(self, number)

    @property
    def positions(self) -> wp.array:
        """Nodal positions [m], vec3 [worlds * N], in the mesh's order. A view of the live array: write to it
        between steps, or set the property, and the next step starts from there."""
        return self.nodal_view(self.state.positions)

    @positions.setter
    @under_lock
    def positions(self, values: npt.ArrayLike) -> None:
        # In float64 and through displacements, so that no digit is lost.
        self.state.set_displacements(self._checked_vectors(values, "positions") - self.rest_positions)

    @property
    @under_lock
    def displacements(self) -> wp.array:
        """Nodal displacements from rest [m], vec3 [worlds * N]: a copy; set the property to change them."""
        self.state.adopt_positions()
        return wp.clone(vec3_view(self.state.displacements[: self.node_count]))

    @displacements.setter
    @under_lock
    def displacements(self, values: npt.ArrayLike) -> None:
        self.state.set_displacements(self._checked_vectors(values, "displacements"))

    @property
    def velocities(self) -> wp.array:
        """Nodal velocities [m/s], vec3 [worlds * N]: a view of the live array. If you set the property, held nodes
        keep theirs: fixed nodes stay where they are."""
        return self.nodal_view(self.state.velocities)

    @velocities.setter
    @under_lock
    def velocities(self, values: npt.ArrayLike) -> None:
        given, held = self._checked_vectors(values, "velocities"), self.constrained
        if held.any():
            given = np.where(held[:, None], self.velocities.numpy(), given)
        self.state.set_velocities(given)

    @property
    @under_lock
    def reactions(self) -> wp.array:
        """Forces of the supports on fixed and prescribed nodes in the last step [N], vec3 [worlds * N]; zero elsewhere.

        A support also carries the weight of its node. The inertia of a prescribed node is not included.
        """
        return self.nodal_view(self.state.reactions)

    @property
    def contact_forces(self) -> wp.array:
        """Contact forces on the nodes in the last step [N], vec3 [worlds * N]: a view of the live array; zero for nodes
        without contact. The forces of grasps on the nodes that they hold are among them.

        Raises:
            InputError: The body is in no simulation with contact.
        """
        self._check_touched()
        return self.nodal_view(self.state.contact_forces)

    @property
    def contact_pressure(self) -> wp.array:
        """Contact pressure on the triangles of ``contact_surface`` in the last step [Pa], float32 [worlds * F].

        Pressure times area adds up to the force along the normals. The array is live until the mesh changes.

        Raises:
            InputError: The body is in no simulation with contact.
        """
        self._check_touched()
        return self._views.hand_out(self.state.contact_pressures[:])

    @property
    def contact_surface(self) -> SurfaceMesh:
        """The surface on which contact acts, bound to the nodes of a world.

        It is the body's own surface if its mesh was made from a domain, a little coarser than ``mesh.surface()``;
        otherwise the boundary of the tetrahedra, ``surface_triangles``. See ``Contact(on=...)``. After a pass of
        remeshing, the body's own surface has the points and triangles of the last step until the next one.

        Raises:
            InputError: The body is in no simulation with contact.
        """
        self._check_touched()
        if self.state.rebound_contact_surface is not None:
            return self.state.rebound_contact_surface()
        return self.state.contact_surface or boundary_surface(self.mesh)

    @property
    def surface_triangles(self) -> npt.NDArray[np.int32]:
        """The boundary faces of the tetrahedra: nodes within a world, int32 [F, 3], counter-clockwise seen from
        outside."""
        return self.surface_faces[0]

    @property
    def surface_faces(self) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
        """``surface_triangles``, and the element of each, int32 [F]."""
        return boundary_faces(self.mesh.tets, self.mesh.points)

    @property
    def pieces(self) -> int:
        """The number of pieces into which the body has come, by cuts or from the start; elements joined by faces are
        one piece, and ``mesh.pieces()`` gives the piece of each."""
        return int(pieces_of(self.mesh.tets).max()) + 1

    @property
    def cut_area(self) -> float:
        """The area of all cuts so far, measured on one side and at rest [m^2]."""
        return 0.0 if self.changing is None else self.changing.cut_area

    def _check_touched(self) -> None:
        if not self.state.is_touched:
            raise InputError(
                "the body is in no simulation with contact; it must be in one with obstacles or contact=Contact()"
            )

    def nodal_view(self, array: wp.array) -> wp.array:
        """A nodal array as a live view, vec3 [worlds * N], valid until the mesh changes."""
        return self._views.hand_out(vec3_view(array[: self.node_count]))

    def bind(self, points: npt.ArrayLike, triangles: npt.ArrayLike | None = None) -> DeviceBinding:
        """Bind points, or with triangles [F, 3] a surface, to the body; they follow it, also through remeshing.

        ``update(body.displacements)`` of the result moves them to the current state, on the body's device.

        Args:
            points: Rest positions [m], [n, 3].

        Raises:
            InputError: The mesh is not a forest, the body has several worlds, there are triangles and the body can be
                cut, or as in ``TetForest.bind``.
        """
        from warp_corot.discretization.changing.transfer import FollowingBinding

        if not isinstance(self.mesh, TetForest):
            raise InputError(f"only a TetForest can have points bound to it, not a {type(self.mesh).__name__}")
        if self.worlds > 1:
            raise InputError(f"worlds is {self.worlds}; bind points to the mesh, and move them with one world's nodes")
        if triangles is not None and self.changing is not None and self.changing.is_cut:
            raise InputError(NOT_OPENED)
        leaves, _ = self.mesh.embed(points)
        binding = FollowingBinding(self.mesh.bind(points, triangles), self.mesh, leaves, self.device)
        self.bindings.append(binding)
        return binding

    @under_lock
    def set_initial_state(self) -> None:
        """Let ``Simulation.reset`` restore the current state; by default it restores rest."""
        if self.changing is not None:
            self.changing.remember()
        else:
            self.state.remember()

    def reset(self, chosen: wp.array, clock: Clock) -> None:
        """Restore the initial state of chosen worlds; users call ``Simulation.reset``, which does more.

        Args:
            chosen: Nonzero for worlds to be reset, int32 [worlds].
            clock: The simulation's clock.
        """
        if self.changing is not None:
            self.changing.reset(chosen, clock)
            return
        state, conditions = self.state, self.conditions
        u, v = state.initial or (state.displacements, state.velocities)
        inputs = [chosen, self.world_node_count, int(state.initial is not None), u, v, state.rest]
        inputs += [conditions.inverse_mass, clock.arrays]
        outputs = [state.displacements, state.velocities, state.positions, state.reactions, conditions.world_starts]
        kernel = RESET_NODES[state.positions.dtype]
        wp.launch(kernel, dim=self.sizes.launch_nodes, inputs=inputs, outputs=outputs, device=self.device)

    # --- pieces ----------------------------------------------------------------------------------------------------

    def _checked_vectors(self, values: npt.ArrayLike, name: str) -> npt.NDArray[np.float64]:
        given = checked_numbers(values, name, f"[{self.node_count}, 3]")
        n = self.world_node_count
        if given.shape in ((n, 3), (self.worlds, n, 3)):
            given = np.broadcast_to(given, (self.worlds, n, 3)).reshape(-1, 3)
        if given.shape != (self.node_count, 3):
            raise InputError(f"{name} has shape {given.shape}; it must be [{self.node_count}, 3]")
        bad = np.flatnonzero(~np.isfinite(given).all(axis=1))
        if len(bad):
            raise InputError(f"{name} of node {bad[0]} are {given[bad[0]].tolist()}; they must be finite")
        return given


@dataclass(frozen=True, eq=False)
class World:
    """One copy's part of a body's arrays, as views: writing to them changes the body's state.

    Attributes:
        body: The body.
        index: Index of the copy, from 0.
    """

    body: SoftBody
    index: int

    @property
    def nodes(self) -> slice:
        """The range of the copy's nodes among the body's."""
        count = self.body.world_node_count
        return slice(self.index * count, (self.index + 1) * count)

    @property
    def elements(self) -> slice:
        """The range of the copy's elements among the body's."""
        count = self.body.world_element_count
        return slice(self.index * count, (self.index + 1) * count)

    @property
    def positions(self) -> wp.array:
        """As ``SoftBody.positions`` [m], vec3 [N] of one copy."""
        return self._own(self.body.positions)

    @property
    def displacements(self) -> wp.array:
        """As ``SoftBody.displacements`` [m], vec3 [N] of one copy: a copy of the values, not a view."""
        return self._own(self.body.displacements)

    @property
    def velocities(self) -> wp.array:
        """As ``SoftBody.velocities`` [m/s], vec3 [N] of one copy."""
        return self._own(self.body.velocities)

    @property
    def reactions(self) -> wp.array:
        """As ``SoftBody.reactions`` [N], vec3 [N] of one copy."""
        return self._own(self.body.reactions)

    @property
    def loads(self) -> wp.array:
        """As ``SoftBody.loads`` [N], vec3 [N] of one copy."""
        return self._own(self.body.loads)

    def _own(self, array: wp.array) -> wp.array:
        return array if self.body.worlds == 1 else array[self.nodes]


def _check_made_of(mesh: Any, material: Any) -> None:
    """Check the types of a body's mesh and material.

    Raises:
        InputError: One of them has another type.
    """
    if not isinstance(mesh, Mesh):
        cure = "TetMesh(points, tets) makes one of arrays"
        if isinstance(mesh, str | PathLike):
            cure = f"TetMesh.load({str(mesh)!r}) reads tetrahedra, Domain.from_surface({str(mesh)!r}) a surface"
        raise InputError(f"mesh is {shown(mesh)}; it must be a TetForest or a TetMesh: {cure}")
    if not isinstance(material, Material):
        young = f"{material!r}" if isinstance(material, int | float) else "5e3"
        cure = f"Isotropic(young={young}, poisson=0.45, density=1000.0)"
        raise InputError(f"material is {shown(material)}; it must be a material, for example {cure}")
