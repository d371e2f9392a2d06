"""Elements outside subtrees that share their dilatation in groups, on the CPU: group after group in the lanes."""

from __future__ import annotations

from copy import copy

import warp as wp

from warp_corot.discretization.elements import copied
from warp_corot.discretization.plan import Plan
from warp_corot.elasticity.structs import isotropic_material
from warp_corot.inputs.cpu_threads import launch
from warp_corot.inputs.loading import load
from warp_corot.kernels.elements.constitutive import IsotropicMaterial
from warp_corot.kernels.elements.dilatation import Dilatation
from warp_corot.kernels.elements.dilatation_lanes import (
    GROUPS,
    GroupedMaterial,
    order_elements,
    scatter_grouped_elements,
)
from warp_corot.kernels.elements.elements import GeneralElements
from warp_corot.kernels.elements.law_lanes import LawInLanes


class GroupedLanes:
    """Launches that add the forces of elements in groups under a law, with the dilatation that groups share.

    Args:
        plan: The plan whose elements are grouped.
        kind: The struct of these elements.
        of: The shared dilatation.
        starts, members, live: The groups in the form of ``kernels.elements.shared_dilatation.share_in_groups``.

    Attributes:
        count: Number of groups in launches.
    """

    def __init__(self, plan: Plan, kind: type, of: Dilatation, starts: wp.array, members: wp.array, live: wp.array):
        self.count = 0
        self._plan, self._of, self._order = plan, of, order_elements(kind)
        load(["elements.general_cpu"], wp.get_device("cpu"), [self._order])
        self._members, self._live, most = members, live, len(members)
        general = self._general = GeneralElements()
        general.nodes = general.targets = wp.zeros(most, dtype=wp.vec4i, device="cpu")
        general.rest_inverse = wp.zeros(most, dtype=wp.mat33, device="cpu")
        general.volume = wp.zeros(most, dtype=wp.float32, device="cpu")
        self._material = GroupedMaterial()
        self._material.starts, self._material.live = starts, live
        #: How many, then which.
        self._left_out = wp.zeros(most + 1, dtype=wp.int32, device="cpu")

    def derive(self, material: IsotropicMaterial, lam: wp.array) -> None:
        """Launch the sorting of elements; may be recorded.

        Args:
            material: The material of all elements, without lambda.
            lam: Lambda [Pa], in the same order as ``material``.
        """
        grouped, most = self._material, len(self._members)
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

    def kernel(self, law: LawInLanes) -> wp.Kernel:
        """The kernel that adds the forces of a law."""
        return scatter_grouped_elements(law, self._of)

    def scatter_forces(self, law: LawInLanes, u: wp.array, f: wp.array, repair: wp.Kernel | None = None) -> None:
        """Add the forces of displacements u to f, both vec4 [N].

        Args:
            law: A law of ``kernels.elements.law_lanes``.
            repair: Computes the elements that the law leaves out, if any.
        """
        if not self.count:
            return
        inputs = [self._general, self.count, self._material, u]
        launch(self.kernel(law), -(-self.count // GROUPS), inputs, [f, self._left_out], device="cpu")
        if repair is not None:
            launch(repair, 1, [self._general, self._material.isotropic, u], [self._left_out, f], device="cpu")

    def part(self, begin: int, end: int) -> GroupedLanes:
        """The launches of some of the groups, if the mesh does not change."""
        part = copy(self)
        part.count, part._material = end - begin, copied(self._material)
        part._material.starts = self._material.starts[begin : end + 1]
        part._left_out = wp.zeros_like(self._left_out)
        return part

    @property
    def nodes(self) -> wp.array:
        """The nodes of the elements, vec4i."""
        starts = self._material.starts.numpy()
        return self._general.nodes[int(starts[0]) : int(starts[-1])]
