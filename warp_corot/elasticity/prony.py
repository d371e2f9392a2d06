"""Viscoelastic tissue: an elastic law with a Prony series of Maxwell elements."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import warp as wp

from warp_corot.discretization.discretization import Discretization, discretization_of
from warp_corot.discretization.plan import Plan
from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_number, shown
from warp_corot.kernels.elements import prony as kernels
from warp_corot.kernels.elements.forces import scatter_forces

from .corotated.model import Corotated
from .model import ForceField, Model, SmallForces
from .stiffness import ElementStiffness
from .tangent import Tangent

if TYPE_CHECKING:
    from warp_corot.discretization.discretization import Discretized
    from warp_corot.kernels.stepping.pace import Pace


@dataclass(frozen=True)
class Prony(Model):
    """Tissue that relaxes: its shear modulus a time t after a sudden strain is mu (1 + sum_i g_i exp(-t / tau_i)).

    mu is the material's, of slow motion; ``model`` is the law of slow motion. Each term is a Maxwell element beside it,
    whose second Piola-Kirchhoff stress 2 g_i mu s_i follows the deviator E of Green's strain by ds_i/dt = dE/dt - s_i /
    tau_i, so that it turns with the body and does not resist changes of volume. (Series that are relative to the
    sudden modulus mu_0, of shares a_i, have mu = mu_0 (1 - sum_i a_i) and g_i = a_i mu_0 / mu.) Steps of any length
    have the exact answer to a strain that grows evenly. ``solve_static`` finds the relaxed state. A body that was moved
    by hand answers with the sudden modulus. ``Simulation.energy`` counts what Maxwell elements hold; what they
    dissipate is lost. The stress that is shown is that of ``model``.

    Attributes:
        g: Shear moduli g_i > 0 over the material's.
        tau: Relaxation times tau_i > 0 [s], as many.
        model: The elastic law.

    Raises:
        InputError: A number out of its range, or as many ``g`` as ``tau`` are not given.
    """

    g: float | Sequence[float] = (0.5,)
    tau: float | Sequence[float] = (0.1,)
    model: Model = field(default_factory=Corotated)

    def __post_init__(self) -> None:
        for name, unit in (("g", ""), ("tau", "s")):
            given = getattr(self, name)
            many = given if isinstance(given, Sequence) and not isinstance(given, str) else (given,)
            values = tuple(checked_number(each, name, unit) for each in many)
            if not values or not all(0.0 < value < math.inf for value in values):
                raise InputError(f"{name} is {shown(given)}; it must be numbers above zero{unit and f' [{unit}]'}")
            object.__setattr__(self, name, values)
        if len(self.terms[0]) != len(self.terms[1]):
            raise InputError(
                f"there are {len(self.terms[0])} g and {len(self.terms[1])} tau; each term has one of both"
            )
        if not isinstance(self.model, Model) or isinstance(self.model, Prony):
            raise InputError(f"model is {shown(self.model)}; it must be an elastic model such as Corotated()")

    @property
    def terms(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """All g and all tau [s]."""
        return tuple(self.g), tuple(self.tau)  # type: ignore[arg-type]

    @property
    def dilatation(self) -> str:
        """That of the elastic law."""
        return getattr(self.model, "dilatation", "element")

    @property
    def kept_of_elements(self) -> str | None:
        return "Prony keeps the history of each element"

    def bind(self, body: Discretized | Discretization, *, deterministic: bool = False) -> ForceField:
        discretization = discretization_of(body)
        return PronyField(discretization, self, self.model.bind(discretization, deterministic=deterministic))


class PronyField(ForceField):
    """The forces of an elastic law and of Maxwell elements beside it.

    Args:
        discretization: The mesh and the material.
        model: The series.
        law: The elastic law's field.

    Attributes:
        law: The same.
        elapsed: Seconds since the state of elements was known, float32 [1]; forces are those after that time.
    """

    takes_anisotropic: ClassVar[bool] = True

    def __init__(self, discretization: Discretization, model: Prony, law: ForceField):
        self.law = law
        super().__init__(discretization, law.deterministic)
        kind, g, tau = discretization.element_kind, *model.terms
        self._count, self._terms = discretization.sizes.launch_elements, len(g)
        self._g, self._tau = (wp.array(np.array(v, np.float32), dtype=wp.float32, device=self.device) for v in (g, tau))
        self.elapsed: wp.array = wp.zeros(1, dtype=wp.float32, device=self.device)
        places = 6 * (self._terms + 1) * self._count
        self._known = wp.zeros(places, dtype=wp.float32, device=self.device)
        self._forces = scatter_forces(kind, kernels.PronyMaterial, kernels.prony_stress)
        self._energies, self._relax = kernels.add_prony_energies(kind), kernels.relax(kind)
        self._stiffness = ElementStiffness(discretization, kernels.prony_differential, kernels.PronyMaterial)
        #: Where sums must come out the same every time, the elements' own places for them.
        self._slotted = discretization.plan(subtrees=False, deterministic=True) if self.deterministic else None

    def plan_of(self, discretization: Discretization) -> Plan:
        return self.law.plan

    @property
    def material(self) -> kernels.PronyMaterial:
        """What kernels read."""
        made = kernels.PronyMaterial()
        made.isotropic, made.g, made.tau = self.isotropic, self._g, self._tau
        made.elapsed, made.known, made.count = self.elapsed, self._known, self._count
        return made

    # --- forces ------------------------------------------------------------------------------------------------------

    def add_forces(self, u: wp.array, f: wp.array) -> None:
        self.law.add_forces(u, f)
        self.add_own_forces(u, f)

    def add_own_forces(self, u: wp.array, f: wp.array) -> None:
        """Launch what adds the forces of Maxwell elements alone."""
        if self._slotted is None:
            self.launch(self._forces, self.element_count, [self.elements, self.material, u], [f])
            return
        slots = self._slotted.slots
        assert slots is not None
        slots.values.zero_()
        self.launch(self._forces, self.element_count, [self._slotted.elements, self.material, u], [slots.values])
        slots.gather(f)

    def scatter_forces(self, u: wp.array, f: wp.array) -> None:
        raise NotImplementedError("add_forces does all")

    def add_stiffness(self, u: wp.array, p: wp.array, y: wp.array, **options: Any) -> None:
        self.law.add_stiffness(u, p, y, **options)
        self._stiffness.add_product(self.elements, self.material, u, p, y)

    def add_diagonal(self, u: wp.array, blocks: wp.array, **options: Any) -> None:
        self.law.add_diagonal(u, blocks, **options)
        self._stiffness.add_diagonal(self.elements, self.material, u, blocks)

    def tangent(self, *, exact: bool = False) -> Tangent:
        return PronyTangent(self, exact)

    @property
    def stiffest(self) -> SmallForces:
        return Stiffest(self)

    @property
    def shares_dilatation(self) -> bool:  # type: ignore[override]
        """Whether the law's elements do."""
        return self.law.shares_dilatation

    @property
    def rotation_level(self) -> int | None:
        """Level of the tree at which the law's rotations are shared, if they are."""
        return getattr(self.law, "rotation_level", None)

    # --- energies, stresses, state -----------------------------------------------------------------------------------

    def write_energies(self, u: wp.array, energies: wp.array) -> None:
        self.law.write_energies(u, energies)
        self.launch(self._energies, self.element_count, [self.elements, self.material, u], [energies])

    def write_von_mises(self, u: wp.array, stress: wp.array) -> None:
        self.law.write_von_mises(u, stress)

    def complete_step(self, u: wp.array, pace: Pace) -> None:
        self.launch(self._relax, self.element_count, [self.elements, u, pace, self.material], [])

    def relax_fully(self) -> None:
        self.elapsed.fill_(math.inf)

    @property
    def state(self) -> dict[str, wp.array]:
        return {**self.law.state, "prony": self._known, "elapsed": self.elapsed}

    def reset(self, chosen: wp.array) -> None:
        self.law.reset(chosen)
        inputs = [chosen, self._count // self.discretization.worlds, self._count]
        self.launch(kernels.forget, len(self._known), inputs, [self._known])

    def load_kernels(self) -> None:
        self.law.load_kernels()

    def derive(self) -> None:
        self.law.derive()

    def follow(self) -> None:
        self.law.follow()


class Stiffest:
    """The forces of small displacements that bound the step: the stiffest of the law, and the Maxwell elements.

    Args:
        field: The field.
    """

    def __init__(self, field: PronyField):
        self._field = field

    def add_forces(self, u: wp.array, f: wp.array) -> None:
        """Add the forces [N] of displacements u to f; both vec4 [worlds * N]."""
        self._field.law.stiffest.add_forces(u, f)
        self._field.add_own_forces(u, f)

    @contextmanager
    def state_kept(self) -> Iterator[None]:
        """Whatever is launched inside leaves no trace, and begins relaxed at rest."""
        with self._field.state_kept():
            for name in ("prony", "elapsed"):
                self._field.state[name].zero_()
            yield


class PronyTangent(Tangent):
    """K of a field with Maxwell elements.

    Args:
        field: The field.
        exact: As for ``ForceField.tangent``.
    """

    field: PronyField

    def __init__(self, field: PronyField, exact: bool):
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
        field = self.field
        field._stiffness.add_product(field.elements, field.material, self.displacements, p, y)

    def add_diagonal(self, blocks: wp.array) -> None:
        self.law.add_diagonal(blocks)
        field = self.field
        field._stiffness.add_diagonal(field.elements, field.material, self.displacements, blocks)
