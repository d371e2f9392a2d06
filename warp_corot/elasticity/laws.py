"""Isotropic laws that need no rotation: linear, St. Venant-Kirchhoff, neo-Hookean and Ogden's."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

from warp_corot.discretization.discretization import Discretization
from warp_corot.discretization.plan import Plan
from warp_corot.elasticity.cpu import SimdForces
from warp_corot.elasticity.cuda import CudaForces, CudaLaw
from warp_corot.elasticity.dilatation import AUTO, bind_law, check_dilatation
from warp_corot.elasticity.model import ElementField, ForceField, Model
from warp_corot.elasticity.tangents import DefiniteTangent, Tangent
from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_number, shown
from warp_corot.kernels.clusters.laws import isotropic_law
from warp_corot.kernels.elements.constitutive import IsotropicMaterial, law_functions
from warp_corot.kernels.elements.dilatation import GREEN, LOG_VOLUME, SMALL, Dilatation
from warp_corot.kernels.elements.forces import law_cauchy, law_differential, law_stress, law_value
from warp_corot.kernels.elements.simd8 import IsotropicLaw, stretch_limits
from warp_corot.kernels.subtrees.cuda import scatter_law_subtrees

if TYPE_CHECKING:
    from warp_corot.discretization.discretization import Discretized


class LawField(ElementField):
    """Complete subtrees in batches under a law of the package; other elements, on CUDA, in clusters or one by one.

    Args:
        discretization: The mesh and the material.
        law: The law.
        deterministic: As for every field.
    """

    def __init__(self, law: IsotropicLaw, discretization: Discretization, deterministic: bool = False):
        of = law_functions(law)
        super().__init__(
            discretization,
            stress=law_stress(of.stress),
            differential=law_differential(of.differential),
            density=law_value(of.energy),
            cauchy=law_value(of.stress) if law == "linear" else law_cauchy(of.stress),
            deterministic=deterministic,
        )
        #: Linear elasticity has no principal axes of its own, and is semidefinite.
        self.has_principal_axes = law != "linear"
        if self.device.is_cpu:
            self._fast = SimdForces(discretization, self.plan, law, lambda: self.isotropic)
        else:
            uniform, cluster = discretization.material_stride == 0, isotropic_law(of.stress)
            of_subtrees = lambda shape, grouped, _: scatter_law_subtrees(shape, grouped, uniform, of.stress)  # noqa: E731
            given = self._functions[0], lambda: self.isotropic, IsotropicMaterial, of_subtrees, cluster
            self._fast = CudaForces(self, CudaLaw(*given))

    def plan_of(self, discretization: Discretization) -> Plan:
        subtrees = self.device.is_cpu or self.deterministic or discretization.prefers_subtrees
        return discretization.plan(subtrees=subtrees, deterministic=self.deterministic)

    def definite_tangent(self) -> Tangent:
        if not self.has_principal_axes:
            return self.tangent()
        return DefiniteTangent(self, self.stress_law.differential, lambda: self.material, self._Material)


# --- models of one law -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class LawModel(Model):
    """A constitutive law of the package, whose elements can share their dilatation.

    Class attributes:
        law: The law.
        shared: The dilatation that elements of this law share.
    """

    law: ClassVar[IsotropicLaw]
    shared: ClassVar[Dilatation]

    dilatation: str = AUTO

    def __post_init__(self) -> None:
        check_dilatation(self.dilatation)

    def bind(self, body: Discretized | Discretization, *, deterministic: bool = False) -> ForceField:
        return bind_law(partial(LawField, self.law), self.shared, self.dilatation, body, deterministic)


# --- linear elasticity: right for small rotations, swells in large ones ----------------------------------------------


@dataclass(frozen=True)
class Linear(LawModel):
    """W = V (mu e:e + lambda/2 tr(e)^2) with e = sym(F) - I. Conserves linear but not angular momentum.

    Attributes:
        dilatation: "element": each element has its own, and nearly incompressible tissue is too stiff. "shared":
            elements share it, see ``elasticity.dilatation``; slower. "auto": they do where Poisson's ratio is 0.45 or
            more in any element, and the material is isotropic.
    """

    strained_safety: ClassVar[float] = 0.9  # its stiffness never changes
    law = "linear"
    shared = SMALL

    def bind(self, body: Discretized | Discretization, *, deterministic: bool = False) -> ForceField:
        field = super().bind(body, deterministic=deterministic)
        field.is_linear = True
        return field


# --- St. Venant-Kirchhoff: Hooke's law between Green strain and second Piola-Kirchhoff stress ------------------------


@dataclass(frozen=True)
class StVenantKirchhoff(LawModel):
    """W = V (mu E:E + lambda/2 tr(E)^2) with E = (F^T F - I)/2, in total-Lagrangian form.

    Stepped by explicit central differences (symplectic Euler is their leapfrog form) this is what the literature calls
    TLED (Miller et al. 2007). Softens when compressed and lets elements invert at large strain; the paper's reference.

    Attributes:
        dilatation: "element": each element has its own, and nearly incompressible tissue is too stiff. "shared":
            elements share it, see ``elasticity.dilatation``; slower. "auto": they do where Poisson's ratio is 0.45 or
            more in any element, and the material is isotropic.
    """

    law = "stvk"
    shared = GREEN


# --- neo-Hookean -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class NeoHookean(LawModel):
    """W = V (mu/2 (tr F^T F - 3) - mu ln J + lambda/2 (ln J)^2), P = mu (F - F^-T) + lambda ln J F^-T.

    This holds for J >= 0.5, an element with at least half its volume. Below, the terms in J, U(J) = -mu ln J + lambda/2
    (ln J)^2, continue as their second-order Taylor polynomial about 0.5. Energy, force and stiffness are continuous and
    exist for every F, and an inverted element is pushed back. U'' stays at 4 mu + 6.8 lambda, so that the stiffness is
    bounded: elements whose stretches do not exceed 1 have at most 29 mu + 44 lambda when turned over, and up to 4.5
    times that at rest, 2 mu + 3 lambda, when crushed; a body's stable step shrinks by the root of that.

    Total-Lagrangian too: with explicit central differences, TLED (Miller et al. 2007).

    Attributes:
        dilatation: "element": each element has its own, and nearly incompressible tissue is too stiff. "shared":
            elements share it, see ``elasticity.dilatation``; slower. "auto": they do where Poisson's ratio is 0.45 or
            more in any element, and the material is isotropic.
    """

    law = "neo-hookean"
    shared = LOG_VOLUME


# --- Ogden -----------------------------------------------------------------------------------------------------------


#: With larger exponents, powers of stretches would exceed the range of float32.
LARGEST_EXPONENT = 60.0


@dataclass(frozen=True)
class Ogden(Model):
    """W = V (sum_p 2 mu_p / alpha_p^2 (l1^alpha_p + l2^alpha_p + l3^alpha_p - 3 - alpha_p ln J) + lambda/2 (ln J)^2).

    l1, l2, l3 are the principal stretches and J is their product (Ogden 1972; the compressible form is that of
    ``NeoHookean``, which one term with alpha = 2 is equal to). The sum of all mu_p is the shear modulus of small
    strains. The body's material gives this modulus and lambda in each element: ``mu`` gives only the ratios of the
    terms. So material fields, worlds and shared dilatation work as for other laws.

    The law holds for J >= 0.5 and principal stretches within ``stretch_limits``, at which a term is a thousand times as
    stiff as at rest. Beyond, the energy continues as a parabola, in J as for ``NeoHookean`` and in squared stretches:
    energy, force and stiffness are continuous and exist for every F, and inverted elements are pushed back.

    Attributes:
        mu: The shear moduli mu_p > 0 of the terms, in any unit; only their ratios count.
        alpha: The exponents alpha_p, not zero, as many. Large positive ones stiffen in tension, negative ones in
            compression.
        dilatation: "element": each element has its own, and nearly incompressible tissue is too stiff. "shared":
            elements share it, see ``elasticity.dilatation``; slower. "auto": they do where Poisson's ratio is 0.45 or
            more in any element.

    Raises:
        InputError: A number out of its range, or as many ``mu`` as ``alpha`` are not given.
    """

    mu: float | Sequence[float] = (1.0,)
    alpha: float | Sequence[float] = (8.0,)
    dilatation: str = AUTO

    def __post_init__(self) -> None:
        check_dilatation(self.dilatation)
        mu, alpha = (_numbers(getattr(self, name), name) for name in ("mu", "alpha"))
        if len(mu) != len(alpha) or not mu:
            raise InputError(f"there are {len(mu)} mu and {len(alpha)} alpha; there must be one of each for every term")
        for value in mu:
            if not 0.0 < value < math.inf:
                raise InputError(f"mu is {shown(self.mu)}; each must be above zero, as a share of the shear modulus")
        for value in alpha:
            if not 0.05 <= abs(value) <= LARGEST_EXPONENT:
                raise InputError(f"alpha is {shown(self.alpha)}; its size must be from 0.05 to {LARGEST_EXPONENT:g}")
        object.__setattr__(self, "mu", mu)
        object.__setattr__(self, "alpha", alpha)

    @property
    def terms(self) -> tuple[tuple[float, float], ...]:
        """Share of the shear modulus and exponent of each term."""
        mu, alpha = _numbers(self.mu, "mu"), _numbers(self.alpha, "alpha")
        return tuple((value / math.fsum(mu), exponent) for value, exponent in zip(mu, alpha, strict=True))

    @property
    def stretch_limits(self) -> tuple[float, float]:
        """Smallest and largest principal stretch at which every term is the plain law."""
        low, high = zip(*(stretch_limits(alpha) for _share, alpha in self.terms), strict=True)
        return max(low), min(high)

    def bind(self, body: Discretized | Discretization, *, deterministic: bool = False) -> ForceField:
        return bind_law(partial(LawField, self.terms), LOG_VOLUME, self.dilatation, body, deterministic)


def _numbers(given: Any, name: str) -> tuple[float, ...]:
    """One number or several."""
    many = given if isinstance(given, Sequence) and not isinstance(given, str) else (given,)
    return tuple(checked_number(each, name) for each in many)
