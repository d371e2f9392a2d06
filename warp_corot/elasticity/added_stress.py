"""Fields of an elastic law with an additional stress in the same elements."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from typing import ClassVar

import warp as wp

from warp_corot.discretization.discretization import Discretization
from warp_corot.discretization.plan import Plan
from warp_corot.inputs.forwarding import forwards
from warp_corot.kernels.elements.forces import element_energies
from warp_corot.kernels.elements.native_laws import NativeLaw

from .backends.elements import ByElements
from .model import ForceField, SmallForces
from .stress_law import ElementMaterial
from .tangent import ElementTangent, Tangent


@forwards("law", "shares_dilatation", "find_members", "rotation_level", "elapsed", "complete_step", "relax_fully")
@forwards("law", "state", "reset", "load_kernels", "note", "derive", "take_material", "follow")
class AddedStressField(ForceField):
    """The forces of a law and of an additional stress in all elements.

    Args:
        discretization: The mesh and the material.
        law: The elastic law's field.
        Material: The struct that the other stress reads.
        stress, differential, density: The other stress, its differential, and its energy density, as
            ``kernels.elements.forces`` and ``kernels.elements.stiffness_products`` take them.
        lanes: The other stress in C++, for the CPU, if it is there.

    Attributes:
        law: The same.
    """

    takes_anisotropic: ClassVar[bool] = True

    def __init__(
        self,
        discretization: Discretization,
        law: ForceField,
        Material: type,
        stress: wp.Function,
        differential: wp.Function,
        density: wp.Function,
        lanes: NativeLaw | None = None,
    ):
        self.law = law
        super().__init__(discretization, law.deterministic)
        kind = discretization.element_kind
        self._forces = ByElements(discretization, self.plan, Material, stress, lanes, slotted=self.deterministic)
        self._energies = element_energies(kind, Material, density, adds=True)
        self._own_law = differential, lambda: self.material, Material

    @property
    @abstractmethod
    def material(self) -> ElementMaterial:
        """The struct that the additional stress reads."""

    def plan_of(self, discretization: Discretization) -> Plan:
        return self.law.plan

    # --- forces ------------------------------------------------------------------------------------------------------

    def add_forces(self, u: wp.array, f: wp.array) -> None:
        self.law.add_forces(u, f)
        self.add_own_forces(u, f)

    def add_own_forces(self, u: wp.array, f: wp.array) -> None:
        """Launch the kernels that add only the forces of the additional stress."""
        self._forces(self.element_count, self.material, u, f)

    def scatter_forces(self, u: wp.array, f: wp.array) -> None:
        raise NotImplementedError("add_forces does all")

    def tangent(self, *, exact: bool = False) -> Tangent:
        return SumTangent(self.law.tangent(exact=exact), ElementTangent(self, *self._own_law))

    @property
    def stiffest(self) -> SmallForces:
        return Stiffest(self)

    # --- energies, stresses, state -----------------------------------------------------------------------------------

    def write_energies(self, u: wp.array, energies: wp.array) -> None:
        self.law.write_energies(u, energies)
        self._add_own_energies(u, energies)

    def write_potentials(self, u: wp.array, energies: wp.array) -> None:
        self.law.write_potentials(u, energies)
        self._add_own_energies(u, energies)

    def _add_own_energies(self, u: wp.array, energies: wp.array) -> None:
        self.launch(self._energies, self.element_count, [self.elements, self.material, u], [energies])

    def write_von_mises(self, u: wp.array, stress: wp.array) -> None:
        self.law.write_von_mises(u, stress)

    @contextmanager
    def at_rest(self) -> Iterator[None]:
        """Like ``state_kept``, but launches inside begin with elements that have no history."""
        with self.state_kept():
            yield


class Stiffest:
    """The forces of small displacements that bound the step: the law's stiffest ones, and those of the additional
    stress.

    Args:
        field: The field.
    """

    def __init__(self, field: AddedStressField):
        self._field, self.state_kept = field, field.at_rest

    def add_forces(self, u: wp.array, f: wp.array) -> None:
        """Add the forces [N] of displacements u to f; both vec4 [worlds * N]."""
        self._field.law.stiffest.add_forces(u, f)
        self._field.add_own_forces(u, f)


class SumTangent(Tangent):
    """The sum of two stiffnesses.

    Args:
        first, second: The two.
    """

    def __init__(self, first: Tangent, second: Tangent):
        super().__init__(second.field)
        self._both = first, second

    @property
    def kernels(self) -> list[wp.Kernel]:
        return [kernel for each in self._both for kernel in each.kernels]

    def prepare(self, u: wp.array) -> None:
        super().prepare(u)
        for each in self._both:
            each.prepare(u)

    def take(self, u: wp.array) -> None:
        super().take(u)
        for each in self._both:
            each.take(u)

    def add_product(self, p: wp.array, y: wp.array) -> None:
        for each in self._both:
            each.add_product(p, y)

    def add_diagonal(self, blocks: wp.array) -> None:
        for each in self._both:
            each.add_diagonal(blocks)
