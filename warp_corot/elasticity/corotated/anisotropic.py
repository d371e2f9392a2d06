"""Corotated elasticity of anisotropic materials, with active stress along the fibres."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import warp as wp

from warp_corot.discretization.elements import E, copied
from warp_corot.elasticity.backends.simd8 import Lanes, as_general
from warp_corot.elasticity.model import ElementField
from warp_corot.elasticity.structs import Kept
from warp_corot.inputs.loading import LoadedKernel
from warp_corot.kernels.corotated.anisotropic import (
    FibreMaterial,
    OrthotropicMaterial,
    active_density,
    fibre_cauchy,
    fibre_density,
    fibre_stress,
)
from warp_corot.kernels.corotated.anisotropic_simd8 import scatter_anisotropic_simd8, turn_changed, turn_elements
from warp_corot.kernels.corotated.anisotropic_tangent import anisotropic_differential
from warp_corot.kernels.elements.forces import element_energies, repair_forces
from warp_corot.kernels.math.rotation import byers_xu

if TYPE_CHECKING:
    from warp_corot.discretization.discretization import Discretization


class FibreField(ElementField):
    """Force field of a material with directions, along the first of which there may be an active stress.

    Args:
        discretization, functions: As for ``ElementField``.

    Attributes:
        passive: The material without the active stress.
    """

    takes_anisotropic: ClassVar[bool] = True

    def __init__(self, discretization: Discretization, **functions: Any):
        super().__init__(discretization, **functions)
        self.passive = discretization.anisotropic_material()
        self._fibres = Kept(fibre_material)

    @property
    def fibres(self) -> FibreMaterial:
        """The material with directions, with the present active stress."""
        return self._fibres(self.passive, *self._activation)

    @property
    def _activation(self) -> list:
        return [int(self.discretization.has_activation), self.discretization.activation]

    def write_energies(self, u: wp.array, energies: wp.array) -> None:
        # In one part: ``part_of`` does not cut materials with directions.
        self.launch(self._energies, self.element_count, [self.elements, self.material, u], [energies])

    def write_potentials(self, u: wp.array, energies: wp.array) -> None:
        self.write_energies(u, energies)
        if self.discretization.has_activation:
            kernel = element_energies(self.discretization.element_kind, FibreMaterial, active_density, adds=True)
            self.launch(kernel, self.element_count, [self.elements, self.fibres, u], [energies])


class AnisotropicField(FibreField):
    """W = V/2 e : C : e with e = sym(R^T F) - I, R the element's own rotation, C fixed in rest space.

    The force is the gradient of W, with the derivative of R, which isotropic materials do not need, and conserves
    linear and angular momentum. If the rotation of F is ill-defined (F is inverted, or flattened to a sixth in two
    directions, as by fibres that stretch 3.4 times; see ``kernels.corotated.anisotropic``), C blends into that of the
    nearest isotropic material, and the force is the gradient of that energy.

    The active stress of ``SoftBody.activation`` is added: P = s (F d) d^T along the fibres' direction d. It conserves
    both momenta. It does work, and has no energy.

    The stiffness is exact, with the derivative of R, at the present active stress; it is bounded if the rotation of F
    is ill-defined (``kernels.corotated.tangent``).

    Args:
        discretization: A discretization with an ``Anisotropic`` material.
        rotation: The device function that finds rotations.
        deterministic: As for every field.
    """

    def __init__(self, discretization: Discretization, rotation: wp.Function, deterministic: bool):
        super().__init__(
            discretization,
            stress=fibre_stress(rotation),
            differential=anisotropic_differential(rotation),
            density=fibre_density(rotation),
            cauchy=fibre_cauchy(rotation),
            Material=FibreMaterial,
            deterministic=deterministic,
        )

    @property
    def material(self) -> FibreMaterial:
        return self.fibres

    @property
    def material_shown(self) -> FibreMaterial:
        return self.fibres


def fibre_material(passive: OrthotropicMaterial, is_active: int, activation: wp.array) -> FibreMaterial:
    """An orthotropic material with an active stress."""
    material = FibreMaterial()
    material.passive, material.is_active, material.activation = passive, is_active, activation
    return material


class AnisotropicSimd8Field(AnisotropicField):
    """On the CPU, eight elements at a time."""

    def __init__(self, discretization: Discretization, rotation: wp.Function, deterministic: bool):
        super().__init__(discretization, rotation, deterministic)
        # The elements as general ones, with rest matrices in the material's axes.
        inputs = [self.elements, self.passive]
        self._general = as_general(self.elements, turn_elements(discretization.element_kind), inputs)
        self.follow()

    @property
    def _force_kernels(self) -> list[LoadedKernel]:
        repair = repair_forces(self.discretization.element_kind, FibreMaterial, fibre_stress(byers_xu))
        return [scatter_anisotropic_simd8, repair]

    def follow(self) -> None:
        scatter, repair = self._force_kernels
        elements, general = (_first(each, self.element_count) for each in (self.elements, self._general))
        self._lanes = Lanes(elements, general, scatter=scatter, repair=repair)

    def derive(self) -> None:
        counts = self.plan.counts
        assert counts is not None
        inputs = [counts.threads, counts.goes, counts.now, counts.before, self.elements, self.passive]
        self.launch(turn_changed, counts.threads, inputs, [self._general.rest_inverse, self._general.volume])

    def scatter_forces(self, u: wp.array, f: wp.array) -> None:
        self._lanes.scatter_forces(self.fibres, u, f)


def _first(elements: E, count: int) -> E:
    """The first elements of either kind."""
    some = copied(elements)
    some.nodes = some.targets = elements.nodes[:count]
    return some
