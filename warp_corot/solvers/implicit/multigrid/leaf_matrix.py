"""The matrix of corotated or linear elements of a forest, gathered entry by entry."""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any, cast

import numpy as np
import warp as wp

from warp_corot.discretization.discretization import Discretization
from warp_corot.discretization.groups import Members
from warp_corot.inputs.cpu_threads import Regions, launch
from warp_corot.kernels.elements.elements import ForestElements
from warp_corot.kernels.implicit.multigrid import shared, values
from warp_corot.kernels.implicit.multigrid.leaves_cpu import gather_leaves_on_cpu
from warp_corot.kernels.tables.shapes import GRADIENT
from warp_corot.solvers.implicit.operator import LinearOperator

from .pattern import PatternFinder


class LeafMatrix:
    """What the matrix is computed from, and the launches that compute it.

    Args:
        discretization: The mesh and the material.
        finder: Finds the pattern.
        nodes: The number of each row's node, int32 [rows].
        rank: The row of each node number, int32.
        mesh_nodes: Number of nodes of the mesh.
        free: Nonzero for free nodes, by row, uint8 [worlds * rows].
        members: The groups of elements that share their dilatation, or None.
        is_turned: Whether elements turn; False: linear elasticity.
        is_bounded: Whether the inverses of diagonal blocks keep the bound of ``shared``.

    Attributes:
        pattern: Where entries are.
    """

    def __init__(
        self,
        discretization: Discretization,
        finder: PatternFinder,
        nodes: wp.array,
        rank: wp.array,
        mesh_nodes: int,
        free: wp.array,
        members: Members | None,
        *,
        is_turned: bool = True,
        is_bounded: bool = False,
    ):
        self._discretization, self.device, sizes = discretization, discretization.device, discretization.sizes
        self._nodes, self._rank, self._mesh_nodes, self._free, self._members = nodes, rank, mesh_nodes, free, members
        self._write_frames = values.write_frames(is_turned)
        self._regions = Regions(discretization.team, self.device)
        self.pattern, self._pairs = finder.of_leaves(self._elements.nodes, sizes.world_elements, rank, members)
        self._frames = wp.zeros(sizes.elements, dtype=wp.mat33, device=self.device)
        weights = np.swapaxes(np.array(GRADIENT), 1, 2).reshape(12, 3)
        self._gradients = wp.array(weights, dtype=wp.vec3, device=self.device)
        rows = 0 if members is None else sizes.worlds * members.entries
        self._rows = wp.zeros(rows, dtype=wp.vec4, device=self.device)
        more = sizes.worlds * len(nodes) if is_bounded else 1
        self._more = wp.zeros(more, dtype=wp.mat33, device=self.device)

    @property
    def kernels(self) -> list[wp.Kernel]:
        """Kernels that it launches, beside those of ``loading.IMPLICIT_ON_FORESTS``."""
        found = [self._write_frames, gather_leaves_on_cpu if self.device.is_cpu else values.gather_leaves]
        return found if self._members is None else [*found, shared.write_rows(self._members.law)]

    @property
    def _elements(self) -> ForestElements:
        return cast("ForestElements", self._discretization.elements)

    def gather(
        self,
        operator: LinearOperator,
        blocks: wp.array,
        inverses: wp.array,
        *,
        stiffening: float = 0.0,
        most_lambda: float = 1e30,
        most_shared: float = 1e30,
        holds: bool = False,
    ) -> None:
        """Launch the matrix at the operator's displacements and scales; its ``other_blocks`` are on the diagonal.

        Args:
            operator: The operator.
            blocks: The entries, transposed, mat33 [worlds * entries].
            inverses: The inverses of the diagonal blocks, mat33 [worlds * rows].
            stiffening: Viscous over elastic stress at one strain [s].
            most_lambda, most_shared: Lambda is at most this many times mu, and that of groups.
            holds: Whether the stiffness of elements that are held from turning over counts.
        """
        body, members, found, count = self._discretization, self._members, self.pattern, len(self._nodes)
        sizes, elements, u, scales = body.sizes, self._elements, operator.displacements, operator.scales
        others = operator.other_blocks()
        self._regions.launch_over(
            self._write_frames, sizes.elements, lambda _, own: ([own(elements), u], [own(self._frames)]), u.ptr
        )
        if members is not None:
            inputs: list[Any] = [sizes.world_elements, members.entries, members.arrays, elements, u]
            inputs += [body.mu, body.lam, body.material_stride, most_shared]
            self._launch(shared.write_rows(members.law), members.count, inputs, [self._rows], u.ptr, most_shared)
        inputs = [self._leaves(), scales, stiffening, most_lambda if members is None else 0.0]
        if self.device.is_cpu:
            parts, outputs = self._regions.team.parts, [blocks, self._more]
            self._regions.launch(
                (blocks.ptr, scales.ptr, stiffening, most_lambda),
                lambda part: launch(gather_leaves_on_cpu, sizes.worlds, [part, parts, *inputs], outputs, device="cpu"),
            )
        else:
            wp.launch(
                values.gather_leaves,
                (sizes.worlds, len(found.upper)),
                inputs,
                [blocks, self._more],
                device=self.device,
            )
        if holds and members is not None and members.law.is_held:
            inputs = [sizes.world_elements, count, found.entries, elements, u, body.lam, body.material_stride]
            inputs += [scales, self._rank, found.starts, found.columns]
            wp.launch(shared.add_held_blocks(members.law), sizes.elements, inputs, [blocks], device=self.device)
        inputs = [count, self._mesh_nodes, found.entries, self._nodes, operator.inverse_mass, scales, self._free]
        inputs += [found.starts, found.columns, found.diagonal, others, self._more]
        key = [blocks.ptr, others.ptr, scales.ptr, operator.inverse_mass.ptr]
        self._launch(values.finish_leaves, count, inputs, [blocks, inverses], *key)

    def _leaves(self) -> values.Leaves:
        body, found, leaves = self._discretization, self.pattern, values.Leaves()
        leaves.elements, leaves.world_elements = self._elements, body.sizes.world_elements
        leaves.frames, leaves.gradients = self._frames, self._gradients
        leaves.mu, leaves.lam, leaves.stride = body.mu, body.lam, body.material_stride
        leaves.upper, leaves.starts, leaves.codes = found.upper, found.sum_starts, found.codes
        leaves.places, leaves.entries, leaves.ranks = found.places, found.entries, len(self._nodes)
        leaves.row_entries = 0 if self._members is None else self._members.entries
        leaves.pairs, leaves.rows = self._pairs, self._rows
        return leaves

    def _launch(self, kernel: wp.Kernel, count: int, inputs: list[Any], outputs: list[Any], *key: Hashable) -> None:
        """Launch a kernel with ``count`` threads for each world, in parts."""
        self._regions.launch_from(kernel, (self._discretization.sizes.worlds, count), [0, *inputs], outputs, *key)
