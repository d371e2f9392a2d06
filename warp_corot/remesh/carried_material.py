"""A forest that changes, as force fields see it: the material and the active stress that its elements carry."""

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
from warp_corot.discretization.discretization import Discretization
from warp_corot.discretization.elements import copied
from warp_corot.inputs.cpu_threads import team_of
from warp_corot.kernels.corotated.anisotropic import OrthotropicMaterial, vec9
from warp_corot.kernels.remesh.derived import assemble_materials
from warp_corot.kernels.remesh.pools import FIRST, MEAN_IF_ALIKE, MEAN_OF_CONTENTS, NO_ROW
from warp_corot.materials.anisotropic import FRAME_ENTRIES, STIFFNESS_ENTRIES, Directional
from warp_corot.materials.isotropic import Isotropic, Material
from warp_corot.mesh import TetForest

if TYPE_CHECKING:
    from warp_corot.discretization.discretization import Discretization

#: The active stress, and, as a whole number, the row of keyframes that it follows.
ACTIVATION = "activation"
ACTIVATION_ROW = "activation_row"


def carried_material(former: Discretization) -> CarriedMaterial:
    """The material data that the body's elements carry."""
    return (CarriedAnisotropic if isinstance(former.material, Directional) else CarriedMaterial)(former)


class CarriedMaterial:
    """Fields of an isotropic material that vary from element to element.

    Attributes:
        given: The body's initial material.
        values: Values that elements carry, by name, [T] each: Lamé's parameters with and without the factor of the
            filled fraction. For the latter a parent has the mean weighted by what its children hold.
    """

    def __init__(self, former: Discretization):
        self.given: Any = former.material
        self.values: dict[str, npt.NDArray[np.floating] | Column | Numbers] = {}
        if former.material_stride:
            self.values = {"mu": former.mu.numpy(), "lam": former.lam.numpy()}
        if former.lame[2] and former.fill is not None:
            own = (Column(array.numpy(), int(MEAN_OF_CONTENTS)) for array in former.lame[:2])
            self.values |= dict(zip(("own_mu", "own_lam"), own, strict=True))
        tough = np.ravel(self.given.isotropic.toughness)
        self._is_tough_alike = len(tough) == 1
        #: Energy of a cut [J/m^2], unless elements carry it.
        self.toughness = float(tough[0]) if self._is_tough_alike else 0.0
        if not self._is_tough_alike:
            self.values["toughness"] = tough
        self._lame = ("own_mu", "own_lam") if "own_mu" in self.values else ("mu", "lam") if former.lame[2] else ()
        #: Lamé's parameters of the material itself [Pa], or the names under which elements carry them.
        self.lame: Any = self._lame or tuple(float(array.numpy()[0]) for array in former.lame[:2])
        #: 2 mu + lambda [Pa] of all elements if they are equal, else 0.
        self.modulus = 0.0 if self.values else float(2.0 * former.mu.numpy()[0] + former.lam.numpy()[0])

    def density(self, count: int) -> npt.NDArray[np.float64]:
        """Mass per rest volume of the filled part of elements [kg/m^3], [count]."""
        return np.broadcast_to(self.given.density, (1, count))[0]

    def lame_of(self, plan: DevicePlan) -> tuple[wp.array, wp.array, int] | None:
        """Lamé's parameters of the current elements and their stride, if they vary."""
        if not self._lame:
            return None
        mu, lam = (plan.values[name] for name in self._lame)
        return mu, lam, 1

    def serve(self, plan: DevicePlan, lame: tuple[wp.array, wp.array, int]) -> None:
        """Let ``derive`` write the material of the current elements.

        Args:
            plan: The plan of these elements.
            lame: Their Lamé parameters.
        """

    def derive(self, plan: DevicePlan) -> None:
        """Launch the kernels that write the material for forces, if the plan was just derived; may be recorded."""

    @property
    def anisotropic(self) -> OrthotropicMaterial:
        """The material of leaves and padding as kernels read it, if it is anisotropic."""
        raise TypeError(f"the material is {type(self.given).__name__}, which is not anisotropic")

    def present(self, forest: DeviceForest) -> Material:
        """The material of the current elements."""
        density = self._present_density(forest)
        tough = self._present_toughness(forest)
        if not self._lame:
            return Isotropic(self.given.young, self.given.poisson, density, tough)
        mu, lam = _of_leaves(forest, self._lame).T
        return Isotropic(mu * (3.0 * lam + 2.0 * mu) / (lam + mu), 0.5 * lam / (lam + mu), density, tough)

    def _present_toughness(self, forest: DeviceForest) -> Any:
        return self.given.toughness if self._is_tough_alike else _of_leaves(forest, ("toughness",))[:, 0]

    def _present_density(self, forest: DeviceForest) -> Any:
        if not np.ndim(self.given.density):
            return self.given.density
        fill = _of_leaves(forest, ("fill",))[:, 0] if "fill" in forest.carriage.names else 1.0
        return forest.carriage.arrays.density.numpy()[forest.leaf_elements] / fill


