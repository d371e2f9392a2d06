"""Force fields of the corotated model: leaf by leaf, general elements, and complete subtrees of a forest as units of
work."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import warp as wp

from warp_corot.discretization.discretization import Discretization
from warp_corot.discretization.plan import Batch, Plan, Sharing, Units
from warp_corot.discretization.planner import places_on
from warp_corot.elasticity.clusters import ChangingClusterScatter, ClusterScatter, clustered
from warp_corot.elasticity.corotated.launches import DegenerateLeaves, OwnLaunches
from warp_corot.elasticity.corotated.tangents import (
    FEWEST,
    ExactTangent,
    KeptTangent,
    RotatedTangent,
    SubtreeTangent,
    subtrees_of,
)
from warp_corot.elasticity.cpu import Dilating, SimdForces
from warp_corot.elasticity.model import ROTATED, ForceField, Kept, StressLaw
from warp_corot.elasticity.tangents import Tangent
from warp_corot.inputs.loading import LoadedKernel, load
from warp_corot.kernels.clusters.laws import isotropic_law
from warp_corot.kernels.corotated.corotated import (
    corotated_stress,
    extract_rotations,
    given_cauchy,
    given_density,
    given_stress,
    own_energies,
    own_stress,
    own_von_mises,
)
from warp_corot.kernels.corotated.tangent import exact_differential
from warp_corot.kernels.elements.constitutive import IsotropicMaterial, RotatedMaterial
from warp_corot.kernels.elements.forces import element_energies, element_von_mises, scatter_chosen, scatter_forces
from warp_corot.kernels.math.rotation import quick_rotation
from warp_corot.kernels.subtrees import cuda as subtree_cuda
from warp_corot.kernels.subtrees.degenerate import NO_LIST, repair_own, repair_shared, robust_own_stress
from warp_corot.kernels.subtrees.memory import BLOCK

if TYPE_CHECKING:
    from warp_corot.elasticity.corotated.model import CorotatedOptions


@dataclass(frozen=True)
class Rotations:
    """Units and their rotations, mat33 [units]."""

    units: Units
    rotations: wp.array

    @classmethod
    def of(cls, units: Units) -> Rotations:
        return cls(units, wp.empty(units.count, dtype=wp.mat33, device=units.unit.device))


class CorotatedField(ForceField):
    """Forces leaf by leaf, by one kernel if each element uses its own rotation; otherwise by two, rotations first."""

    #: Whether complete subtrees are units of work.
    takes_subtrees: ClassVar[bool] = False

    def __init__(self, discretization: Discretization, model: CorotatedOptions, deterministic: bool):
        self.model = model
        super().__init__(discretization, deterministic)
        kind = discretization.element_kind
        self._shared: Rotations | None = None
        self._fused = model.level is None
        self._rotated = Kept(RotatedMaterial, *ROTATED)
        self._extract = extract_rotations(kind, model.own_rotation)
        self._own = scatter_forces(kind, IsotropicMaterial, own_stress(model.own_rotation))
        self._forces = scatter_forces(kind, RotatedMaterial, given_stress)
        self._has_own_outputs = model.level is None and model.own_rotation is quick_rotation
        if self._has_own_outputs:
            self._energies, self._von_mises = own_energies(kind), own_von_mises(kind)
        else:
            self._energies = element_energies(kind, RotatedMaterial, given_density)
            self._von_mises = element_von_mises(kind, RotatedMaterial, given_cauchy)
        if not self.takes_subtrees:
            self.follow()

    @property
    def kernels(self) -> list[LoadedKernel]:
        of_rotations = [] if self._has_own_outputs else [self._extract]
        return [*self._force_kernels, *of_rotations, self._von_mises, self._energies]

    @property
    def _force_kernels(self) -> list[LoadedKernel]:
        return [self._own if self._fused else self._forces]

    @property
    def rotation_level(self) -> int | None:
        """Level of the tree at which rotations are shared, or None."""
        return self.model.level

    def plan_of(self, discretization: Discretization) -> Plan:
        return discretization.plan(self.rotation_level, subtrees=self.takes_subtrees, deterministic=self.deterministic)

    def follow(self) -> None:
        super().follow()
        self._shared = None
        if not self.takes_subtrees and not self._fused:
            self._sharing()

    @property
    def unit_count(self) -> int:
        """The number of rotations."""
        return self._sharing().units.count

    def extract_rotations(self, u: wp.array) -> wp.array:
        """The rotation of every unit, mat33 [units]."""
        rotations = self._sharing().rotations
        self.write_rotations(u, rotations)
        return rotations

    def add_rotated_forces(self, u: wp.array, f: wp.array) -> None:
        """Add forces with the rotations that were extracted last."""
        self._launch_with_rotations(self._forces, self.isotropic, u, f)

    def scatter_forces(self, u: wp.array, f: wp.array) -> None:
        if self._fused:
            self.launch(self._own, self.element_count, [self.elements, self.isotropic, u], [f])
        else:
            self.extract_rotations(u)
            self.add_rotated_forces(u, f)

    def tangent(self, *, exact: bool = False) -> Tangent:
        """The paper's K = R K R^T, with the rotations that forces at u use, held fixed; it is positive semidefinite.

        The exact derivative of the forces also has the derivative of the rotations, which vanishes if the body is not
        strained. It can be indefinite, and is bounded if the rotation of F is ill-defined
        (``kernels.corotated.tangent``). With shared rotations, K is never the exact derivative; with rotations within a
        tolerance, K has each element's own.
        """
        if self.rotation_level is not None:
            return RotatedTangent(self)
        exact = exact and self.model.rotation_level is None
        if self.device.is_cpu and self.plan.counts is None:
            return KeptTangent(self, exact)
        return ExactTangent(self, self.model.own_rotation) if exact else RotatedTangent(self)

    def write_rotations(self, u: wp.array, rotations: wp.array) -> None:
        """Write the rotation of every unit, mat33 [units]."""
        units = self._sharing().units
        self.launch(self._extract, units.count, [units.elements, u], [rotations])

    def material_with(self, rotations: wp.array) -> RotatedMaterial:
        """The material with these rotations of the units."""
        return Kept(RotatedMaterial, *ROTATED)(self.isotropic, rotations, self._sharing().units.unit)

    @property
    def stress_law(self) -> StressLaw | None:
        """See ``ForceField.stress_law``; None with shared rotations."""
        if self.model.rotation_level is not None:
            return None
        rotation = self.model.own_rotation
        return StressLaw(own_stress(rotation), exact_differential(rotation), self.isotropic)

    def write_energies(self, u: wp.array, energies: wp.array) -> None:
        self._write(self._energies, self.isotropic, u, energies)

    def write_von_mises(self, u: wp.array, stress: wp.array) -> None:
        self._write(self._von_mises, self.isotropic_shown, u, stress)

    def _write(self, kernel: wp.Kernel, isotropic: IsotropicMaterial, u: wp.array, output: wp.array) -> None:
        if self._has_own_outputs:
            self._launch_over_elements(kernel, isotropic, u, output)
            return
        self.extract_rotations(u)
        self._launch_with_rotations(kernel, isotropic, u, output)

    def _sharing(self) -> Rotations:
        """The units whose rotations elements use; made on first use, because forces with own rotations do not need
        them.
        """
        if self._shared is None:
            self._shared = Rotations.of(self._units())
        return self._shared

    def _units(self) -> Units:
        if self.rotation_level is None:
            return Units.own(self.elements, self.element_count)
        return self.plan.all_units

    def _launch_with_rotations(
        self, kernel: wp.Kernel, isotropic: IsotropicMaterial, u: wp.array, output: wp.array
    ) -> None:
        shared = self._sharing()
        material = self._rotated(isotropic, shared.rotations, shared.units.unit)
        self.launch(kernel, self.element_count, [self.elements, material, u], [output])


# --- elements in clusters on CUDA ------------------------------------------------------------------------------------


class CorotatedGeneralField(CorotatedField):
    """General elements with own rotations."""

    def __init__(self, discretization: Discretization, model: CorotatedOptions):
        super().__init__(discretization, model, deterministic=False)
        law = isotropic_law(corotated_stress)
        self._scatter = ClusterScatter(self.elements, law, chosen=clustered(discretization))

    @property
    def _force_kernels(self) -> list[LoadedKernel]:
        return [self._scatter.kernel]

    @property
    def in_clusters(self) -> tuple[ClusterScatter, Sequence[Batch]]:
        return self._scatter, ()

    def scatter_forces(self, u: wp.array, f: wp.array) -> None:
        self._scatter(self.isotropic, u, f)


# --- complete subtrees -----------------------------------------------------------------------------------------------
#
# The fast path of the corotated model: complete subtrees of a forest as units of work; see ``plan``.
#
# On CUDA with own rotations a body is at most three launches: subtrees, other leaves, and the leaves that the first
# left out.


class SubtreeField(CorotatedField):
    """The fast path: complete subtrees in batches, leaf by leaf only what is left over; general meshes on the CPU."""

    takes_subtrees = True

    def __init__(self, discretization: Discretization, model: CorotatedOptions, deterministic: bool):
        super().__init__(discretization, model, deterministic)
        self._uniform = discretization.material_stride == 0
        if self.device.is_cpu:
            law = {"repair": robust_own_stress, "tolerance": model.tolerance}
            self._simd = SimdForces(discretization, self.plan, "corotated", lambda: self.isotropic, **law)
        #: Adds the forces of all leaves, also of those that come later.
        self._clusters: ChangingClusterScatter | None = None
        if self._listed and self.rotation_level is None:
            self._clusters = ChangingClusterScatter.of(discretization, self.plan, isotropic_law(corotated_stress))
        self.follow()
        self.derive()

    def derive(self) -> None:
        super().derive()
        if self._clusters is not None:
            self._clusters.derive()

    @property
    def _force_kernels(self) -> list[LoadedKernel]:
        if self._own_launches is not None:
            return [*self._own_launches.kernels, DegenerateLeaves.kernel]
        if self._simd is not None:
            given = [self._extract, self._of_flat] if self.plan.units is not None else []
            return [*self._simd.kernels, *given]
        of_subtrees: list[LoadedKernel] = [(self._kernel(*kind), BLOCK) for kind in self.plan.kinds]
        return [*of_subtrees, *([self._of_flat] if len(self.plan.flat) else [])]

    @property
    def _of_flat(self) -> wp.Kernel:
        """The kernel of leaves outside subtrees."""
        if self.rotation_level is None:
            law: tuple[type, wp.Function] = IsotropicMaterial, own_stress(self.model.own_rotation)
        else:
            law = RotatedMaterial, given_stress
        return scatter_chosen(self.discretization.element_kind, *law)

    def load_kernels(self) -> None:
        one_launch = self._listed and self.rotation_level is None
        kinds = () if one_launch or self._simd is not None else self.plan.kinds
        found: list[LoadedKernel] = [(self._kernel(*kind), BLOCK) for kind in kinds]
        found += [self._of_flat, self._extract, repair_own]
        found += [] if self._simd is None else self._simd.kernels
        found += [DegenerateLeaves.kernel] if self._listed else []
        load((), self.device, [*found, *([OwnLaunches.later_kernel(self._uniform)] if one_launch else [])])

    def share_dilatation(self, dilating: Dilating) -> bool:
        own = all(sharing is Sharing.OWN for _shape, _grouped, sharing in self.plan.kinds)
        return own and super().share_dilatation(dilating)

    def tangent(self, *, exact: bool = False) -> Tangent:
        if not exact and self.model.level is None and self._listed and self.element_count >= FEWEST:
            batches = subtrees_of(self.plan)
            if batches is not None:
                return SubtreeTangent(self, batches)
        return super().tangent(exact=exact)

    @property
    def in_clusters(self) -> tuple[ClusterScatter, Sequence[Batch]] | None:
        return None if self._own_launches is None else self._own_launches.in_clusters

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
            if self.rotation_level is None:
                given = self.isotropic, self._clusters, self.discretization.awaited
                self._own_launches = OwnLaunches(plan, *given)
                self._degenerate = DegenerateLeaves(self._own_launches.places, [], self.device)
                return
            self._degenerate = DegenerateLeaves.of(plan, self.device)
        if self._simd is not None:
            self._simd.rotations = self._rotations
            return
        self._kernels = [self._kernel(batch.shape, batch.grouped, batch.sharing) for batch in plan.batches]
        self._batch_materials = [Kept(RotatedMaterial, *ROTATED) for _ in plan.batches]

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
        plan, flat = self.plan, self.plan.flat
        if plan.units is not None:
            self.extract_rotations(u)
        if self._simd is not None:
            self._simd.scatter_forces(u, f)
        else:
            for batch, kernel, kept in zip(plan.batches, self._kernels, self._batch_materials, strict=True):
                self._launch_batch(batch, kernel, kept, u, f)
        if len(flat) and (self._simd is None or plan.units is not None):
            material: Any = self.isotropic
            if self.rotation_level is not None:
                material = self._rotated(material, self._rotations, self._sharing().units.unit)
            self.launch(self._of_flat, len(flat), [self.elements, flat.leaves, material, u], [f])
        if self._degenerate is not None:
            self._degenerate.repair(self.elements, self.isotropic, u, f)

    def _kernel(self, shape: int, grouped: bool, sharing: Sharing) -> wp.Kernel:
        if sharing is Sharing.OWN:
            return subtree_cuda.scatter_subtrees_own(shape, grouped, self._uniform, self._listed)
        given = sharing is Sharing.ABOVE
        return subtree_cuda.scatter_subtrees_shared(shape, grouped, self._uniform, given, self._listed)

    def _launch_batch(
        self, batch: Batch, kernel: wp.Kernel, kept: Kept[RotatedMaterial], u: wp.array, f: wp.array
    ) -> None:
        own, degenerate = batch.sharing is Sharing.OWN, self._degenerate
        unit = self._no_unit if batch.unit is None else batch.unit
        material = self.isotropic if own else kept(self.isotropic, self._rotations, unit)
        outputs = [f, batch.flagged, NO_LIST if degenerate is None else degenerate.list_of(batch)]
        inputs = [batch.subtrees, material, u]
        wp.launch(kernel, batch.count, inputs, outputs, device=self.device, block_dim=BLOCK)
        if degenerate is not None or not batch.count:
            return
        flags = batch.flags_by_eights
        inputs = [self.elements, self.isotropic, u]
        if own:
            self.launch(repair_own, len(flags), [1, flags, batch.subtrees.first, *inputs], [f])
        elif batch.sharing is Sharing.ROOT:
            where = [flags, batch.subtrees.first, batch.subtrees.code, places_on(self.device.alias).subtree]
            self.launch(repair_shared, len(flags), [*where, *inputs], [f])
