"""Force fields of the corotated model: leaf by leaf, general elements, and complete subtrees of a forest as units of
work."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import warp as wp

from warp_corot.discretization.discretization import Discretization
from warp_corot.discretization.plan import Batch, Plan, Sharing, Units
from warp_corot.elasticity.corotated.tangents import (
    FEWEST,
    ExactTangent,
    KeptTangent,
    RotatedTangent,
    SubtreeTangent,
    subtrees_of,
)
from warp_corot.elasticity.cpu import Dilating, SimdForces
from warp_corot.elasticity.cuda import CudaForces, CudaLaw, OwnForces
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
from warp_corot.kernels.elements.elements import ForestElements
from warp_corot.kernels.elements.forces import element_energies, element_von_mises, scatter_chosen, scatter_forces
from warp_corot.kernels.math.rotation import quick_rotation
from warp_corot.kernels.subtrees import cuda as subtree_cuda
from warp_corot.kernels.subtrees.degenerate import repair_own, robust_own_stress

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


# --- the fast path ---------------------------------------------------------------------------------------------------


class SubtreeField(CorotatedField):
    """The fast path: complete subtrees in batches, and only what is left over leaf by leaf; general meshes eight
    elements at a time or in clusters."""

    takes_subtrees = True

    def __init__(self, discretization: Discretization, model: CorotatedOptions, deterministic: bool):
        super().__init__(discretization, model, deterministic)
        self._uniform = discretization.material_stride == 0
        self._rotations = wp.empty(0, dtype=wp.mat33, device=self.device)
        self._no_unit = wp.empty(0, dtype=wp.int32, device=self.device)
        if self.device.is_cpu:
            law = {"repair": robust_own_stress, "tolerance": model.tolerance}
            self._fast = SimdForces(discretization, self.plan, "corotated", lambda: self.isotropic, **law)
        elif self._listed and discretization.element_kind is ForestElements:
            self._fast = OwnForces(self)
        else:
            self._fast = CudaForces(self, self._cuda_law())
        self._take_units()
        self.derive()

    def _cuda_law(self) -> CudaLaw:
        own = IsotropicMaterial, own_stress(self.model.own_rotation)
        Material, stress = own if self.rotation_level is None else (RotatedMaterial, given_stress)
        cluster = isotropic_law(corotated_stress) if self._listed else None
        repair = {"repair": repair_own, "repaired": lambda: self.isotropic}
        return CudaLaw(stress, self._of_leaves, Material, self._kernel, cluster, self._of_batch, **repair)

    def _kernel(self, shape: int, grouped: bool, sharing: Sharing) -> wp.Kernel:
        if sharing is Sharing.OWN:
            return subtree_cuda.scatter_subtrees_own(shape, grouped, self._uniform, False)
        return subtree_cuda.scatter_subtrees_shared(shape, grouped, self._uniform, sharing is Sharing.ABOVE)

    def _of_leaves(self) -> IsotropicMaterial | RotatedMaterial:
        """The material of leaves one by one."""
        if self.rotation_level is None:
            return self.isotropic
        return self._rotated(self.isotropic, self._rotations, self._sharing().units.unit)

    def _of_batch(self, batch: Batch | None) -> IsotropicMaterial | RotatedMaterial:
        """The material of subtrees, or of clusters."""
        if batch is None or batch.sharing is Sharing.OWN:
            return self.isotropic
        kept = self._batch_materials.setdefault(batch, Kept(RotatedMaterial, *ROTATED))
        return kept(self.isotropic, self._rotations, self._no_unit if batch.unit is None else batch.unit)

    @property
    def _force_kernels(self) -> list[LoadedKernel]:
        assert self._fast is not None
        return [*self._fast.kernels, *([self._extract, *self._of_units] if self.plan.units is not None else [])]

    @property
    def _of_units(self) -> list[LoadedKernel]:
        """The kernel of leaves outside subtrees on the CPU, if these use rotations from further up."""
        given = self.discretization.element_kind, RotatedMaterial, given_stress
        return [scatter_chosen(*given)] if self.device.is_cpu and self.rotation_level is not None else []

    def load_kernels(self) -> None:
        super().load_kernels()
        load((), self.device, [self._extract, repair_own, *self._of_units])

    def share_dilatation(self, dilating: Dilating) -> bool:
        own = all(sharing is Sharing.OWN for _shape, _grouped, sharing in self.plan.kinds)
        return own and super().share_dilatation(dilating)

    def tangent(self, *, exact: bool = False) -> Tangent:
        if not exact and self.model.level is None and self._listed and self.element_count >= FEWEST:
            batches = subtrees_of(self.plan)
            if batches is not None:
                return SubtreeTangent(self, batches)
        return super().tangent(exact=exact)

    def follow(self) -> None:
        super().follow()
        self._take_units()

    def _take_units(self) -> None:
        """Make room for the rotations of the present plan's units."""
        self._batch_materials: dict[Batch, Kept[RotatedMaterial]] = {}
        if self.plan.units is not None:
            self._shared = Rotations.of(self.plan.units)
            self._rotations = self._shared.rotations
        elif self.rotation_level is not None:
            self._sharing()
        if isinstance(self._fast, SimdForces):
            self._fast.rotations = self._rotations

    @property
    def _listed(self) -> bool:
        """Whether each leaf has its own rotation, and sums may have any order on CUDA."""
        return self.device.is_cuda and not self.deterministic and self.rotation_level is None

    def scatter_forces(self, u: wp.array, f: wp.array) -> None:
        assert self._fast is not None
        plan, flat = self.plan, self.plan.flat
        if plan.units is not None:
            self.extract_rotations(u)
        self._fast.scatter_forces(u, f)
        if len(flat) and plan.units is not None:
            for kernel in self._of_units:
                self.launch(kernel, len(flat), [self.elements, flat.leaves, self._of_leaves(), u], [f])
