"""Stresses beside that of an elastic law: Prony series, prestress, and the viscosity of steps."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, cast

import numpy as np
import warp as wp

from warp_corot.discretization.discretization import Discretization, discretization_of
from warp_corot.discretization.plan import Plan
from warp_corot.elasticity.corotated.model import Corotated
from warp_corot.elasticity.cpu import SimdForces
from warp_corot.elasticity.model import ElementMaterial, ForceField, Model, SmallForces
from warp_corot.elasticity.tangents import ElementTangent, SumTangent, Tangent
from warp_corot.errors import InputError
from warp_corot.inputs.arguments import forwards
from warp_corot.inputs.checks import checked_number, checked_numbers, shown
from warp_corot.kernels.elements import added as kernels
from warp_corot.kernels.elements.added import ViscousMaterial, relax_simd8, viscosity_stress
from warp_corot.kernels.elements.forces import element_energies, element_law, scatter_forces
from warp_corot.kernels.elements.simd8 import LANES, PRESTRESS, PRONY, VISCOUS, NativeLaw

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody
    from warp_corot.discretization.changing.plan import DevicePlan
    from warp_corot.discretization.discretization import Discretized
    from warp_corot.kernels.stepping.pace import Pace


class AddedForces:
    """Launches that add the forces of a stress in all elements, besides those of a law.

    On the CPU a thread takes eight complete subtrees of the law's plan, or eight other elements, if the plan has
    subtrees or never changes. Otherwise a thread takes an element; deterministic forces go to slots first.

    Args:
        discretization: The mesh.
        law: The law's field.
        Material: The struct that the stress reads.
        stress: The stress, as ``kernels.elements.forces`` takes it.
        native: The same in C++.
    """

    def __init__(
        self, discretization: Discretization, law: ForceField, Material: type, stress: wp.Function, native: NativeLaw
    ):
        self._law, self._material, plan = law, cast("Any", None), law.plan
        if law.deterministic:
            plan = discretization.plan(subtrees=False, deterministic=True)
        self._elements, self._slots = plan.elements, plan.slots
        self._kernel = scatter_forces(discretization.element_kind, Material, stress)
        self._simd: SimdForces | None = None
        if discretization.device.is_cpu and (plan.kinds or plan.counts is None):
            repair = stress if native.leaves_out else None
            self._simd = SimdForces(discretization, plan, native, lambda: self._material, Material, repair)

    def __call__(self, material: ElementMaterial | ViscousMaterial, u: wp.array, f: wp.array) -> None:
        """Add the forces [N] of displacements u to f; both vec4 [worlds * N]."""
        if self._simd is not None:
            self._material = material
            self._simd.scatter_forces(u, f)
            return
        to = f if self._slots is None else self._slots.values
        if self._slots is not None:
            to.zero_()
        self._law.launch(self._kernel, self._law.element_count, [self._elements, material, u], [to])
        if self._slots is not None:
            self._slots.gather(f)


@forwards("law", "shares_dilatation", "find_members", "rotation_level", "elapsed", "complete_step", "relax_fully")
@forwards("law", "state", "reset", "load_kernels", "note", "derive", "follow")
class AddedStressField(ForceField):
    """The forces of a law and of an additional stress in all elements.

    Args:
        discretization: The mesh and the material.
        law: The elastic law's field.
        Material: The struct that the other stress reads.
        added: The other stress.

    Attributes:
        law: The same.
    """

    takes_anisotropic: ClassVar[bool] = True

    def __init__(
        self,
        discretization: Discretization,
        law: ForceField,
        Material: type,
        added: NativeLaw,
    ):
        self.law = law
        super().__init__(discretization, law.deterministic)
        kind, own = discretization.element_kind, element_law(added.code, Material)
        self._forces = AddedForces(discretization, law, Material, own.stress, added)
        self._energies = element_energies(kind, Material, own.density, adds=True)
        self._own_law = own.differential, lambda: self.material, Material

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
        self._forces(self.material, u, f)

    def scatter_forces(self, u: wp.array, f: wp.array) -> None:
        raise NotImplementedError("add_forces does all")

    def tangent(self, *, exact: bool = False) -> Tangent:
        return SumTangent(self.law.tangent(exact=exact), ElementTangent(self, *self._own_law))

    def definite_tangent(self) -> Tangent:
        return SumTangent(self.law.definite_tangent(), ElementTangent(self, *self._own_law))

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


# --- viscoelastic tissue: a Prony series of Maxwell elements ---------------------------------------------------------


@dataclass(frozen=True)
class Prony(Model):
    """Tissue that relaxes: its shear modulus a time t after a sudden strain is mu (1 + sum_i g_i exp(-t / tau_i)).

    mu is the material's, of slow motion; ``model`` is the law of slow motion. Each term is a Maxwell element beside it,
    whose second Piola-Kirchhoff stress 2 g_i mu s_i follows the deviator E of Green's strain by ds_i/dt = dE/dt - s_i /
    tau_i, so that it turns with the body and does not resist changes of volume. (Series that are relative to the sudden
    modulus mu_0, of shares a_i, have mu = mu_0 (1 - sum_i a_i) and g_i = a_i mu_0 / mu.) Steps of any length are exact
    for a strain that grows linearly in time. ``solve_static`` finds the relaxed state. A body whose positions are set
    by hand responds with the sudden modulus. ``Simulation.energy`` includes the energy stored in Maxwell elements, but
    not what they have dissipated. The stress that is shown is that of ``model``.

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
    def carried(self) -> tuple[str, ...]:
        return tuple(f"history{number}" for number in range(6 * (len(self.terms[0]) + 1)))

    @property
    def kept_of_elements(self) -> str | None:
        return self.model.kept_of_elements

    def bind(self, body: Discretized | Discretization, *, deterministic: bool = False) -> ForceField:
        discretization = discretization_of(body)
        return PronyField(discretization, self, self.model.bind(discretization, deterministic=deterministic))


