"""What force fields ask of a body's mesh: they need not know whether it stays as it is or changes."""

from __future__ import annotations

from functools import partial
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.inputs.checks import check_float32
from warp_corot.kernels.corotated.anisotropic import OrthotropicMaterial, vec9
from warp_corot.materials.anisotropic import Anisotropic
from warp_corot.materials.isotropic import Material
from warp_corot.mesh import TetForest

from .clock import Clock
from .elements import Mesh, in_worlds, with_targets
from .plan import ForcePlan, Plan, Units
from .slots import Slots
from .subtrees import pays_in_groups


class Discretization(Protocol):
    """A mesh on the device, with its material."""

    @property
    def prefers_subtrees(self) -> bool:
        """Whether launches of subtrees are faster on CUDA than launches of single elements."""
        ...

    def plan(self, rotation_level: int | None = None, *, subtrees: bool = True, deterministic: bool = False) -> Plan:
        """What a force field goes through.

        Where the mesh changes, the field is told by ``ForceField.derive`` and ``follow``.

        Args:
            rotation_level: Level of the tree at which rotations are shared; None: not shared.
            subtrees: Whether complete subtrees go as units; False: the field goes leaf by leaf.
            deterministic: Whether every unit has slots of its own for its forces.
        """
        ...

    def anisotropic_material(self) -> OrthotropicMaterial:
        """The anisotropic material as kernels read it, world after world where it is not uniform."""
        ...


class MeshChanges(Protocol):
    """What changes the mesh of a body, as the body calls it; arrays are of the present nodes."""

    def mesh(self) -> TetForest:
        """The present mesh."""
        ...

    def material(self) -> Material:
        """The material of the present elements."""
        ...

    def masses(self) -> npt.NDArray[np.float64]:
        """Lumped nodal masses [kg], float64 [N]."""
        ...

    def remember(self) -> None:
        """Make the present mesh and state what ``reset`` goes back to."""
        ...

    def reset(self, chosen: wp.array, clock: Clock) -> None:
        """Go back to that, if the world is chosen; int32 [1]."""
        ...


class FixedMesh:
    """The ``Discretization`` of a mesh that stays as it is.

    Args:
        mesh: The mesh.
        elements: Its elements on the device, world after world.
        worlds: How many copies of the body there are.
        material: The body's material, with values in place of functions.
        lame: Lamé's parameters [Pa] of the nearest isotropic material, and their stride.
    """

    def __init__(self, mesh: Mesh, elements: Any, worlds: int, material: Any, lame: tuple[wp.array, wp.array, int]):
        self._mesh, self._elements, self._worlds = mesh, elements, worlds
        self._material, self._lame = material, lame
        self._device = elements.nodes.device

    @property
    def prefers_subtrees(self) -> bool:
        return isinstance(self._mesh, TetForest) and pays_in_groups(self._mesh, self._worlds)

    def plan(
        self, rotation_level: int | None = None, *, subtrees: bool = True, deterministic: bool = False
    ) -> ForcePlan:
        mesh, elements, device, worlds = self._mesh, self._elements, self._device, self._worlds
        if isinstance(mesh, TetForest) and subtrees:
            return ForcePlan.of_forest(
                mesh, rotation_level, device, worlds=worlds, elements=elements, deterministic=deterministic
            )
        slots = find_units = None
        if deterministic:
            slots, (targets,) = Slots.of_units([mesh.tets], len(mesh.points), device, worlds)
            elements = with_targets(elements, in_worlds(targets, worlds, slots.per_world))
        if isinstance(mesh, TetForest) and rotation_level is not None:
            find_units = partial(Units.of_forest, mesh, rotation_level, device, worlds)
        return ForcePlan.leaf_by_leaf(elements, slots, find_units)

    def anisotropic_material(self) -> OrthotropicMaterial:
        given, fill = self._material, getattr(self._mesh, "fill", None)
        assert isinstance(given, Anisotropic)
        stiffness = given.stiffness()
        check_float32(np.abs(stiffness[..., [0, 1, 2, 6, 7, 8]]).ravel(), "the stiffness", "Pa")
        material = OrthotropicMaterial()
        material.axes, material.axes_stride = self._of_elements(given.frames(), 2, wp.mat33)
        material.stiffness, material.stride = self._of_elements(stiffness, 1, vec9)
        material.mu, material.lam, _stride = self._lame
        material.fill, material.fill_stride = self._of_elements(np.ones(()) if fill is None else fill, 0, wp.float32)
        return material

    def _of_elements(self, values: npt.NDArray[np.float64], rank: int, dtype: type) -> tuple[wp.array, int]:
        """One value, or one for each element of each world; and the stride by which to go through them."""
        head, tail = values.shape[: values.ndim - rank], values.shape[values.ndim - rank :]
        if np.prod(head, dtype=int) == 1:
            return wp.array(values.reshape(1, *tail), dtype=dtype, device=self._device), 0
        shape = (self._worlds, len(self._mesh.tets), *tail)
        everywhere = np.broadcast_to(values, shape).astype(np.float32)
        return wp.array(everywhere.reshape(-1, *tail), dtype=dtype, device=self._device), 1
