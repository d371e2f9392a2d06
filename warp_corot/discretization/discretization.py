"""The data of a body for forces: its mesh, which may change, and its material, on a device."""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol, cast

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.elements import (
    ElementKind,
    Elements,
    Mesh,
    device_elements,
    element_kind,
    parts,
    with_targets,
)
from warp_corot.discretization.levels import Levels
from warp_corot.discretization.plan import Awaited, Plan, Slots
from warp_corot.discretization.planner import ForcePlan, pays_in_groups, units_of
from warp_corot.discretization.sizes import Clock, Sizes
from warp_corot.errors import InputError
from warp_corot.inputs.checks import check_float32
from warp_corot.inputs.cpu_threads import Team, team_of
from warp_corot.kernels.corotated.anisotropic import OrthotropicMaterial, vec9
from warp_corot.materials.anisotropic import Directional
from warp_corot.materials.isotropic import Material
from warp_corot.mesh import TetForest

if TYPE_CHECKING:
    from warp_corot.discretization.changing.pools import DeviceForest


#: Elements, and with them nodes, are numbered in 32 bits.
MOST_ELEMENTS = 2**31 - 1


class Discretization(ABC):
    """A mesh on a device, with its material: all data of a body that forces read, except the positions of its nodes.

    Attributes:
        worlds, device: The number of copies of the body, and their device.
        sizes: Numbers of nodes and elements.
        element_kind: The struct of the elements, ``ForestElements`` or ``GeneralElements``.
        elements: The elements, world after world.
        fill: The fraction of each element inside the body, [T] in the original mesh; None: all of it.
        lame: Lamé's parameters of the material [Pa], and their stride, 0 or 1: for stresses.
        mu, lam, material_stride: The same, multiplied by the filled fraction: for forces and energies.
        activation: Active stress of elements [Pa], float32; one entry until a stress is set.
        has_activation: Whether an active stress was set.
        smallest_volume: The volume of the smallest element [m^3].
        team: The threads of the CPU that compute forces; one on CUDA and for a mesh that changes.
        is_uniform: Whether all elements of a world have the same elastic constants and are filled.
        is_anisotropic: Whether the material has directions.
        awaited: Nodes that other processes move, if some wait for them; else None.
        sums_by_subtrees: Whether deterministic forces are summed subtree by subtree, never in groups of subtrees
            (CUDA), so that they are the same bits in a part of the mesh.
    """

    worlds: int
    device: wp.Device
    sizes: Sizes
    element_kind: ElementKind
    elements: Elements
    fill: npt.NDArray[np.float64] | None
    lame: tuple[wp.array, wp.array, int]
    mu: wp.array
    lam: wp.array
    material_stride: int
    activation: wp.array
    has_activation: bool
    smallest_volume: float
    team: Team
    is_uniform: bool
    is_anisotropic: bool
    awaited: Awaited | None = None
    sums_by_subtrees: bool = False
    _levels: Levels | None = None

    @property
    @abstractmethod
    def mesh(self) -> Mesh:
        """The present mesh."""

    @property
    @abstractmethod
    def material(self) -> Any:
        """The material of the present elements, with values in place of functions."""

    @property
    @abstractmethod
    def masses(self) -> npt.NDArray[np.float64]:
        """Lumped nodal masses [kg], float64 [worlds * N]; zero at nodes of no element."""

    @property
    @abstractmethod
    def prefers_subtrees(self) -> bool:
        """Whether launches of subtrees are faster on CUDA than launches of single elements."""

    @abstractmethod
    def plan(self, rotation_level: int | None = None, *, subtrees: bool = True, deterministic: bool = False) -> Plan:
        """The units of work of a force field.

        If the mesh changes, ``ForceField.derive`` and ``follow`` update the field.

        Args:
            rotation_level: Level of the tree at which rotations are shared; None: not shared.
            subtrees: Whether complete subtrees are units; False: the field computes leaf by leaf.
            deterministic: Whether every unit has separate slots for its forces.
        """

    def levels(self) -> Levels:
        """The nodes of the present mesh by tree level, and transfers between levels; found at the first call.

        Raises:
            InputError: The mesh is a general one, which has no tree.
        """
        if self._levels is None or self._levels.version != self.sizes.version:
            self._levels = Levels(*self._tree_nodes(), self.sizes, self.device)
        return self._levels

    @abstractmethod
    def _tree_nodes(self) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32], int]:
        """The lattice points, ends, and first node of no leaf that ``Levels`` takes."""

    @abstractmethod
    def anisotropic_material(self) -> OrthotropicMaterial:
        """The anisotropic material for kernels, world after world if it is not uniform."""

    def make_activation(self) -> bool:
        """Make an active stress for every element if there is none; return whether there was none."""
        if self.has_activation:
            return False
        if len(self.activation) < self.sizes.elements:
            self.activation = wp.zeros(self.sizes.elements, dtype=wp.float32, device=self.device)
        self.has_activation = True
        return True


