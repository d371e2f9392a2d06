"""A discretization whose elements do not resist changes of volume: a law's forces without the terms in lambda."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.kernels.corotated.anisotropic import OrthotropicMaterial
from warp_corot.mesh import TetForest, TetMesh

from .discretization import Discretization
from .levels import Levels, TreeNodes
from .plan import FlatLeaves, Plan


class ShearOnly(Discretization):
    """Another discretization with zero in place of lambda. All other data are shared and follow its changes.

    Args:
        whole: The other discretization.
    """

    def __init__(self, whole: Discretization):
        self.whole = whole
        self._zeros: dict[str, tuple[wp.array, wp.array]] = {}

    def __getattr__(self, name: str) -> Any:
        return getattr(self.__dict__["whole"], name)

    @property
    def lam(self) -> wp.array:
        return self._none_of("all", self.whole.lam)

    def lame_of_flat(self, flat: FlatLeaves) -> tuple[wp.array, wp.array] | None:
        given = self.whole.lame_of_flat(flat)
        return None if given is None else (given[0], self._none_of("flat", given[1]))

    def _none_of(self, which: str, lam: wp.array) -> wp.array:
        known = self._zeros.get(which)
        if known is None or known[0] is not lam:
            known = self._zeros[which] = (lam, wp.zeros_like(lam))
        return known[1]

    # --- as the other one has it -------------------------------------------------------------------------------------

    @property
    def mesh(self) -> TetForest | TetMesh:
        return self.whole.mesh

    @property
    def material(self) -> Any:
        return self.whole.material

    @property
    def masses(self) -> npt.NDArray[np.float64]:
        return self.whole.masses

    @property
    def is_uniform(self) -> bool:
        return self.whole.is_uniform

    @property
    def is_anisotropic(self) -> bool:
        return self.whole.is_anisotropic

    @property
    def prefers_subtrees(self) -> bool:
        return self.whole.prefers_subtrees

    def plan(self, rotation_level: int | None = None, *, subtrees: bool = True, deterministic: bool = False) -> Plan:
        return self.whole.plan(rotation_level, subtrees=subtrees, deterministic=deterministic)

    def levels(self) -> Levels:
        return self.whole.levels()

    def _tree_nodes(self) -> TreeNodes:
        return self.whole._tree_nodes()

    def anisotropic_material(self) -> OrthotropicMaterial:
        return self.whole.anisotropic_material()

    def make_activation(self) -> bool:
        return self.whole.make_activation()