class PronyField(AddedStressField):
    """The forces of an elastic law and of Maxwell elements beside it.

    Args:
        discretization: The mesh and the material.
        model: The series.
        law: The elastic law's field.
    """

    def __init__(self, discretization: Discretization, model: Prony, law: ForceField):
        super().__init__(discretization, law, kernels.PronyMaterial, PRONY)
        g, tau = (np.array(values, np.float32) for values in model.terms)
        self._carried, counts = model.carried, self.plan.counts
        #: The number of elements may grow if the mesh changes.
        self._count = discretization.sizes.launch_elements if counts is None else counts.most
        self._g, self._tau = (wp.array(v, dtype=wp.float32, device=self.device) for v in (g, tau))
        self._elapsed = wp.zeros(1, dtype=wp.float32, device=self.device)
        self._known = wp.zeros(len(self._carried) * self._count, dtype=wp.float32, device=self.device)
        relax = relax_simd8 if self.device.is_cpu else kernels.relax
        self._relax = relax(discretization.element_kind)

    @property
    def material(self) -> kernels.PronyMaterial:
        made = kernels.PronyMaterial()
        made.isotropic, made.g, made.tau = self.isotropic, self._g, self._tau
        made.elapsed, made.known, made.count = self._elapsed, self._known, self._count
        return made

    @property
    def elapsed(self) -> wp.array:
        return self._elapsed

    def complete_step(self, u: wp.array, pace: Pace) -> None:
        self.law.complete_step(u, pace)
        if self.device.is_cpu:
            inputs = [self.elements, self.element_count, u, pace, self.material]
            self.launch(self._relax, -(-self.element_count // LANES), inputs, [])
        else:
            self.launch(self._relax, self.element_count, [self.elements, u, pace, self.material], [])

    def relax_fully(self) -> None:
        self._elapsed.fill_(math.inf)

    def note(self) -> None:
        self.law.note()
        forest, present = cast("DevicePlan", self.plan).forest, self.discretization.sizes.elements
        first = forest.carriage.names.index(self._carried[0])
        inputs = [forest.pools.leaves, self._known, first, len(self._carried), self._count]
        self.launch(kernels.carry_values, present, inputs, [forest.carriage.arrays.values])

    def derive(self) -> None:
        self.law.derive()
        plan = cast("DevicePlan", self.plan)
        threads, first = plan.forest.threads, plan.values_row(self._carried[0])
        inputs = [threads, plan.arrays, first, len(self._carried), self._count]
        self.launch(kernels.adopt_values, threads, inputs, [self._known])

    @contextmanager
    def at_rest(self) -> Iterator[None]:
        with super().at_rest():
            for array in (self._known, self._elapsed):
                array.zero_()
            yield

    @property
    def state(self) -> dict[str, wp.array]:
        return {**self.law.state, "prony": self._known, "elapsed": self._elapsed}

    def reset(self, chosen: wp.array) -> None:
        self.law.reset(chosen)
        inputs = [chosen, self._count // self.discretization.worlds, self._count]
        self.launch(kernels.forget, len(self._known), inputs, [self._known])


# --- stress in the undeformed shape ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Prestressed(Model):
    """A law with an initial stress: W = V (W_law + S : E) with Green's strain E, P = P_law + F S.

    S is a second Piola-Kirchhoff stress, which is the Cauchy stress of the body in its rest shape, positive in tension.
    It rotates with the body and does not change otherwise. If S is not in equilibrium, the body moves from rest: a free
    bar contracts by S / E. The stress that is shown is that of ``model``.

    Attributes:
        stress: S [Pa], symmetric: [3, 3] or [T, 3, 3], one for each element, the same in all worlds.
        model: The elastic law, or ``Prony``.

    Raises:
        InputError: No such numbers, or a tensor that is not symmetric.
    """

    stress: Any
    model: Model = field(default_factory=Corotated)

    def __post_init__(self) -> None:
        given = checked_numbers(self.stress, "stress", "[3, 3] or [T, 3, 3] [Pa]")
        if given.ndim not in (2, 3) or given.shape[-2:] != (3, 3) or not np.isfinite(given).all():
            raise InputError(f"stress has shape {given.shape}; it must be finite numbers [3, 3] or [T, 3, 3] [Pa]")
        largest = np.abs(given).max(initial=0.0)
        if np.abs(given - np.swapaxes(given, -1, -2)).max(initial=0.0) > 1e-6 * largest:
            raise InputError("stress is not symmetric; each tensor must be equal to its transpose")
        if not isinstance(self.model, Model) or isinstance(self.model, Prestressed):
            raise InputError(f"model is {shown(self.model)}; it must be an elastic model such as Corotated()")
        # Plain values can be compared and saved.
        object.__setattr__(self, "stress", _tuples(given.tolist()))

    @property
    def dilatation(self) -> str:
        """That of the elastic law."""
        return getattr(self.model, "dilatation", "element")

    @property
    def kept_of_elements(self) -> str | None:
        return "Prestressed keeps the stress of each element"

    def bind(self, body: Discretized | Discretization, *, deterministic: bool = False) -> ForceField:
        discretization = discretization_of(body)
        return PrestressedField(discretization, self, self.model.bind(discretization, deterministic=deterministic))


class PrestressedField(AddedStressField):
    """The forces of an elastic law and of an initial stress.

    Args:
        discretization: The mesh and the material.
        model: The initial stress.
        law: The elastic law's field.
    """

    def __init__(self, discretization: Discretization, model: Prestressed, law: ForceField):
        super().__init__(discretization, law, kernels.Prestress, PRESTRESS)
        stress, count = np.array(model.stress), len(discretization.mesh.tets)
        if stress.ndim == 3 and len(stress) != count:
            raise InputError(f"stress has {len(stress)} tensors; the mesh has {count} elements")
        if discretization.fill is not None:
            stress = discretization.fill[:, None, None] * stress
        self._material = kernels.Prestress()
        self._material.stride = int(stress.ndim == 3)
        every = np.tile(stress, (discretization.worlds, 1, 1)) if stress.ndim == 3 else stress[None]
        self._material.stress = wp.array(every.astype(np.float32), dtype=wp.mat33, device=self.device)

    @property
    def material(self) -> kernels.Prestress:
        return self._material


def _tuples(values: Sequence[Any]) -> tuple[Any, ...]:
    return tuple(_tuples(value) if isinstance(value, list) else value for value in values)


# --- viscous forces, which damp changes of shape and leave rigid motion unchanged ------------------------------------


class Viscosity:
    """Stresses proportional to the rate of strain, in every element.

    Args:
        body: The body.
        field: Its elastic forces; viscosity follows their elements if the mesh changes.
        seconds: Viscosities over Lamé's parameters [s].
        complete: A function that adds the velocities of nodes that other processes move; None if there are none.
    """

    #: Viscosity removes energy from the body and never adds any.
    is_dissipative = True

    def __init__(
        self,
        body: SoftBody,
        field: ForceField,
        seconds: float,
        complete: Callable[[wp.array], wp.array] | None = None,
    ):
        self.body, self.field, self.seconds, self._complete = body, field, seconds, complete
        self._scatter = AddedForces(body.discretization, field, ViscousMaterial, viscosity_stress, VISCOUS)

    def add_forces(self) -> None:
        """Launch the kernel that adds the forces of the present displacements and velocities to the body's [N]."""
        state = self.body.state
        velocities = state.velocities if self._complete is None else self._complete(state.velocities)
        self.scatter(state.displacements, velocities, state.forces)

    def scatter(self, u: wp.array, v: wp.array, f: wp.array) -> None:
        """Launch the kernel that adds the forces of displacements u and velocities v, linear in v, to f [N]."""
        material = ViscousMaterial()
        material.isotropic, material.seconds, material.velocities = self.field.isotropic, self.seconds, v
        self._scatter(material, u, f)