class MeshChanges(Protocol):
    """The owner of a changing mesh, for calls by the body; arrays have the present nodes."""

    @property
    def forest(self) -> DeviceForest:
        """The mesh on the device."""

    @property
    def is_cut(self) -> bool:
        """Whether the body can be cut."""

    @property
    def cut_area(self) -> float:
        """The area of all cuts so far, at rest [m^2]."""

    def remember(self) -> None:
        """Save the present mesh and state for ``reset``."""

    def reset(self, chosen: wp.array, clock: Clock) -> None:
        """Return to the saved state, if the world is chosen, int32 [1]."""

    def restore(self) -> None:
        """Return to the saved state, but leave the time at which motions begin."""


class Discretized(Protocol):
    """Something that has a discretization, as a body does."""

    @property
    def discretization(self) -> Discretization: ...


def discretization_of(body: Discretized | Discretization) -> Discretization:
    """The discretization of a body, or the given discretization itself."""
    return body if isinstance(body, Discretization) else body.discretization


class FixedMesh(Discretization):
    """A mesh that never changes.

    Args:
        mesh: The mesh.
        material: The material; functions of the rest position are evaluated at the elements' centroids.
        worlds: Number of copies of the body.
        device: The device.

    Raises:
        InputError: There are too many elements, a material array has the wrong shape, or float32 cannot hold a value.
    """

    def __init__(self, mesh: Mesh, material: Material, worlds: int, device: wp.Device):
        given = material.at(centroids(mesh)) if material.functions else material
        count = worlds * len(mesh.tets)
        if count > MOST_ELEMENTS:
            raise InputError(f"worlds is {worlds}: that is {count} elements; there can be {MOST_ELEMENTS} at most")
        given.check_shapes(worlds, len(mesh.tets))
        isotropic = given.isotropic
        check_float32(2.0 * isotropic.mu + np.abs(isotropic.lam), "the stiffness 2 mu + |lambda|", "Pa")
        check_float32(mesh.volumes, "the volume of an element", "m^3")
        self._material: Any = given
        self._fill_in(mesh, isotropic.mu, isotropic.lam, worlds, device)
        self._masses = lumped_masses(mesh, given, worlds)
        check_float32(self._masses[self._masses > 0], "the mass of a node", "kg")

    @classmethod
    def of_lame(cls, mesh: Mesh, mu: npt.ArrayLike, lam: npt.ArrayLike, worlds: int, device: wp.Device) -> FixedMesh:
        """A mesh with Lamé's parameters [Pa] in place of a material, numbers or [worlds, T]; forces need no more."""
        made = cls.__new__(cls)
        made._material = None
        made._fill_in(mesh, mu, lam, worlds, device)
        return made

    def _fill_in(self, mesh: Mesh, mu: npt.ArrayLike, lam: npt.ArrayLike, worlds: int, device: wp.Device) -> None:
        self._mesh, self.worlds, self.device, self.team = mesh, worlds, device, team_of(1)
        self.is_anisotropic = isinstance(self._material, Directional)
        self.sizes = Sizes.of(worlds, len(mesh.points), len(mesh.tets))
        self.smallest_volume = float(np.min(mesh.volumes))
        self.element_kind = element_kind(mesh)
        self.elements = device_elements(mesh, device, worlds)
        self.fill = getattr(mesh, "fill", None)
        self.is_uniform = self.fill is None and all(np.ndim(a) == 0 or np.shape(a)[-1] == 1 for a in (mu, lam))
        self.lame = self._lame_arrays(mu, lam, None)
        self.mu, self.lam, self.material_stride = self._lame_arrays(mu, lam, self.fill)
        self.activation, self.has_activation = wp.zeros(1, dtype=wp.float32, device=device), False

    @property
    def mesh(self) -> Mesh:
        return self._mesh

    @property
    def material(self) -> Any:
        return self._material

    @property
    def masses(self) -> npt.NDArray[np.float64]:
        return self._masses

    @property
    def prefers_subtrees(self) -> bool:
        return isinstance(self._mesh, TetForest) and pays_in_groups(self._mesh, self.elements, self.worlds)

    def plan(
        self, rotation_level: int | None = None, *, subtrees: bool = True, deterministic: bool = False
    ) -> ForcePlan:
        mesh, elements, device, worlds = self._mesh, self.elements, self.device, self.worlds
        if isinstance(mesh, TetForest) and subtrees:
            # Parts have all of a subtree's leaves, but not all subtrees of a group.
            grouped = False if deterministic and self.sums_by_subtrees else None
            return ForcePlan.of_forest(
                mesh,
                rotation_level,
                device,
                worlds=worlds,
                elements=elements,
                grouped=grouped,
                deterministic=deterministic,
            )
        slots = find_units = None
        if isinstance(mesh, TetForest) and rotation_level is not None:
            find_units = partial(units_of, mesh, elements, rotation_level, worlds)
        if deterministic:
            slots, targets = Slots.of_units(mesh.tets, len(mesh.points), device, worlds)
            elements = with_targets(elements, wp.array(targets, dtype=wp.vec4i, device=device))
        return ForcePlan.leaf_by_leaf(elements, slots, find_units)

    def _tree_nodes(self) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32], int]:
        mesh = self._mesh
        if not isinstance(mesh, TetForest):
            raise InputError(f"only a TetForest has levels; this mesh is a {type(mesh).__name__}, which has no tree")
        return mesh.lattice, mesh.node_ends, mesh.node_count

    def anisotropic_material(self) -> OrthotropicMaterial:
        given, fill = self._material, self.fill
        assert isinstance(given, Directional)
        stiffness = given.entries()
        check_float32(np.abs(stiffness[..., list(given.positive)]).ravel(), "the stiffness", "Pa")
        material = OrthotropicMaterial()
        material.axes, material.axes_stride = self._of_elements(given.frames(), 2, wp.mat33)
        material.stiffness, material.stride = self._of_elements(stiffness, 1, vec9)
        material.mu, material.lam, _stride = self.lame
        material.fill, material.fill_stride = self._of_elements(np.ones(()) if fill is None else fill, 0, wp.float32)
        return material

    def _of_elements(self, values: npt.NDArray[np.float64], rank: int, dtype: type) -> tuple[wp.array, int]:
        """One value, or one for each element of each world; and their stride."""
        head, tail = values.shape[: values.ndim - rank], values.shape[values.ndim - rank :]
        if np.prod(head, dtype=int) == 1:
            return wp.array(values.reshape(1, *tail), dtype=dtype, device=self.device), 0
        shape = (self.worlds, len(self._mesh.tets), *tail)
        everywhere = np.broadcast_to(values, shape).astype(np.float32)
        return wp.array(everywhere.reshape(-1, *tail), dtype=dtype, device=self.device), 1

    def _lame_arrays(
        self, mu: npt.ArrayLike, lam: npt.ArrayLike, fill: npt.NDArray[np.float64] | None
    ) -> tuple[wp.array, wp.array, int]:
        mu, lam = np.broadcast_arrays(np.atleast_1d(mu), np.atleast_1d(lam))
        stride = int(fill is not None or mu.size > 1)
        if stride:
            shape = (self.worlds, len(self._mesh.tets))
            mu, lam = (np.broadcast_to(a, shape) * (1.0 if fill is None else fill) for a in (mu, lam))
        made = (np.ascontiguousarray(a.ravel()) for a in (mu, lam))
        on_device = (wp.array(a, dtype=wp.float32, device=self.device) for a in made)
        return *on_device, stride


