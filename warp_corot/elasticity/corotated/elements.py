"""Force fields of the corotated model, element by element."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import warp as wp

from warp_corot.discretization.discretization import Discretization
from warp_corot.discretization.plan import Plan, Units
from warp_corot.elasticity.backends.in_lanes import InLanes
from warp_corot.elasticity.model import ForceField
from warp_corot.elasticity.stress_law import StressLaw
from warp_corot.elasticity.structs import Kept
from warp_corot.elasticity.tangent import Tangent
from warp_corot.inputs.loading import LoadedKernel
from warp_corot.kernels.corotated.corotated import (
    extract_rotations,
    given_cauchy,
    given_density,
    given_stress,
    own_stress,
    scatter_matrix_product,
)
from warp_corot.kernels.corotated.energy import own_energies, own_von_mises
from warp_corot.kernels.corotated.tangent import exact_differential
from warp_corot.kernels.elements.constitutive import IsotropicMaterial, RotatedMaterial
from warp_corot.kernels.elements.forces import element_energies, element_von_mises, scatter_forces
from warp_corot.kernels.math.rotation import quick_rotation
from warp_corot.kernels.subtrees.repair import repair_elements

from .tangents import ExactTangent, KeptTangent, RotatedTangent

if TYPE_CHECKING:
    from warp_corot.discretization.discretization import Discretization

    from .options import CorotatedOptions


@dataclass(frozen=True)
class Rotations:
    """Units and their rotations, mat33 [units]."""

    units: Units
    rotations: wp.array

    @classmethod
    def of(cls, units: Units) -> Rotations:
        return cls(units, wp.empty(units.count, dtype=wp.mat33, device=units.unit.device))


def rotated_material(isotropic: IsotropicMaterial, rotations: wp.array, unit: wp.array) -> RotatedMaterial:
    """Lamé's parameters with given rotations."""
    material = RotatedMaterial()
    material.isotropic, material.rotations, material.unit = isotropic, rotations, unit
    return material


class CorotatedField(ForceField):
    """Forces by one kernel if each element uses its own rotation; otherwise by two, rotations first."""

    #: Whether complete subtrees are units of work.
    takes_subtrees: ClassVar[bool] = False

    def __init__(self, discretization: Discretization, model: CorotatedOptions, deterministic: bool):
        self.model = model
        super().__init__(discretization, deterministic)
        kind = discretization.element_kind
        self._shared: Rotations | None = None
        self._fused = model.level is None and model.stiffness == "factored"
        self._rotated = Kept(rotated_material)
        self._extract = extract_rotations(kind, model.own_rotation)
        self._own = scatter_forces(kind, IsotropicMaterial, own_stress(model.own_rotation))
        if model.stiffness == "factored":
            self._forces = scatter_forces(kind, RotatedMaterial, given_stress)
        else:
            self._forces = scatter_matrix_product(model.stiffness == "sparse")
        self._has_own_outputs = model.level is None and model.own_rotation is quick_rotation
        if self._has_own_outputs:
            self._energies, self._von_mises = own_energies(kind), own_von_mises(kind)
        else:
            self._energies = element_energies(kind, RotatedMaterial, given_density)
            self._von_mises = element_von_mises(kind, RotatedMaterial, given_cauchy)

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
        self._shared = None

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
        return rotated_material(self.isotropic, rotations, self._sharing().units.unit)

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


class LeafField(CorotatedField):
    """Leaf by leaf."""

    def __init__(self, discretization: Discretization, model: CorotatedOptions, deterministic: bool):
        super().__init__(discretization, model, deterministic)
        if not self._fused:
            self._sharing()

    def follow(self) -> None:
        super().follow()
        if not self._fused:
            self._sharing()


class Simd8Field(InLanes, CorotatedField):
    """General elements on the CPU."""

    repair = repair_elements

    def __init__(self, discretization: Discretization, model: CorotatedOptions, deterministic: bool):
        super().__init__(discretization, model, deterministic)
        self.follow()

    @property
    def _force_kernels(self) -> list[LoadedKernel]:
        return self.other_kernels

    def scatter_forces(self, u: wp.array, f: wp.array) -> None:
        self.scatter_others(u, f)
