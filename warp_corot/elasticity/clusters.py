"""The launches that add the forces of elements in clusters (CUDA); see ``kernels.clusters``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.clusters import (
    axis_words,
    changing_clusters,
    find_tables,
    order_in_clusters,
    pairs_in_clusters,
)
from warp_corot.discretization.elements import Elements, in_worlds
from warp_corot.discretization.plan import GROUPED_LEAVES, Batch, LeafCounts, Plan
from warp_corot.elasticity.cpu import as_general
from warp_corot.inputs.loading import LoadedKernel
from warp_corot.kernels.clusters.laws import ActiveMaterial
from warp_corot.kernels.clusters.pairs import GeneralPairs, LatticePairs, scatter_pairs
from warp_corot.kernels.clusters.single import AlignedElements, align_elements, scatter_clusters
from warp_corot.kernels.corotated.anisotropic import ReinforcedMaterial
from warp_corot.kernels.elements.constitutive import IsotropicMaterial
from warp_corot.kernels.elements.cpu import rest_matrices
from warp_corot.kernels.elements.elements import ForestElements, GeneralElements
from warp_corot.kernels.tables.cluster_layout import (
    AHEAD,
    DEFAULT_LAYOUT,
    GENERAL,
    LARGE,
    LATTICE,
    ClusterLayout,
    PairLayout,
)
from warp_corot.mesh import TetForest

if TYPE_CHECKING:
    from warp_corot.discretization.discretization import Discretization


#: Leaves of a subtree.
SUBTREE = 8


def grouped_and_others(plan: Plan, fewest: int = GROUPED_LEAVES) -> tuple[list[Batch], npt.NDArray[np.int32]]:
    """The batches of a plan whose subtrees are in groups, and all other leaves, int32 [n].

    If groups have fewer than ``fewest`` leaves, a separate launch does not pay, and these leaves are among the others.
    """
    batches = [batch for batch in plan.batches if batch.grouped]
    if SUBTREE * sum(batch.count for batch in batches) < fewest:
        batches = []
    first = [batch.subtrees.first.numpy() for batch in plan.batches if not any(batch is other for other in batches)]
    single = np.concatenate([np.empty(0, np.int32), *first])
    leaves = np.concatenate([plan.flat.leaves.numpy(), (single[:, None] + np.arange(SUBTREE)).ravel()])
    return batches, np.sort(leaves).astype(np.int32)


def clustered(discretization: Discretization) -> npt.NDArray[np.int32]:
    """A body's elements, of all worlds, in the order of clusters: int32 [worlds * T]."""
    mesh = discretization.mesh
    if isinstance(mesh, TetForest):
        return np.arange(discretization.worlds * len(mesh.tets), dtype=np.int32)
    return in_worlds(order_in_clusters(mesh.points, mesh.tets), discretization.worlds, len(mesh.tets))


def divided(
    discretization: Discretization,
    plan: Plan,
    law: wp.Function,
    Material: type = IsotropicMaterial,
    layout: PairLayout | None = None,
) -> tuple[list[Batch], ClusterScatter | None]:
    """The batches of a plan that are launched as subtrees, and the launch of all other elements in clusters.

    Clusters of pairs are found on the host, and their sums have any order. So there are none, and the plan's batches
    and leaves remain as they are, if leaves change, if sums must have a fixed order, and on the CPU.
    """
    is_by_leaves = not plan.batches and not len(plan.flat)
    fixed = plan.counts is None and plan.slots is None and plan.elements.nodes.device.is_cuda
    if not fixed or not (is_by_leaves or len(plan.flat)):
        return list(plan.batches), None
    batches, elements = ([], clustered(discretization)) if is_by_leaves else grouped_and_others(plan)
    return batches, ClusterScatter(plan.elements, law, Material, chosen=elements, layout=layout)


