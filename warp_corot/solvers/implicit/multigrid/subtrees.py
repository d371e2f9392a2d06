"""The finest level without a matrix, for bodies all of whose leaves are in subtrees of one level (CUDA).

Products go over the subtrees, with the rotations of their leaves, and the next level of the cycle is that of the
subtrees' roots; see ``kernels.implicit.multigrid.subtrees``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import warp as wp

from warp_corot.discretization.discretization import Discretization, FixedMesh
from warp_corot.discretization.groups import Members
from warp_corot.discretization.plan import Batch
from warp_corot.elasticity.corotated.tangents import with_own_targets
from warp_corot.inputs.loading import load
from warp_corot.kernels.corotated import turned_subtrees
from warp_corot.kernels.elements.elements import ForestElements, Subtrees
from warp_corot.kernels.implicit.multigrid import subtrees
from warp_corot.kernels.implicit.multigrid.values import rest_frame, turned_frame
from warp_corot.kernels.subtrees.memory import BLOCK
from warp_corot.mesh import TetForest
from warp_corot.solvers.implicit.tangent import TangentOperator

from .level import Level, SmoothedLevel
from .pattern import Midpoints, Pattern, PatternFinder

if TYPE_CHECKING:
    from .multigrid import Multigrid


def suitable_batches(discretization: Discretization) -> tuple[Batch, ...] | None:
    """The subtrees of a mesh that does not change, if they have all leaves and are of one level and of a suitable type;
    else None."""
    mesh = discretization.mesh if isinstance(discretization, FixedMesh) else None
    if not isinstance(mesh, TetForest) or np.ptp(mesh.levels) > 0:
        return None
    plan = discretization.plan()
    if len(plan.flat) or any(batch.shape not in subtrees.TYPES for batch in plan.batches):
        return None
    return tuple(plan.batches)


class SubtreeLevel(SmoothedLevel):
    """The finest level.

    Args:
        cycle: The cycle, with its present nodes.
        batches: Its subtrees, from ``suitable_batches``.
        rank: The rank of each node number, int32 [M].
        free, degree: As for every level.
        members: The subtrees as groups that share their dilatation, or None.
    """

    def __init__(
        self,
        cycle: Multigrid,
        batches: Sequence[Batch],
        rank: wp.array,
        free: wp.array,
        degree: int,
        members: Members | None,
    ):
        discretization = cycle.discretization
        worlds, device = discretization.worlds, discretization.device
        super().__init__(len(rank), worlds, len(rank), free, degree)
        self._discretization, self._batches, self._rank = discretization, tuple(batches), rank
        self._most_shared = cycle.most_shared
        self._keep_turns = turned_subtrees.keep_turns(turned_frame if cycle.is_turned else rest_frame)
        self._law = None if members is None else members.law
        self._material = turned_subtrees.LeafMaterial()
        self._material.mu, self._material.lam = discretization.mu, discretization.lam
        # Where leaves share their dilatation, rows have all of it.
        self._material.most_lambda = min(cycle.most_lambda, 1e30) if members is None else 0.0
        self._places = [self._ranked(batch) for batch in batches]
        self._load_kernels(members is not None)
        self._per_world = sum(batch.count for batch in batches) // worlds
        self._root_blocks = wp.zeros(worlds * self._per_world * subtrees.ROOT_BLOCKS, dtype=wp.mat33, device=device)
        self._turns = [wp.zeros(8 * batch.count, dtype=wp.vec4, device=device) for batch in batches]
        rows = [0 if members is None else 10 * batch.count for batch in batches]
        self._rows = [wp.zeros(count, dtype=wp.vec4, device=device) for count in rows]
        self._mixed, self._blocks = wp.zeros_like(self.r), wp.zeros_like(self.inverses)
        self._no_blocks = wp.zeros(1, dtype=wp.mat33, device=device)
        self._own = subtrees.SubtreeArrays()
        self._own.level, self._own.stiffening, self._own.products = self.arrays, cycle.stiffening, wp.zeros_like(self.r)
        self._own.masses = wp.zeros(len(self.r), dtype=wp.float32, device=device)

    def update(self, operator: TangentOperator, mesh_nodes: int, nodes: wp.array) -> None:
        """Launch rotations, rows, the diagonal and the matrices of roots at the operator's displacements.

        Args:
            operator: The operator.
            mesh_nodes: Number of nodes of the mesh.
            nodes: The node number of each rank, int32.
        """
        others, own = operator.other_blocks(), self._own
        own.scales, own.blocks = operator.scales, self._blocks if len(others) > 1 else self._no_blocks
        inputs: list[Any] = [mesh_nodes, nodes, operator.inverse_mass, others]
        self.launch(subtrees.find_own, self.count, inputs, [own, self.other])
        first = 0
        for k, batch in enumerate(self._batches):
            self._update_batch(k, batch, operator.displacements, first)
            first += batch.count // self.worlds
        wp.launch(subtrees.invert_diagonals, len(self.r), [own, self._mixed], device=self.device)

    def _make_step(self, step: int, *, is_first: bool) -> None:
        alpha, beta = self.factors[step]
        self._finish_product(subtrees.finish_smoothing, [alpha, beta if step else 0.0, is_first])
        self.z, self.other = self.other, self.z

    def find_residual(self) -> None:
        self._finish_product(subtrees.finish_residual, [])

    def coarser_pattern(self, finder: PatternFinder, count: int) -> Pattern:
        elements = cast("ForestElements", self._discretization.elements)
        pattern = finder.of_roots(count, self._batches, self._per_world, elements.nodes, self._rank)
        self._middles = finder.middles(pattern, self.count)
        return pattern

    def gather_into(self, coarse: Level, midpoints: Midpoints) -> None:
        inputs = [coarse.arrays, coarse.pattern.sums, self._per_world, self._own]
        inputs += [midpoints.starts, midpoints.midpoints, self._middles, self._root_blocks]
        coarse.gather(subtrees.gather_roots, inputs)

    # --- pieces ------------------------------------------------------------------------------------------------------

    def _finish_product(self, kernel: wp.Kernel, inputs: list[Any]) -> None:
        """Launch K z, and what is to be done with it."""
        for k, batch in enumerate(self._batches):
            given = [self._places[k], self._material, self._turns[k], self._rows[k], self.z]
            self._launch_subtrees(self._product[k], batch, given, [self._own.products])
        wp.launch(kernel, len(self.r), [self._own, *inputs, self.z], [self.other], device=self.device)

    def _update_batch(self, k: int, batch: Batch, u: wp.array, first: int) -> None:
        discretization, count = self._discretization, batch.count
        elements, leaves = cast("ForestElements", discretization.elements), batch.subtrees.first
        inputs: list[Any] = [count, leaves, elements, u]
        wp.launch(self._keep_turns, (8, count), inputs, [self._turns[k]], device=self.device)
        if self._law is not None:
            inputs += [discretization.mu, discretization.lam, discretization.material_stride, self._most_shared]
            kernel = subtrees.keep_rows(batch.shape, self._law)
            wp.launch(kernel, count, inputs, [self._rows[k]], device=self.device)
        given = [self._material, self._turns[k], self._rows[k]]
        for is_mixed, parts in ((False, self._own.products), (True, self._mixed)):
            self._launch_subtrees(self._diagonal[k], batch, [self._places[k], *given, is_mixed], [parts])
        inputs = [self._places[k], count // self.worlds, self._per_world, first, *given, self.other]
        self._launch_subtrees(self._roots[k], batch, inputs, [self._root_blocks])

    def _load_kernels(self, shares: bool) -> None:
        uniform = self._discretization.material_stride == 0
        kinds = [(batch.shape, batch.grouped, uniform, shares) for batch in self._batches]
        self._product = [turned_subtrees.add_subtree_products(*kind) for kind in kinds]
        self._diagonal = [subtrees.add_diagonals(*kind) for kind in kinds]
        self._roots = [subtrees.write_roots(*kind) for kind in kinds]
        load((), self.device, [(kernel, self._block) for kernel in self._product + self._diagonal + self._roots])

    def _launch_subtrees(self, kernel: wp.Kernel, batch: Batch, inputs: list[Any], outputs: list[Any]) -> None:
        wp.launch(kernel, batch.count, inputs, outputs, device=self.device, block_dim=self._block)

    @property
    def _block(self) -> int:
        return BLOCK if self.device.is_cuda else 256

    def _ranked(self, batch: Batch) -> Subtrees:
        """The subtrees with ranks in place of node numbers."""
        found = with_own_targets(batch, self.device)
        if self.device.is_cuda:
            found.nodes = wp.clone(found.nodes)
        inputs = [self._discretization.sizes.world_nodes, self.count, self._rank]
        wp.launch(subtrees.rank_places, found.nodes.shape, inputs, [found.nodes], device=self.device)
        found.targets = found.nodes
        return found
