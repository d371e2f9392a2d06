"""Springs: St. Venant-Kirchhoff elasticity on the edges of each tetrahedron, and the mass-spring network."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import warp as wp

from warp_corot.discretization.discretization import Discretization, Discretized, discretization_of
from warp_corot.discretization.elements import in_worlds, repeated
from warp_corot.discretization.plan import Plan, Slots
from warp_corot.elasticity.dilatation import ELEMENT, refuse_shared
from warp_corot.elasticity.laws import StVenantKirchhoff
from warp_corot.elasticity.model import ElementField, ForceField, Model, StressLaw, isotropic_material
from warp_corot.elasticity.tangents import Tangent
from warp_corot.inputs.checks import checked_choice
from warp_corot.kernels.elements.constitutive import IsotropicMaterial, law_functions
from warp_corot.kernels.elements.forces import element_von_mises, law_cauchy
from warp_corot.kernels.elements.springs import (
    add_mass_spring_diagonal,
    add_mass_spring_product,
    mass_spring_energies,
    scatter_mass_spring,
    spring_density,
    spring_differential,
    spring_stress,
)
from warp_corot.kernels.tables.shapes import EDGES


class SpringField(ElementField):
    """Force field of quadratic springs, whose stress depends on where an element has its edges."""

    @property
    def stress_law(self) -> StressLaw:
        return replace(super().stress_law, sees_shape=True)


@dataclass(frozen=True)
class EdgeStVK(Model):
    """W = D^T K D / 2 over an element's six edges (Delingette 2008; Kikuuwe, Tabuchi and Yamamoto 2009).

    Attributes:
        springs: "biquadratic": D = l^2 - L^2, which is ``StVenantKirchhoff``, whose forces it has; "quadratic": D = 2 L
            (l - L), its small-strain form.
        dilatation: "element", the only value for springs.
    """

    springs: str = "biquadratic"
    dilatation: str = ELEMENT

    def __post_init__(self) -> None:
        checked_choice(self.springs, "springs", ("biquadratic", "quadratic"))
        refuse_shared(self.dilatation, "EdgeStVK")

    def bind(self, body: Discretized | Discretization, *, deterministic: bool = False) -> ForceField:
        if self.springs == "biquadratic":
            return StVenantKirchhoff(ELEMENT).bind(body, deterministic=deterministic)
        return SpringField(
            body,
            stress=spring_stress,
            differential=spring_differential,
            density=spring_density,
            cauchy=law_cauchy(law_functions("stvk").stress),
            deterministic=deterministic,
        )


# --- the mass-spring network, the classic baseline -------------------------------------------------------------------


@dataclass(frozen=True)
class MassSpring(Model):
    """W = sum over edges of k/2 (l - L)^2, with k = sum of E V / L^2 over the tetrahedra around an edge.

    The stiffness is Van Gelder's (1998), extended to three dimensions: averaged over all directions of edges, it gives
    Young's modulus E and Poisson's ratio 1/4. Springs between pairs of points cannot have another ratio, so the
    material's ratio is ignored. The von Mises stress is that of Hooke's law with E and 1/4 for the Green strain.

    Attributes:
        dilatation: "element", the only value for springs.
    """

    dilatation: str = ELEMENT

    def __post_init__(self) -> None:
        refuse_shared(self.dilatation, "MassSpring")

    @property
    def kept_of_elements(self) -> str | None:
        return "the model MassSpring has springs along the edges that it begins with"

    def bind(self, body: Discretized | Discretization, *, deterministic: bool = False) -> ForceField:
        discretization = discretization_of(body)
        return MassSpringField(discretization, deterministic)


class MassSpringField(ForceField):
    def plan_of(self, discretization: Discretization) -> Plan:
        return discretization.plan(subtrees=False)  # the slots belong to edges

    def __init__(self, discretization: Discretization, deterministic: bool = False):
        super().__init__(discretization, deterministic)
        points, tets, worlds = discretization.mesh.points, discretization.mesh.tets, discretization.worlds
        pairs = np.stack([tets[:, edge] for edge in EDGES], axis=1)
        lengths = np.linalg.norm(points[pairs[..., 1]] - points[pairs[..., 0]], axis=-1)
        key = pairs.min(axis=-1).astype(np.int64) * len(points) + pairs.max(axis=-1)
        unique, which = np.unique(key.ravel(), return_inverse=True)
        # A row for each world whose stiffness may differ.
        young = np.atleast_2d(discretization.material.young)
        held = (
            discretization.mesh.volumes
            if discretization.fill is None
            else discretization.mesh.volumes * discretization.fill
        )
        stiffness = np.stack(
            [
                np.bincount(which.ravel(), ((row * held)[:, None] / lengths**2).ravel())
                for row in np.broadcast_to(young, (len(young), len(tets)))
            ]
        )
        edges = np.stack([unique // len(points), unique % len(points)], axis=1).astype(np.int32)
        rest = points[edges[:, 1]] - points[edges[:, 0]]
        stiffness = np.broadcast_to(stiffness, (worlds, len(edges))).ravel()
        self.edges = wp.array(in_worlds(edges, worlds, len(points)), dtype=wp.vec2i, device=self.device)
        self._targets = self.edges
        if self.deterministic:
            self.slots, targets = Slots.of_units(edges, len(points), self.device, worlds)
            self._targets = wp.array(targets, dtype=wp.vec2i, device=self.device)
        self.rest = wp.array(repeated(rest, worlds), dtype=wp.vec3, device=self.device)
        self.stiffness = wp.array(stiffness, dtype=wp.float32, device=self.device)
        # Lamé's parameters of E and nu = 1/4 are both 0.4 E.
        lame = 0.4 * (young if young.size == 1 else np.broadcast_to(young, (worlds, len(tets))))
        on_device = wp.array(lame.ravel(), dtype=wp.float32, device=self.device)
        self._hooke = isotropic_material([on_device, on_device, int(lame.size > 1)])
        cauchy = law_cauchy(law_functions("stvk").stress)
        self._von_mises = element_von_mises(discretization.element_kind, IsotropicMaterial, cauchy)

    @property
    def energy_count(self) -> int:
        return len(self.edges)

    def scatter_forces(self, u: wp.array, f: wp.array) -> None:
        inputs = [self.edges, self._targets, self.rest, self.stiffness, u]
        self.launch(scatter_mass_spring, len(self.edges), inputs, [f])

    def tangent(self, *, exact: bool = False) -> Tangent:
        return SpringTangent(self)

    def write_energies(self, u: wp.array, energies: wp.array) -> None:
        inputs = [self.edges, self.rest, self.stiffness, u]
        self.launch(mass_spring_energies, len(self.edges), inputs, [energies])

    def write_von_mises(self, u: wp.array, stress: wp.array) -> None:
        self.launch(self._von_mises, self.element_count, [self.elements, self._hooke, u], [stress])


class SpringTangent(Tangent):
    """The exact K of the springs."""

    field: MassSpringField

    def add_product(self, p: wp.array, y: wp.array) -> None:
        field = self.field
        inputs = [field.edges, field.rest, field.stiffness, self.displacements, p]
        field.launch(add_mass_spring_product, len(field.edges), inputs, [y])

    def add_diagonal(self, blocks: wp.array) -> None:
        field = self.field
        inputs = [field.edges, field.rest, field.stiffness, self.displacements]
        field.launch(add_mass_spring_diagonal, len(field.edges), inputs, [blocks])