class CarriedAnisotropic(CarriedMaterial):
    """Fields of an anisotropic material that vary from element to element, and active stress.

    Besides the nearest isotropic material, elements carry axes, stiffness in these axes, active stress and the row of
    keyframes that it follows. Children have the values of their parent. A parent has its first child's axes and row;
    its stiffness is the mean of both children's, weighted by what they hold, and so is its active stress if both follow
    the same row or none; otherwise it has the active stress of the first child.
    """

    def __init__(self, former: Discretization):
        super().__init__(former)
        count = len(former.mesh.tets)
        stiffness, frames = self.given.entries(), self.given.frames()
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
        given, count = self._anisotropic, plan.counts.most
        material = copied(given)
        material.mu, material.lam = lame[:2]
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
        changed["toughness"] = self._present_toughness(forest)
        if self._stiffness_varies:
            changed |= self.given.fields_of_entries(_of_leaves(forest, STIFFNESS_ENTRIES))
        if self._axes_vary:
            changed |= self.given.directions_of(_of_leaves(forest, FRAME_ENTRIES).reshape(-1, 3, 3))
        return replace(self.given, **changed)


def _columns(
    names: Sequence[str], values: npt.NDArray[np.float64], count: int, merging: int
) -> dict[str, npt.NDArray[np.floating] | Column | Numbers]:
    """Columns of values [count, …], one number each."""
    table = values.reshape(count, len(names))
    return {name: Column(column, merging) for name, column in zip(names, table.T, strict=True)}


def _of_leaves(forest: DeviceForest, names: Sequence[str]) -> npt.NDArray[np.float64]:
    """Columns that the current leaves carry, [T, names]."""
    chosen = [forest.carriage.names.index(name) for name in names]
    return forest.carriage.arrays.values.numpy()[forest.leaf_elements][:, chosen].astype(np.float64)


class ChangingMesh(Discretization):
    """A forest that changes.

    Args:
        former: The discretization before the first change.
        forest: The pools.
        carried: The material data that elements carry.

    Attributes:
        kept: The plan that is kept up to date: the first one requested. Other plans describe the mesh when they are
            made.
    """

    def __init__(self, former: Discretization, forest: DeviceForest, carried: CarriedMaterial):
        self._forest, self._carried = forest, carried
        self.worlds, self.device, self.sizes = former.worlds, former.device, former.sizes
        self.team = team_of(1)
        self.element_kind, self.elements, self.fill = former.element_kind, former.elements, former.fill
        self.lame, self.mu, self.lam, self.material_stride = former.lame, former.mu, former.lam, former.material_stride
        self.activation, self.has_activation = former.activation, former.has_activation
        self.smallest_volume = former.smallest_volume
        self.is_uniform, self.is_anisotropic = former.is_uniform, former.is_anisotropic
        self.kept: DevicePlan | None = None
        #: The host's data of the current mesh, by name.
        self._known: dict[str, Any] = {}

    @property
    def mesh(self) -> TetForest:
        if "mesh" not in self._known:
            self._known["mesh"] = self._forest.to_forest()
        return self._known["mesh"]

    @property
    def material(self) -> Any:
        if "material" not in self._known:
            self._known["material"] = self._carried.present(self._forest)
        return self._known["material"]

    @property
    def masses(self) -> npt.NDArray[np.float64]:
        if "masses" not in self._known:
            self._known["masses"] = self._forest.carriage.arrays.mass[: self.sizes.nodes].numpy().copy()
        return self._known["masses"]

    @property
    def prefers_subtrees(self) -> bool:
        return True

    def plan(
        self, rotation_level: int | None = None, *, subtrees: bool = True, deterministic: bool = False
    ) -> DevicePlan:
        assert not deterministic
        plan = DevicePlan(self._forest, rotation_level, subtrees=subtrees)
        if self.kept is None:
            self.kept, self.elements = plan, plan.elements
            if self.material_stride:
                self.mu, self.lam = (plan.values[name] for name in ("mu", "lam"))
            self.lame = self._carried.lame_of(plan) or self.lame
            self.activation = plan.values.get(ACTIVATION, self.activation)
            self._carried.serve(plan, self.lame)
        return plan

    def _tree_nodes(self) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32], int]:
        pools, used = self._forest.pools, self._forest.nodes_in_use
        return pools.lattice.numpy()[used], pools.ends.numpy()[used], pools.node_limit

    def anisotropic_material(self) -> OrthotropicMaterial:
        return self._carried.anisotropic

    def mesh_changed(self, nodes: int, elements: int, smallest_volume: float) -> None:
        """Record that the device has changed the mesh: the host's copies are out of date.

        Args:
            nodes, elements: Current numbers.
            smallest_volume: Smallest volume of an element [m^3].
        """
        self._known.clear()
        self.sizes.mesh_changed(nodes, elements)
        self.smallest_volume = smallest_volume

    def launch(self) -> None:
        """Launch the kernels that update the plan and the material, or record them."""
        assert self.kept is not None
        self.kept.launch()
        self._carried.derive(self.kept)