def centroids(mesh: Mesh) -> npt.NDArray[np.float64]:
    """Centroids of the elements [m], float64 [T, 3]."""
    found = np.empty((len(mesh.tets), 3))
    for part in parts(len(mesh.tets)):
        found[part] = mesh.points[mesh.tets[part]].mean(axis=1)
    return found


def lumped_masses(mesh: Mesh, material: Material, worlds: int = 1) -> npt.NDArray[np.float64]:
    """Nodal masses: a quarter of each element's mass at each of its nodes [kg], float64 [worlds * N]."""
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


# --- without resistance to changes of volume -------------------------------------------------------------------------
#
# A discretization whose elements do not resist changes of volume: a law's forces without the terms in lambda.


def deviatoric(whole: Discretization) -> Discretization:
    """A discretization with zero in place of lambda; all other data are those of ``whole`` and follow its changes."""
    return cast("Discretization", _Deviatoric(whole))


class _Deviatoric:
    def __init__(self, whole: Discretization):
        self._whole, self._zeros = whole, (whole.lam, wp.zeros_like(whole.lam))

    def __getattr__(self, name: str) -> Any:
        return getattr(self.__dict__["_whole"], name)

    @property
    def discretization(self) -> _Deviatoric:
        return self

    @property
    def lam(self) -> wp.array:
        if self._zeros[0] is not self._whole.lam:
            self._zeros = self._whole.lam, wp.zeros_like(self._whole.lam)
        return self._zeros[1]
