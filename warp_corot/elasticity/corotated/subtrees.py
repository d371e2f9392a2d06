"""The fast path of the corotated model: complete subtrees of a forest as units of work; see ``plan``.

On CUDA with own rotations a body is at most three launches: subtrees, other leaves, and the leaves that the first
left out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, TypeAlias

import warp as wp

from warp_corot.discretization.subtrees import Batch, Sharing
from warp_corot.elasticity.backends.clusters import ClusterScatter
from warp_corot.elasticity.backends.in_lanes import InLanes
from warp_corot.elasticity.backends.mean_dilatation import Dilating
from warp_corot.elasticity.structs import Kept
from warp_corot.elasticity.tangent import Tangent
from warp_corot.inputs.cpu_threads import launch
from warp_corot.inputs.loading import LoadedKernel, load
from warp_corot.kernels.elements.constitutive import IsotropicMaterial, RotatedMaterial
from warp_corot.kernels.elements.simd8 import LANES
from warp_corot.kernels.subtrees import cpu as subtree_cpu
from warp_corot.kernels.subtrees import cuda as subtree_cuda
from warp_corot.kernels.subtrees.repair import repair_elements, repair_own, repair_shared

from .degenerate import DegenerateLeaves
from .elements import (
    CorotatedField,
    Rotations,
    rotated_material,
)
from .own_launches import OwnLaunches
from .subtree_tangent import FEWEST, SubtreeTangent, subtrees_of

if TYPE_CHECKING:
    from warp_corot.discretization.discretization import Discretization

    from .options import CorotatedOptions


#: The structs that kernels of lanes read.
LanesMaterial: TypeAlias = (
    "IsotropicMaterial | RotatedMaterial | subtree_cpu.ToleranceMaterial | subtree_cpu.DilatingMaterial"
)


class SubtreeField(InLanes, CorotatedField):
    """The fast path: complete subtrees in batches, leaf by leaf only what is left over."""

    takes_subtrees = True
    repair = repair_elements

    def __init__(self, discretization: Discretization, model: CorotatedOptions, deterministic: bool):
        super().__init__(discretization, model, deterministic)
        self._uniform = discretization.material_stride == 0
        self.follow()
        self.derive()

    @property
    def _force_kernels(self) -> list[LoadedKernel]:
        if self._own_launches is not None:
            return [*self._own_launches.kernels, DegenerateLeaves.kernel]
        of_subtrees: list[LoadedKernel] = [(self._kernel(*kind), self._block) for kind in self.plan.kinds]
        if self._dilating is not None or self._lanes is not None:
            return [*of_subtrees, *self.other_kernels]
        of_leaves = [self._own if self.plan.flat.unit is None else self._forces] if len(self.plan.flat) else []
        return [*of_subtrees, *of_leaves]

    def load_kernels(self) -> None:
        one_launch = self._listed and self.rotation_level is None
        kinds = () if one_launch else self.plan.kinds
        found: list[LoadedKernel] = [(self._kernel(*kind), self._block) for kind in kinds]
        found += [self._forces, self._own, self._extract, repair_own]
        found += self.other_kernels if self.device.is_cpu else []
        found += [DegenerateLeaves.kernel] if self._listed else []
        load((), self.device, [*found, *([OwnLaunches.later_kernel(self._uniform)] if one_launch else [])])

    def share_dilatation(self, dilating: Dilating) -> bool:
        if any(sharing is not Sharing.OWN for _shape, _grouped, sharing in self.plan.kinds):
            return False
        return super().share_dilatation(dilating)

    def tangent(self, *, exact: bool = False) -> Tangent:
        own = self.model.level is None and self._tolerance is None
        if not exact and own and self._listed and self.element_count >= FEWEST:
            batches = subtrees_of(self.plan)
            if batches is not None:
                return SubtreeTangent(self, batches)
        return super().tangent(exact=exact)

    @property
    def in_clusters(self) -> tuple[ClusterScatter, Sequence[Batch]] | None:
        return None if self._own_launches is None else self._own_launches.in_clusters

    @property
    def _block(self) -> int:
        return subtree_cuda.BLOCK if self.device.is_cuda else 256

    def follow(self) -> None:
        super().follow()
        plan = self.plan
        self._rotations = wp.empty(0, dtype=wp.mat33, device=self.device)
        self._no_unit = wp.empty(0, dtype=wp.int32, device=self.device)
        if plan.units is not None:
            self._shared = Rotations.of(plan.units)
            self._rotations = self._shared.rotations
        elif self.rotation_level is not None:
            self._sharing()
        self._degenerate: DegenerateLeaves | None = None
        self._own_launches: OwnLaunches | None = None
        if self._listed:
            if self.rotation_level is None and (OwnLaunches.suit(plan) or self.discretization.awaited is not None):
                self._own_launches = OwnLaunches(plan, self.isotropic, self.discretization.awaited)
                self._degenerate = DegenerateLeaves(self._own_launches.places, [], self.device)
                return
            self._degenerate = DegenerateLeaves.of(plan, self.device)
        self._kernels = [self._kernel(batch.shape, batch.grouped, batch.sharing) for batch in plan.batches]
        self._materials = [self._material(batch) for batch in plan.batches]
        self._flat_rotated = Kept(rotated_material)

    @property
    def _tolerance(self) -> float | None:
        """The model's tolerance on the CPU; on CUDA sharing within one gained 7 % at most, so there is none."""
        return self.model.tolerance if self.device.is_cpu else None

    @property
    def _listed(self) -> bool:
        """Whether kernels list the leaves that they leave out, in any order."""
        return self.device.is_cuda and not self.deterministic

    def scatter_forces(self, u: wp.array, f: wp.array) -> None:
        if self._own_launches is not None:
            assert self._degenerate is not None
            self._own_launches.scatter_forces(u, f, self._degenerate.own)
            self._degenerate.repair(self.elements, self.isotropic, u, f)
            return
        if self.plan.units is not None:
            self.extract_rotations(u)
        for batch, kernel, material in zip(self.plan.batches, self._kernels, self._materials, strict=True):
            self._launch_batch(batch, kernel, material, u, f)
        flat = self.plan.flat
        if self._dilating is not None or self._lanes is not None:
            self.scatter_others(u, f)
        elif len(flat) and flat.unit is not None:
            rotated = self._flat_rotated(self._flat_material, self._rotations, flat.unit)
            self.launch(self._forces, len(flat), [flat.elements, rotated, u], [f])
        elif len(flat):
            self.launch(self._own, len(flat), [flat.elements, self._flat_material, u], [f])
        if self._degenerate is not None:
            self._degenerate.repair(self.elements, self.isotropic, u, f)

    def _kernel(self, shape: int, grouped: bool, sharing: Sharing) -> wp.Kernel:
        given = sharing is Sharing.ABOVE
        if self.device.is_cuda:
            if sharing is Sharing.OWN:
                return subtree_cuda.scatter_subtrees_own(shape, grouped, self._uniform, self._listed)
            return subtree_cuda.scatter_subtrees_shared(shape, grouped, self._uniform, given, self._listed)
        if sharing is Sharing.OWN:
            dilatation = None if self._dilating is None else self._dilating.of
            if self._tolerance is not None:
                return subtree_cpu.scatter_subtrees_tolerance(shape, dilatation)
            return subtree_cpu.scatter_law_subtrees(shape, shared=dilatation)
        return subtree_cpu.scatter_subtrees_shared(shape, given)

    def _material(self, batch: Batch) -> Callable[[], LanesMaterial]:
        """The function that makes the struct that a kernel of lanes reads."""
        if batch.sharing is not Sharing.OWN:
            rotated, unit = Kept(rotated_material), self._no_unit if batch.unit is None else batch.unit
            return lambda: rotated(self.isotropic, self._rotations, unit)
        if self._dilating is not None:
            dilating = self._dilating
            return lambda: dilating.material(self.isotropic, self._tolerance)
        if self._tolerance is not None:
            near, tolerance = Kept(near_material), self._tolerance
            return lambda: near(self.isotropic, tolerance)
        return lambda: self.isotropic

    def _launch_batch(
        self, batch: Batch, kernel: wp.Kernel, material: Callable[[], LanesMaterial], u: wp.array, f: wp.array
    ) -> None:
        own = batch.sharing is Sharing.OWN
        outputs = [f, batch.flagged]
        if self.device.is_cuda:
            threads = batch.count
            if own:
                inputs = [batch.subtrees, self.isotropic, u]
            else:
                unit = self._no_unit if batch.unit is None else batch.unit
                inputs = [batch.subtrees, self.isotropic, u, self._rotations, unit]
            outputs.append(DegenerateLeaves.NONE if self._degenerate is None else self._degenerate.list_of(batch))
        else:
            threads = -(-batch.count // LANES)
            inputs = [batch.subtrees, batch.count, material(), u]
        launch(kernel, threads, inputs, outputs, device=self.device, block_dim=self._block)
        if self._degenerate is not None or not batch.count:
            return
        flags = batch.flags_by_eights
        inputs = [self.elements, self.isotropic, u]
        if own:
            self.launch(repair_own, len(flags), [1, flags, batch.subtrees.first, *inputs], [f])
        elif batch.sharing is Sharing.ROOT:
            self.launch(repair_shared, len(flags), [flags, batch.subtrees.first, batch.roots, *inputs], [f])


def near_material(isotropic: IsotropicMaterial, tolerance: float) -> subtree_cpu.ToleranceMaterial:
    material = subtree_cpu.ToleranceMaterial()
    material.isotropic, material.tolerance = isotropic, tolerance
    return material
