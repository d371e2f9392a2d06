"""Viscoelastic tissue: an elastic law with a Prony series of Maxwell elements."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, cast

import numpy as np
import warp as wp

from warp_corot.discretization.discretization import Discretization, discretization_of
from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_number, shown
from warp_corot.kernels.elements import prony as kernels
from warp_corot.kernels.elements.native_laws import PRONY
from warp_corot.kernels.elements.prony_cpu import relax_simd8
from warp_corot.kernels.elements.simd8 import LANES

from .added_stress import AddedStressField
from .corotated.model import Corotated
from .model import ForceField, Model

if TYPE_CHECKING:
    from warp_corot.discretization.changing.plan import DevicePlan
    from warp_corot.discretization.discretization import Discretized
    from warp_corot.kernels.stepping.pace import Pace


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
        functions = (kernels.prony_stress, kernels.prony_differential, kernels.prony_density)
        super().__init__(discretization, law, kernels.PronyMaterial, *functions, lanes=PRONY)
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
