"""A dilatation that elements share, for launches on the CPU that add its forces together with a law's."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy

import warp as wp

from warp_corot.discretization.elements import copied
from warp_corot.discretization.plan import Plan
from warp_corot.elasticity.structs import Kept, isotropic_material
from warp_corot.inputs.cpu_threads import Team, launch
from warp_corot.inputs.loading import load
from warp_corot.kernels.elements.constitutive import IsotropicMaterial
from warp_corot.kernels.elements.dilatation import Dilatation
from warp_corot.kernels.elements.elements import GeneralElements
from warp_corot.kernels.elements.grouped_simd8 import (
    GROUPS,
    GroupedMaterial,
    order_elements,
    scatter_grouped_elements,
)
from warp_corot.kernels.elements.native_laws import IsotropicLaw
from warp_corot.kernels.subtrees.cpu import DilatingMaterial


class Dilating:
    """The shared dilatation of subtrees, and of other elements in groups, which are computed group after group.

    Args:
        of: The shared dilatation.
        lam: Gives lambda [Pa] as elements hold it.
        plan: The plan whose elements are grouped.
        kind: The struct of these elements.
        starts, members, live: The groups in the form of ``kernels.elements.mean_dilatation.share_in_groups``.

    Attributes:
        count: Number of groups in launches.
    """

    def __init__(
        self,
        of: Dilatation,
        lam: Callable[[], wp.array],
        plan: Plan,
        kind: type,
        starts: wp.array,
        members: wp.array,
        live: wp.array,
    ):
        self.of, self.count = of, 0
        self._lam, self._plan, self._order = lam, plan, order_elements(kind)
        self._of_subtrees = Kept(_material)
        load(["elements.general_cpu"], wp.get_device("cpu"), [self._order])
        self._members, self._live, most = members, live, len(members)
        general = self._general = GeneralElements()
        general.nodes = general.targets = wp.zeros(most, dtype=wp.vec4i, device="cpu")
        general.rest_inverse = wp.zeros(most, dtype=wp.mat33, device="cpu")
        general.volume = wp.zeros(most, dtype=wp.float32, device="cpu")
        self._of_groups = GroupedMaterial()
        self._of_groups.starts, self._of_groups.live = starts, live
        #: How many, then which.
        self._degenerate = wp.zeros(most + 1, dtype=wp.int32, device="cpu")

    def material(self, isotropic: IsotropicMaterial, tolerance: float | None = None) -> DilatingMaterial:
        """The struct of subtrees.

        Args:
            isotropic: The material, without lambda.
            tolerance: For the corotated law, the largest angle at which the root's rotation is used [rad]; None: never.
        """
        made: DilatingMaterial = self._of_subtrees(isotropic, self._lam(), tolerance)
        return made

    def parts(self, team: Team, worlds: int) -> list[Dilating]:
        """The same, each with some of the groups of all worlds, if the mesh does not change."""
        if not self.count:
            return [self] * team.parts
        return [self._part(*bounds) for bounds in team.bounds(self.count, GROUPS, worlds)]

    def _part(self, begin: int, end: int) -> Dilating:
        part = copy(self)
        part.count, part._of_groups, part._of_subtrees = end - begin, copied(self._of_groups), Kept(_material)
        part._of_groups.starts = self._of_groups.starts[begin : end + 1]
        part._degenerate = wp.zeros_like(self._degenerate)
        return part

    @property
    def nodes(self) -> wp.array:
        """The nodes of the elements in groups, vec4i."""
        starts = self._of_groups.starts.numpy()
        return self._general.nodes[int(starts[0]) : int(starts[-1])]

    def derive(self, material: IsotropicMaterial) -> None:
        """Launch the sorting of the groups' elements; may be recorded.

        Args:
            material: The material of all elements, without lambda.
        """
        grouped, most, lam = self._of_groups, len(self._members), self._lam()
        if grouped.lam is None or (material.stride and len(grouped.lam) != most):
            mu = none = material.mu
            if material.stride:
                mu, none, lam_here = (wp.zeros(most, dtype=wp.float32, device="cpu") for _ in range(3))
            else:
                none, lam_here = material.lam, lam
            grouped.isotropic = isotropic_material([mu, none, material.stride])
            grouped.lam = lam_here
        inputs = [self._plan.elements, material, lam, self._members, self._live]
        wp.launch(self._order, most, inputs, [self._general, grouped], device="cpu")

    def kernel(self, law: IsotropicLaw) -> wp.Kernel:
        """The kernel that adds the forces of groups under a law."""
        return scatter_grouped_elements(law, self.of)

    def scatter_groups(self, law: IsotropicLaw, u: wp.array, f: wp.array, repair: wp.Kernel | None = None) -> None:
        """Add the forces of groups at displacements u to f, both vec4 [N].

        Args:
            law: A law of ``kernels.elements.native_laws``.
            repair: Computes the elements that the law leaves out, if any.
        """
        if not self.count:
            return
        inputs = [self._general, self.count, self._of_groups, u]
        launch(self.kernel(law), -(-self.count // GROUPS), inputs, [f, self._degenerate], device="cpu")
        if repair is not None:
            launch(repair, 1, [self._general, self._of_groups.isotropic, u], [self._degenerate, f], device="cpu")


def _material(isotropic: IsotropicMaterial, lam: wp.array, tolerance: float | None) -> DilatingMaterial:
    material = DilatingMaterial()
    material.isotropic, material.lam, material.tolerance = isotropic, lam, tolerance or 0.0
    return material
