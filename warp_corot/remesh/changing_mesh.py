"""A forest that changes, as force fields see it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from warp_corot.discretization.changing.plan import DevicePlan
from warp_corot.discretization.changing.pools import DeviceForest
from warp_corot.kernels.corotated.anisotropic import OrthotropicMaterial

from .carried_material import CarriedMaterial

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody


class ChangingMesh:
    """The ``discretization.Discretization`` of a forest that changes.

    Args:
        body: The body, which has the elements of the plan that is kept.
        forest: The pools.
        carried: What elements carry of the body's material.

    Attributes:
        kept: The plan that is kept up to date: the first one that is asked for. Others are of the mesh as it is then.
    """

    prefers_subtrees = True

    def __init__(self, body: SoftBody, forest: DeviceForest, carried: CarriedMaterial):
        self._body, self._forest, self._carried = body, forest, carried
        self.kept: DevicePlan | None = None

    def plan(
        self, rotation_level: int | None = None, *, subtrees: bool = True, deterministic: bool = False
    ) -> DevicePlan:
        assert not deterministic
        plan = DevicePlan(self._forest, rotation_level, subtrees=subtrees)
        if self.kept is None:
            self.kept = plan
            self._body.elements = plan.elements
            self._carried.serve(self._body, plan)
        return plan

    def anisotropic_material(self) -> OrthotropicMaterial:
        return self._carried.anisotropic

    def launch(self) -> None:
        """Launch what brings the plan and the material up to date, or record it."""
        assert self.kept is not None
        self.kept.launch()
        self._carried.derive(self.kept)
