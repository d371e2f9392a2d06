"""Isotropic laws on the CPU: complete subtrees, and other elements in the lanes of its vector registers."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from typing import Any

import warp as wp

from warp_corot.elasticity.model import ForceField
from warp_corot.inputs.cpu_threads import Team
from warp_corot.inputs.loading import LoadedKernel
from warp_corot.kernels.elements.general_cpu import rest_matrices, scatter_law_elements
from warp_corot.kernels.elements.native_laws import IsotropicLaw
from warp_corot.kernels.elements.simd8 import LANES
from warp_corot.mesh import TetForest

from .divided import Piece
from .mean_dilatation import Dilating
from .simd8 import Lanes, as_general


class InLanes(ForceField):
    """The part of a field of an isotropic law for the CPU, where threads can divide it.

    With a shared dilatation the elements outside subtrees are in groups, and the field's own launches add its forces.
    """

    plan: Any
    #: A law of ``kernels.elements.native_laws``, and the kernel for the elements that it leaves out.
    lanes_law: IsotropicLaw = "corotated"
    repair: wp.Kernel | None = None
    _lanes: Lanes | None = None

    def share_dilatation(self, dilating: Dilating) -> bool:
        self._dilating = dilating
        self.derive()
        self.follow()
        return True

    def derive(self) -> None:
        if self._dilating is not None:
            self._dilating.derive(self.isotropic)

    def follow(self) -> None:
        super().follow()
        flat, of_law = self.plan.flat, {"scatter": scatter_law_elements(self.lanes_law), "repair": self.repair}
        self._lanes, self._flat_material = None, self.isotropic
        if self._dilating is not None:
            return
        if not isinstance(self.discretization.mesh, TetForest):
            self._lanes = Lanes(self.elements, self.elements, **of_law)
        elif len(flat):
            self._flat_material = self.isotropic_of(flat)
            if self.device.is_cpu and flat.unit is None:
                general = flat.general or as_general(flat.elements, rest_matrices, [flat.elements])
                self._lanes = Lanes(general, general, **of_law)

    @property
    def other_kernels(self) -> list[LoadedKernel]:
        """The kernels for elements outside subtrees."""
        law, dilating = self.lanes_law, self._dilating
        scatter = scatter_law_elements(law) if dilating is None else dilating.kernel(law)
        return [scatter] if self.repair is None else [scatter, self.repair]

    def scatter_others(self, u: wp.array, f: wp.array) -> None:
        """Add the forces of elements outside subtrees."""
        if self._dilating is not None:
            self._dilating.scatter_groups(self.lanes_law, u, f, self.repair)
        elif self._lanes is not None:
            self._lanes.scatter_forces(self._flat_material, u, f)

    def pieces(self, team: Team) -> list[Piece]:
        """See ``ForceField``: copies of the field, each with some of the subtrees and of the other elements."""
        if self.plan.counts is not None or self.plan.units is not None:
            return []

        worlds = self.discretization.worlds

        def parts_of(whole: Any) -> list[Any]:
            return [whole.part(*bounds) for bounds in team.bounds(whole.count, LANES, worlds)]

        batches = [parts_of(batch) for batch in self.plan.batches]
        dilating, lanes = self._dilating and self._dilating.parts(team, worlds), self._lanes and parts_of(self._lanes)
        pieces: list[Any] = [copy(self) for _ in range(team.parts)]
        for part, piece in enumerate(pieces):
            piece.plan = replace(self.plan, batches=tuple(batch[part] for batch in batches))
            piece._dilating, piece._lanes = dilating and dilating[part], lanes and lanes[part]
        return pieces

    @property
    def nodes(self) -> list[wp.array]:
        """See ``Piece``."""
        nodes = [batch.subtrees.nodes for batch in self.plan.batches]
        if self._dilating is not None:
            return [*nodes, self._dilating.nodes] if self._dilating.count else nodes
        return nodes if self._lanes is None else [*nodes, self._lanes.elements.nodes]