class ClusterScatter:
    """Adds the forces of elements that never change.

    Args:
        elements: All elements of a mesh, ``kernels.elements.elements.ForestElements`` or ``GeneralElements``.
        law: A function of ``kernels.clusters.laws``.
        Material: The struct that the law takes.
        chosen: The elements, int32 [n], in the order in which clusters take them; None: all.
        layout: The layout for which the kernel is generated; None: the one for isotropic laws.

    Attributes:
        clusters: ``kernels.clusters.pairs.PairClusters``.
        pairs: ``kernels.clusters.pairs.LatticePairs`` or ``GeneralPairs``.
        count: Number of clusters.
        Pairs, Material, law, layout: The types and options for which the kernel is generated.
    """

    def __init__(
        self,
        elements: Elements,
        law: wp.Function,
        Material: type = IsotropicMaterial,
        *,
        chosen: npt.NDArray[np.int32] | None = None,
        layout: PairLayout | None = None,
    ):
        self._device, self.law, self.Material = elements.nodes.device, law, Material
        is_general = hasattr(elements, "rest_inverse")
        layout = layout or (GENERAL if is_general else LATTICE)
        general, cell = cast("GeneralElements", elements), None
        if not is_general:
            general = as_general(elements, rest_matrices, [elements])
            cell = float(cast("ForestElements", elements).size.numpy()[0])
        nodes = elements.nodes.numpy()
        if chosen is None:
            chosen = np.arange(len(nodes), dtype=np.int32)
        self.clusters, self.pairs, self.count = pairs_in_clusters(chosen, nodes, general, cell, layout)
        self.Pairs = GeneralPairs if is_general else LatticePairs
        tables = (self.pairs.records, self.clusters.slots, self.clusters.nodes)
        is_large = sum(table.capacity for table in tables) >= LARGE
        self.layout = replace(layout, ahead=AHEAD) if is_large else layout
        self._kernel = scatter_pairs(self.Pairs, Material, law, self.layout)
        self._wrapped: Callable[[Any], Any] | None = None

    def use_law(self, law: wp.Function, Material: type, given: wp.Function, wrapped: Callable[[Any], Any]) -> None:
        """Add from now on the forces of a law that needs more registers; its material is made of the one that callers
        give.
        """
        self.layout = replace(self.layout, resident=self.layout.resident - 1)
        self._kernel, self._wrapped = scatter_pairs(self.Pairs, Material, law, self.layout, given), wrapped

    @property
    def kernel(self) -> LoadedKernel:
        """The kernel that launches take."""
        return self._kernel, self.layout.threads

    def __call__(
        self, material: IsotropicMaterial | ActiveMaterial | ReinforcedMaterial, u: wp.array, f: wp.array
    ) -> None:
        """Add the forces [N] of displacements u to f, both vec4 [N]; ``material`` is what the law takes."""
        threads = self.layout.threads
        wp.launch(
            self._kernel,
            dim=self.count * threads,
            inputs=[self.clusters, self.pairs, material if self._wrapped is None else self._wrapped(material), u],
            outputs=[f],
            device=self._device,
            block_dim=threads,
        )


class ChangingClusterScatter:
    """Adds the forces of all leaves of a forest that changes.

    Args:
        discretization: A forest that changes; launches have its ``launch_elements``.
        elements: The leaves, with padding.
        counts: The number of leaves.
        law: A function of ``kernels.clusters.laws`` that works in any axes.
        layout: The layout for which kernels are generated.

    Attributes:
        clusters, elements: ``Clusters`` and ``AlignedElements`` of ``kernels.clusters.single``.
    """

    def __init__(
        self,
        discretization: Discretization,
        elements: ForestElements,
        counts: LeafCounts,
        law: wp.Function,
        layout: ClusterLayout = DEFAULT_LAYOUT,
    ):
        self._discretization, self._leaves, self._counts, self._layout = discretization, elements, counts, layout
        self._device = elements.nodes.device
        self.clusters, self._places = changing_clusters(counts.most, counts.now, layout)
        self._words = wp.array(axis_words(elements.frames.numpy()).ravel(), dtype=wp.int32, device=self._device)
        size = elements.size.numpy()
        self.elements = AlignedElements()
        self.elements.shape = wp.zeros(counts.most, dtype=wp.int32, device=self._device)
        self.elements.cell, self.elements.inverse_cell = float(size[0]), 1.0 / float(size[0])
        self._kernel = scatter_clusters(law, layout)
        wp.load_module(self._kernel.module, self._device, block_dim=layout.threads)

    @classmethod
    def of(cls, discretization: Discretization, plan: Plan, law: wp.Function) -> ChangingClusterScatter | None:
        """The clusters of all leaves of a changing plan; None if leaves never change."""
        return (
            None
            if plan.counts is None
            else cls(discretization, cast("ForestElements", plan.elements), plan.counts, law)
        )

    def derive(self) -> None:
        """Launch the search for clusters, if the plan has just been derived; may be recorded."""
        leaves, counts = self._leaves, self._counts
        find_tables(self.clusters, self._places, leaves.nodes, counts.goes, self._layout)
        inputs = [counts.goes, counts.now, leaves.code, self._words]
        wp.launch(align_elements, dim=counts.most, inputs=inputs, outputs=[self.elements.shape], device=self._device)

    def __call__(self, material: IsotropicMaterial | ActiveMaterial, u: wp.array, f: wp.array) -> None:
        """Add the forces of displacements u, like ``ClusterScatter``."""
        threads, count = self._layout.threads, -(-self._discretization.sizes.launch_elements // self._layout.elements)
        wp.launch(
            self._kernel,
            dim=count * threads,
            inputs=[self.clusters, self.elements, material, u],
            outputs=[f],
            device=self._device,
            block_dim=threads,
        )
