"""A forest that changes, as force fields see it."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from warp_corot.discretization.changing.plan import DevicePlan
from warp_corot.discretization.changing.pools import DeviceForest
from warp_corot.discretization.discretization import Discretization
from warp_corot.discretization.levels import TreeNodes
from warp_corot.inputs.cpu_threads import team_of
from warp_corot.kernels.corotated.anisotropic import OrthotropicMaterial
from warp_corot.materials.anisotropic import Directional
from warp_corot.mesh import TetForest

from .carried_material import ACTIVATION, CarriedMaterial


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
        self._is_uniform = former.is_uniform
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
    def is_uniform(self) -> bool:
        return self._is_uniform

    @property
    def is_anisotropic(self) -> bool:
        return isinstance(self._carried.given, Directional)

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

    def _tree_nodes(self) -> TreeNodes:
        pools, others = self._forest.pools, self._forest.virtual_count
        return TreeNodes(pools.lattice, pools.ends, self.sizes.world_nodes, pools.node_limit, others)

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
