"""The finest level without a matrix, for bodies all of whose leaves are in subtrees of one level (CUDA).

Products go over the subtrees, with the rotations of their leaves, and the next level of the cycle is that of the
subtrees' roots; see ``kernels.implicit.multigrid.subtrees``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numpy as np
import warp as wp

from warp_corot.discretization.discretization import Discretization, FixedMesh
from warp_corot.discretization.groups import Members
from warp_corot.discretization.plan import Batch
from warp_corot.inputs.loading import load
from warp_corot.kernels.corotated import turned_subtrees
from warp_corot.kernels.elements.elements import ForestElements, Subtrees
from warp_corot.kernels.implicit.multigrid import subtrees
from warp_corot.kernels.implicit.multigrid.values import rest_frame, turned_frame
from warp_corot.kernels.subtrees.memory import BLOCK
from warp_corot.mesh import TetForest
from warp_corot.solvers.implicit.operator import LinearOperator

from .level import Level, SmoothedLevel
from .pattern import Midpoints, Pattern


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
        discretization: The mesh.
        batches: Its subtrees, from ``suitable_batches``.
        rank: The rank of each node number, int32 [M].
        free: As for every level.
        degree: The degree of the smoother.
        is_turned, stiffening, most_lambda, most_shared: As for ``Multigrid``.
        members: The subtrees as groups that share their dilatation, or None.

    Attributes:
        roots: Number of subtrees in one world.
        root_blocks: The matrices of all roots, mat33; see ``kernels.implicit.multigrid.subtrees``.
        own: What nodes add to the diagonal.
        scales: Scales of the operator, float32 [3].
    """

    def __init__(
        self,
        discretization: Discretization,
        batches: Sequence[Batch],
        rank: wp.array,
        free: wp.array,
        degree: int,
        *,
        is_turned: bool,
        stiffening: float,
        most_lambda: float,
        members: Members | None,
        most_shared: float,
    ):
        worlds, device = discretization.worlds, discretization.device
        super().__init__(len(rank), worlds, len(rank), free, degree)
        self.stiffening, self._discretization, self._batches = stiffening, discretization, tuple(batches)
        self._most_shared = min(most_shared, 1e30)
        self._keep_turns = turned_subtrees.keep_turns(turned_frame if is_turned else rest_frame)
        self._law = None if members is None else members.law
        self._material = turned_subtrees.LeafMaterial()
        self._material.mu, self._material.lam = discretization.mu, discretization.lam
        # Where leaves share their dilatation, rows have all of it.
        self._material.most_lambda = min(most_lambda, 1e30) if members is None else 0.0
        self._places = [self._ranked(batch, rank) for batch in batches]
        self._load_kernels(members is not None)
        self.roots = sum(batch.count for batch in batches) // worlds
        self.root_blocks = wp.zeros(worlds * self.roots * subtrees.ROOT_BLOCKS, dtype=wp.mat33, device=device)
        self._turns = [wp.zeros(8 * batch.count, dtype=wp.vec4, device=device) for batch in batches]
        rows = [0 if members is None else 10 * batch.count for batch in batches]
        self._rows = [wp.zeros(count, dtype=wp.vec4, device=device) for count in rows]
        self._products, self._mixed = wp.zeros_like(self.r), wp.zeros_like(self.r)
        self.own = subtrees.OwnBlocks()
        self.own.masses = wp.zeros(len(self.r), dtype=wp.float32, device=device)
        self._no_blocks = self.own.blocks = wp.zeros(1, dtype=wp.mat33, device=device)
        self._blocks = wp.zeros_like(self.inverses)
        self.scales = wp.zeros(3, dtype=wp.float32, device=device)

    def update(self, operator: LinearOperator, mesh_nodes: int, nodes: wp.array, others: wp.array) -> None:
        """Launch rotations, rows, the diagonal and the matrices of roots at the operator's displacements.

        Args:
            operator: The operator.
            mesh_nodes: Number of nodes of the mesh.
            nodes: The node number of each rank, int32.
            others: Diagonal blocks of other forces, as of ``operator.other_blocks``.
        """
        self.scales = operator.scales
        self.own.blocks = self._blocks if len(others) > 1 else self._no_blocks
        inputs = [self.ranks, mesh_nodes, nodes, self.free, operator.inverse_mass, operator.scales, others]
        self.launch(subtrees.find_own, self.count, inputs, [self.own])
        wp.launch(subtrees.mark_free, len(self.r), [self.free], [self.other], device=self.device)
        first = 0
        for k, batch in enumerate(self._batches):
            self._update_batch(k, batch, operator.displacements, first)
            first += batch.count // self.worlds
        inputs = [self.stiffening, self.scales, self.own]
        outputs = [self._products, self._mixed, self.inverses]
        wp.launch(subtrees.invert_diagonals, len(self.r), inputs, outputs, device=self.device)

    def _make_step(self, step: int, *, is_first: bool) -> None:
        alpha, beta = self.factors[step]
        self._add_products()
        inputs: list[Any] = [alpha, beta if step else 0.0, is_first, self.stiffening, self.scales, self.own]
        inputs += [self.inverses, self.r, self.z]
        outputs = [self._products, self.other]
        wp.launch(subtrees.finish_smoothing, len(self.r), inputs, outputs, device=self.device)
        self.z, self.other = self.other, self.z

    def find_residual(self) -> None:
        self._add_products()
        inputs = [self.stiffening, self.scales, self.own, self.r, self.z]
        outputs = [self._products, self.other]
        wp.launch(subtrees.finish_residual, len(self.r), inputs, outputs, device=self.device)

    # --- pieces ------------------------------------------------------------------------------------------------------

    def _add_products(self) -> None:
        for k, batch in enumerate(self._batches):
            inputs = [self._places[k], self._material, self._turns[k], self._rows[k], self.z]
            self._launch_subtrees(self._product[k], batch, inputs, [self._products])

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
        for is_mixed, parts in ((False, self._products), (True, self._mixed)):
            self._launch_subtrees(self._diagonal[k], batch, [self._places[k], *given, is_mixed], [parts])
        inputs = [self._places[k], count // self.worlds, self.roots, first, *given, self.other]
        self._launch_subtrees(self._roots[k], batch, inputs, [self.root_blocks])

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

    def _ranked(self, batch: Batch, rank: wp.array) -> Subtrees:
        """The subtrees with ranks in place of node numbers."""
        given, found = batch.subtrees, Subtrees()
        found.code, found.first, found.frames, found.size = given.code, given.first, given.frames, given.size
        if self.device.is_cpu:
            places = np.ascontiguousarray(given.nodes.numpy()[: batch.count].T)
            found.nodes = wp.array(places, dtype=wp.int32, device=self.device)
        else:
            found.nodes = wp.clone(given.nodes)
        inputs = [self._discretization.sizes.world_nodes, len(rank), rank]
        wp.launch(subtrees.rank_places, found.nodes.shape, inputs, [found.nodes], device=self.device)
        found.targets = found.nodes
        return found


class RootLevel(Level):
    """The level of the roots of subtrees, whose matrix comes from these.

    Args:
        pattern, worlds, ranks, free, degree, is_bounded: As for ``Level``.
        midpoints: The midpoints between this level and the finest one.
        middles: The same for each entry in the upper triangle, from ``PatternFinder.middles``.
    """

    def __init__(
        self,
        pattern: Pattern,
        worlds: int,
        ranks: int,
        free: wp.array,
        degree: int,
        is_bounded: bool,
        *,
        midpoints: Midpoints,
        middles: wp.array,
    ):
        super().__init__(pattern, worlds, ranks, free, degree, is_bounded)
        self._midpoints, self._middles = midpoints, middles

    def gather_from(self, fine: SmoothedLevel) -> None:
        assert isinstance(fine, SubtreeLevel)
        inputs = [self.arrays, self.pattern.sums, fine.roots, fine.stiffening, fine.scales, fine.own]
        inputs += [self._midpoints.starts, self._midpoints.midpoints, self._middles, fine.root_blocks]
        self.gather(subtrees.gather_roots, inputs)
