"""Fields of an elastic law with an additional stress in the same elements."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, ClassVar

import warp as wp

from warp_corot.discretization.discretization import Discretization
from warp_corot.discretization.elements import Elements
from warp_corot.discretization.members import Members
from warp_corot.discretization.plan import Plan
from warp_corot.kernels.elements.forces import add_energies
from warp_corot.kernels.elements.law_lanes import NativeLaw

from .model import ForceField, SmallForces
from .paths.elements import ByElements
from .stiffness import ElementMaterial, ElementStiffness
from .tangent import Tangent

if TYPE_CHECKING:
    from warp_corot.kernels.stepping.pace import Pace


class BesideField(ForceField):
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
        self._forces = ByElements(discretization, self.plan, Material, stress, lanes)
        self._energies = add_energies(kind, Material, density)
        self._stiffness = ElementStiffness(discretization, differential, Material)
        #: Separate places for each element's forces, if sums must be reproducible.
        self._slotted = discretization.plan(subtrees=False, deterministic=True) if self.deterministic else None

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
        """Launch the kernel that adds only the forces of the additional stress."""
        if self._slotted is None:
            self._scatter_own(self.elements, u, f)
            return
        slots = self._slotted.slots
        assert slots is not None
        slots.values.zero_()
        self._scatter_own(self._slotted.elements, u, slots.values)
        slots.gather(f)

    def _scatter_own(self, elements: Elements, u: wp.array, f: wp.array) -> None:
        self._forces(elements, self.element_count, self.material, u, f)

    def scatter_forces(self, u: wp.array, f: wp.array) -> None:
        raise NotImplementedError("add_forces does all")

    def add_stiffness(self, u: wp.array, p: wp.array, y: wp.array, **options: Any) -> None:
        self.law.add_stiffness(u, p, y, **options)
        self.add_own_stiffness(u, p, y)

    def add_own_stiffness(self, u: wp.array, p: wp.array, y: wp.array) -> None:
        """Launch the kernel that adds the additional stress's part of ``add_stiffness``."""
        self._stiffness.add_product(self.elements, self.material, u, p, y)

    def add_diagonal(self, u: wp.array, blocks: wp.array, **options: Any) -> None:
        self.law.add_diagonal(u, blocks, **options)
        self.add_own_diagonal(u, blocks)

    def add_own_diagonal(self, u: wp.array, blocks: wp.array) -> None:
        """Launch the kernel that adds the additional stress's part of ``add_diagonal``."""
        self._stiffness.add_diagonal(self.elements, self.material, u, blocks)

    def tangent(self, *, exact: bool = False) -> Tangent:
        return BesideTangent(self, exact)

    @property
    def stiffest(self) -> SmallForces:
        return Stiffest(self)

    # --- energies, stresses, state -----------------------------------------------------------------------------------

    def write_energies(self, u: wp.array, energies: wp.array) -> None:
        self.law.write_energies(u, energies)
        self.launch(self._energies, self.element_count, [self.elements, self.material, u], [energies])

    def write_potentials(self, u: wp.array, energies: wp.array) -> None:
        self.law.write_potentials(u, energies)
        self.launch(self._energies, self.element_count, [self.elements, self.material, u], [energies])

    def write_von_mises(self, u: wp.array, stress: wp.array) -> None:
        self.law.write_von_mises(u, stress)

    @contextmanager
    def at_rest(self) -> Iterator[None]:
        """Like ``state_kept``, but launches inside begin with elements that have no history."""
        with self.state_kept():
            yield

    # --- as the law has it -------------------------------------------------------------------------------------------

    @property
    def shares_dilatation(self) -> bool:  # type: ignore[override]
        """Whether the law's elements do."""
        return self.law.shares_dilatation

    @property
    def find_members(self) -> Callable[[int], Members] | None:
        return self.law.find_members

    @property
    def rotation_level(self) -> int | None:
        """Level of the tree at which the law's rotations are shared, if they are."""
        return getattr(self.law, "rotation_level", None)

    @property
    def elapsed(self) -> wp.array | None:
        return self.law.elapsed

    def complete_step(self, u: wp.array, pace: Pace) -> None:
        self.law.complete_step(u, pace)

    def relax_fully(self) -> None:
        self.law.relax_fully()

    @property
    def state(self) -> dict[str, wp.array]:
        return self.law.state

    def reset(self, chosen: wp.array) -> None:
        self.law.reset(chosen)

    def load_kernels(self) -> None:
        self.law.load_kernels()

    def note(self) -> None:
        self.law.note()

    def derive(self) -> None:
        self.law.derive()

    def take_material(self) -> None:
        self.law.take_material()

    def follow(self) -> None:
        self.law.follow()


class Stiffest:
    """The forces of small displacements that bound the step: the law's stiffest ones, and those of the additional
    stress.

    Args:
        field: The field.
    """

    def __init__(self, field: BesideField):
        self._field, self.state_kept = field, field.at_rest

    def add_forces(self, u: wp.array, f: wp.array) -> None:
        """Add the forces [N] of displacements u to f; both vec4 [worlds * N]."""
        self._field.law.stiffest.add_forces(u, f)
        self._field.add_own_forces(u, f)


class BesideTangent(Tangent):
    """K of a field with an additional stress.

    Args:
        field: The field.
        exact: As for ``ForceField.tangent``.
    """

    field: BesideField

    def __init__(self, field: BesideField, exact: bool):
        super().__init__(field)
        self.law = field.law.tangent(exact=exact)

    def prepare(self, u: wp.array) -> None:
        super().prepare(u)
        self.law.prepare(u)

    def take(self, u: wp.array) -> None:
        super().take(u)
        self.law.take(u)

    def add_product(self, p: wp.array, y: wp.array) -> None:
        self.law.add_product(p, y)
        self.field.add_own_stiffness(self.displacements, p, y)

    def add_diagonal(self, blocks: wp.array) -> None:
        self.law.add_diagonal(blocks)
        self.field.add_own_diagonal(self.displacements, blocks)
