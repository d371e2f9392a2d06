"""A soft body: a mesh, a material and the state of its nodes on a device."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import warp as wp

from .checks import check_float32
from .device import checked_device
from .elements import Mesh, device_elements, element_kind, parts
from .errors import InputError
from .indices import checked_indices
from .kernels.integrate import adopt_positions, publish_positions
from .materials import Isotropic
from .trajectory import Trajectory


class SoftBody:
    """The state of one body: displacements, velocities, masses, constraints and loads of its nodes.

    Nodal vectors live in 16-byte vec4 arrays, the fourth lane unused, so that a node is one load and, where the card
    can, one reduction. The state proper is the displacement from rest, which keeps the digits of small strains: the
    static end of a linear beam comes out to 1e-6 of its deflection, from float32 positions to 4e-6 with the beam at the
    origin and to 3e-5 with it one metre away. ``positions`` are published after each run of steps, and positions that
    you write are taken over before the next.

    Args:
        mesh: A ``TetForest`` or ``TetMesh``.
        material: Uniform, or with one value per element.
        device: "cpu", "cuda:0", …; None for Warp's default.

    Attributes:
        mesh, material, device: As given.
        masses: Lumped nodal masses [kg], float64 [N]; zero at nodes that no element names.

    Raises:
        InputError: The device is not there, a material array does not have one value per element, or stiffness, mass
            or size are beyond the range of float32.
    """

    def __init__(self, mesh: Mesh, material: Isotropic, *, device: str | wp.Device | None = None):
        self.mesh = mesh
        self.material = material
        self.device = checked_device(device)
        count = len(mesh.tets)
        for name in ("young", "poisson", "density"):
            values = np.asarray(getattr(material, name))
            if values.ndim and len(values) != count:
                raise InputError(f"{name} has {len(values)} entries; the mesh has {count} elements")
        check_float32(2.0 * material.mu + np.abs(material.lam), "the stiffness 2 mu + |lambda|", "Pa")
        check_float32(mesh.volumes, "the volume of an element", "m^3")
        self.element_kind = element_kind(mesh)
        self.elements = device_elements(mesh, self.device)
        self.mu, self.lam, self.material_stride = self._material_arrays()
        self.masses = lumped_masses(mesh, material)
        check_float32(self.masses[self.masses > 0], "the mass of a node", "kg")

        n = len(mesh.points)
        self.node_rest = wp.array(_padded(mesh.points), dtype=wp.vec4, device=self.device)
        self.node_positions = wp.clone(self.node_rest)
        self.node_displacements = wp.zeros(n, dtype=wp.vec4, device=self.device)
        self.node_velocities = wp.zeros(n, dtype=wp.vec4, device=self.device)
        self.node_forces = wp.zeros(n, dtype=wp.vec4, device=self.device)
        self.node_reactions = wp.zeros(n, dtype=wp.vec4, device=self.device)
        self.node_loads = wp.zeros(1, dtype=wp.vec4, device=self.device)
        self.node_mass = wp.array(self.masses, dtype=wp.float32, device=self.device)
        self.node_inverse_mass = wp.empty(n, dtype=wp.float32, device=self.device)
        self.trajectories: list[Trajectory] = []
        #: Changes whenever the launches of a step do, so that recorded steps can be recorded anew.
        self.revision = 0
        self._constrained = np.zeros(n, bool)
        self._update_inverse_mass()

    # --- state -----------------------------------------------------------------------------------------------------

    @property
    def node_count(self) -> int:
        return len(self.masses)

    @property
    def positions(self) -> wp.array:
        """Nodal positions [m], vec3 [N], in the mesh's order. A view of the live array: write to it between steps, or
        set the property, and the next step starts from there."""
        return vec3_view(self.node_positions)

    @positions.setter
    def positions(self, values: npt.ArrayLike) -> None:
        # In float64 and by way of the displacement, so that no digit of what is given is lost.
        self._set_displacements(self._checked_vectors(values, "positions") - self.mesh.points)

    @property
    def displacements(self) -> wp.array:
        """Nodal displacements from rest [m], vec3 [N]: a copy; set the property to change them."""
        self.adopt_positions()
        return wp.clone(vec3_view(self.node_displacements))

    @displacements.setter
    def displacements(self, values: npt.ArrayLike) -> None:
        self._set_displacements(self._checked_vectors(values, "displacements"))

    @property
    def velocities(self) -> wp.array:
        """Nodal velocities [m/s], vec3 [N]: a view of the live array."""
        return vec3_view(self.node_velocities)

    @velocities.setter
    def velocities(self, values: npt.ArrayLike) -> None:
        self.node_velocities.assign(_padded(self._checked_vectors(values, "velocities")))

    @property
    def reactions(self) -> wp.array:
        """Forces of the supports on fixed and prescribed nodes in the last step [N], vec3 [N]; zero elsewhere.

        A support carries its node's own weight too. Inertia of a prescribed node is not included.
        """
        return vec3_view(self.node_reactions)

    @property
    def loads(self) -> wp.array:
        """External nodal forces [N], vec3 [N]: a view of the live array, made on first use."""
        self._ensure_loads()
        return vec3_view(self.node_loads)

    def adopt_positions(self) -> None:
        """Take over positions that somebody wrote since they were last published."""
        self._launch(adopt_positions, [self.node_rest, self.node_positions], [self.node_displacements])

    def publish_positions(self) -> None:
        """Write positions from displacements."""
        self._launch(publish_positions, [self.node_rest, self.node_displacements], [self.node_positions])

    # --- constraints and loads -------------------------------------------------------------------------------------

    def fix(self, nodes: npt.ArrayLike) -> None:
        """Hold nodes where they are. Mask bool [N] or indices.

        Raises:
            InputError: Mask of the wrong length or index out of range.
        """
        chosen = self.node_indices(nodes)
        self._stop_following(chosen)
        self._constrain(chosen, np.zeros(3))

    def release(self, nodes: npt.ArrayLike) -> None:
        """Let fixed or prescribed nodes go, with the velocity they have."""
        chosen = self.node_indices(nodes)
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
    ) -> None:
        """Move nodes as told, whatever the forces: at a velocity, or along keyframes.

        Args:
            nodes: Mask bool [N] or indices [n].
            velocity: Constant velocity [m/s], [3] or [n, 3].
            times: Increasing times of keyframes [s], [K], at least two, in the time of the simulation.
            displacements: Displacements from rest at these times [m], [K, 3] for all nodes alike or [K, n, 3]; linear
                in between, constant before and after.

        Raises:
            InputError: Neither or both ways given, wrong shapes, times that do not increase, or non-finite values.
        """
        chosen = self.node_indices(nodes)
        if (velocity is None) == (times is None and displacements is None):
            raise InputError("prescribe takes either velocity, or times and displacements")
        if velocity is not None:
            values = np.asarray(velocity, dtype=np.float64)
            if values.shape not in ((3,), (len(chosen), 3)) or not np.isfinite(values).all():
                raise InputError(f"velocity has shape {values.shape}; it must be finite, [3] or [{len(chosen)}, 3]")
            self._stop_following(chosen)
            self._constrain(chosen, values)
            return
        trajectory = Trajectory.of_keys(chosen, times, displacements, self.device)
        self._stop_following(chosen)
        self._constrain(chosen, np.zeros(3))
        if len(chosen):
            self.trajectories.append(trajectory)
            self.revision += 1

    def load(self, nodes: npt.ArrayLike, force: npt.ArrayLike) -> None:
        """Set the external force on nodes, from the next step on.

        Args:
            nodes: Mask bool [N] or indices [n].
            force: Force on each node [N], [3] or [n, 3].

        Raises:
            InputError: Wrong shape or non-finite values.
        """
        chosen = self.node_indices(nodes)
        values = np.asarray(force, dtype=np.float64)
        if values.shape not in ((3,), (len(chosen), 3)) or not np.isfinite(values).all():
            raise InputError(f"force has shape {values.shape}; it must be finite, [3] or [{len(chosen)}, 3]")
        self._ensure_loads()
        loads = self.node_loads.numpy().copy()
        loads[chosen, :3] = values
        self.node_loads.assign(loads)

    @property
    def constrained(self) -> npt.NDArray[np.bool_]:
        """Which nodes are fixed or prescribed, bool [N] (a copy)."""
        return self._constrained.copy()

    @property
    def has_loads(self) -> bool:
        return len(self.node_loads) == self.node_count

    # --- pieces ----------------------------------------------------------------------------------------------------

    def node_indices(self, nodes: npt.ArrayLike) -> npt.NDArray[np.intp]:
        """Indices of the nodes that a mask or a list of indices names.

        Raises:
            InputError: Mask of the wrong length, index out of range, or neither.
        """
        return checked_indices(nodes, self.node_count, "node")

    def _material_arrays(self) -> tuple[wp.array, wp.array, int]:
        mu, lam = np.broadcast_arrays(np.atleast_1d(self.material.mu), np.atleast_1d(self.material.lam))
        stride = int(len(mu) > 1)
        return self._floats(mu), self._floats(lam), stride

    def _floats(self, values: np.ndarray) -> wp.array:
        return wp.array(np.ascontiguousarray(values), dtype=wp.float32, device=self.device)

    def _checked_vectors(self, values: npt.ArrayLike, name: str) -> npt.NDArray[np.float64]:
        given = np.asarray(values.numpy() if isinstance(values, wp.array) else values, dtype=np.float64)
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


def lumped_masses(mesh: Mesh, material: Isotropic) -> npt.NDArray[np.float64]:
    """A quarter of each element's mass at each of its nodes [kg], float64 [N]."""
    masses = np.zeros(len(mesh.points))
    density = np.broadcast_to(material.density, len(mesh.tets))
    for part in parts(len(mesh.tets)):
        quarter = mesh.volumes[part] * density[part] / 4.0
        np.add.at(masses, mesh.tets[part].ravel(), np.repeat(quarter, 4))
    return masses
