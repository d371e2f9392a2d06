"""A body's material as its elements carry it through passes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.changing.plan import DevicePlan
from warp_corot.discretization.changing.pools import DeviceForest
from warp_corot.discretization.changing.transfer import Column, Numbers
from warp_corot.kernels.corotated.anisotropic import OrthotropicMaterial, vec9
from warp_corot.kernels.remesh.anisotropic import assemble_materials
from warp_corot.kernels.remesh.state import FIRST, MEAN_IF_ALIKE, MEAN_OF_CONTENTS, NO_ROW
from warp_corot.materials.anisotropic import FRAME_ENTRIES, STIFFNESS_ENTRIES, Anisotropic, constants_of
from warp_corot.materials.isotropic import Isotropic, Material

if TYPE_CHECKING:
    from warp_corot.discretization.discretization import Discretization

#: The active stress, and, of whole numbers, the row of keyframes that it follows.
ACTIVATION = "activation"
ACTIVATION_ROW = "activation_row"


def carried_material(former: Discretization) -> CarriedMaterial:
    """What the body's elements are to carry of its material."""
    return (CarriedAnisotropic if isinstance(former.material, Anisotropic) else CarriedMaterial)(former)


class CarriedMaterial:
    """What of an isotropic material varies from element to element.

    Attributes:
        given: The material that the body began with.
        values: What elements carry, by name, [T] each: Lamé's parameters times the filled share, and without it. Of the
            latter a parent has the mean that counts by what its children hold.
    """

    def __init__(self, former: Discretization):
        self.given: Any = former.material
        self.values: dict[str, npt.NDArray[np.floating] | Column | Numbers] = {}
        if former.material_stride:
            self.values = {"mu": former.mu.numpy(), "lam": former.lam.numpy()}
        if former.lame[2] and former.fill is not None:
            own = (Column(array.numpy(), int(MEAN_OF_CONTENTS)) for array in former.lame[:2])
            self.values |= dict(zip(("own_mu", "own_lam"), own, strict=True))
        self._lame = ("own_mu", "own_lam") if "own_mu" in self.values else ("mu", "lam") if former.lame[2] else ()
        #: Lamé's parameters of the material itself [Pa], or what elements carry them as.
        self.lame: Any = self._lame or tuple(float(array.numpy()[0]) for array in former.lame[:2])
        #: 2 mu + lambda [Pa] of all elements if they are alike, else 0.
        self.modulus = 0.0 if self.values else float(2.0 * former.mu.numpy()[0] + former.lam.numpy()[0])

    def density(self, count: int) -> npt.NDArray[np.float64]:
        """Mass per rest volume of what elements hold [kg/m^3], [count]."""
        return np.broadcast_to(self.given.density, (1, count))[0]

    def lame_of(self, plan: DevicePlan) -> tuple[wp.array, wp.array, int] | None:
        """Lamé's parameters of the present elements and their stride, if they vary."""
        if not self._lame:
            return None
        mu, lam = (plan.values[name] for name in self._lame)
        return mu, lam, 1

    def serve(self, plan: DevicePlan, lame: tuple[wp.array, wp.array, int]) -> None:
        """Have ``derive`` write what the present elements carry.

        Args:
            plan: Of these elements.
            lame: Their Lamé parameters.
        """

    def derive(self, plan: DevicePlan) -> None:
        """Launch what writes the material that kernels read, if the plan has just been derived; may be recorded."""

    @property
    def anisotropic(self) -> OrthotropicMaterial:
        """The material of leaves and of padding as kernels read it, if it is anisotropic."""
        raise TypeError(f"the material is {type(self.given).__name__}, which is not anisotropic")

    def present(self, forest: DeviceForest) -> Material:
        """The material of the present elements."""
        density = self._present_density(forest)
        if not self._lame:
            return Isotropic(self.given.young, self.given.poisson, density)
        mu, lam = _of_leaves(forest, self._lame).T
        return Isotropic(mu * (3.0 * lam + 2.0 * mu) / (lam + mu), 0.5 * lam / (lam + mu), density)

    def _present_density(self, forest: DeviceForest) -> Any:
        if not np.ndim(self.given.density):
            return self.given.density
        fill = _of_leaves(forest, ("fill",))[:, 0] if "fill" in forest.carriage.names else 1.0
        return forest.carriage.arrays.density.numpy()[forest.leaf_elements] / fill


class CarriedAnisotropic(CarriedMaterial):
    """What of an anisotropic material varies from element to element, and active stress.

    Beside the nearest isotropic material elements carry axes, stiffness in these, active stress and the row of
    keyframes that it follows. Children have all their parent's. A parent has its first child's axes and row; its
    stiffness is the mean of both children's, counted by what they hold, and so is its active stress if both follow the
    same row or none; otherwise that is the first child's.
    """

    def __init__(self, former: Discretization):
        super().__init__(former)
        count = len(former.mesh.tets)
        stiffness, frames = self.given.stiffness(), self.given.frames()
        self._stiffness_varies = stiffness.size > 9
        self._axes_vary = frames.size > 9
        if self._stiffness_varies:
            self.values |= _columns(STIFFNESS_ENTRIES, stiffness, count, int(MEAN_OF_CONTENTS))
        if self._axes_vary:
            self.values |= _columns(FRAME_ENTRIES, frames, count, int(FIRST))
        active = former.activation.numpy() if former.has_activation else 0.0
        self.values[ACTIVATION] = Column(active, int(MEAN_IF_ALIKE))
        self.values[ACTIVATION_ROW] = Numbers(int(NO_ROW))
        self._anisotropic = former.anisotropic_material()

    @property
    def anisotropic(self) -> OrthotropicMaterial:
        return self._anisotropic

    def serve(self, plan: DevicePlan, lame: tuple[wp.array, wp.array, int]) -> None:
        given, material, count = self._anisotropic, OrthotropicMaterial(), plan.counts.most
        material.assign(given)
        material.mu, material.lam, material.stride = lame
        if given.axes_stride:
            material.axes = wp.array(np.tile(np.eye(3), (count, 1, 1)), dtype=wp.mat33, device=plan.forest.device)
        if given.stride:
            material.stiffness = wp.zeros(count, dtype=vec9, device=plan.forest.device)
        if "fill" in plan.values:
            material.fill = plan.values["fill"]
        self._anisotropic = material

    def derive(self, plan: DevicePlan) -> None:
        rows = [plan.values_row(names[0]) for names in (FRAME_ENTRIES, STIFFNESS_ENTRIES)]
        if max(rows) >= 0:
            forest, material = plan.forest, self._anisotropic
            inputs = [forest.threads, forest.pools, plan.arrays, *rows]
            outputs = [material.axes, material.stiffness]
            wp.launch(assemble_materials, forest.threads, inputs=inputs, outputs=outputs, device=forest.device)

    def present(self, forest: DeviceForest) -> Material:
        changed: dict[str, Any] = {"density": self._present_density(forest)}
        if self._stiffness_varies:
            changed |= self.given.fields_of(constants_of(_of_leaves(forest, STIFFNESS_ENTRIES)))
        if self._axes_vary:
            changed |= self.given.directions_of(_of_leaves(forest, FRAME_ENTRIES).reshape(-1, 3, 3))
        return replace(self.given, **changed)


def _columns(
    names: Sequence[str], values: npt.NDArray[np.float64], count: int, merging: int
) -> dict[str, npt.NDArray[np.floating] | Column | Numbers]:
    """Columns of values [count, …], a number each."""
    table = values.reshape(count, len(names))
    return {name: Column(column, merging) for name, column in zip(names, table.T, strict=True)}


def _of_leaves(forest: DeviceForest, names: Sequence[str]) -> npt.NDArray[np.float64]:
    """What the present leaves carry in some columns, [T, names]."""
    chosen = [forest.carriage.names.index(name) for name in names]
    return forest.carriage.arrays.values.numpy()[forest.leaf_elements][:, chosen].astype(np.float64)
