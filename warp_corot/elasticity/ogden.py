"""Ogden's law."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_number, shown
from warp_corot.kernels.elements import ogden as kernels
from warp_corot.kernels.elements.dilatation import LOG_VOLUME

from .backends.laws import law_field
from .dilatation import AUTO, bind_law, check_dilatation
from .model import ForceField, Law, Model

if TYPE_CHECKING:
    from warp_corot.discretization.discretization import Discretization, Discretized

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
        low, high = zip(*(kernels.stretch_limits(alpha) for _share, alpha in self.terms), strict=True)
        return max(low), min(high)

    def bind(self, body: Discretized | Discretization, *, deterministic: bool = False) -> ForceField:
        law = Law(**kernels.ogden(self.terms), lanes=self.terms)
        return bind_law(partial(law_field, law), LOG_VOLUME, self.dilatation, body, deterministic)


def _numbers(given: Any, name: str) -> tuple[float, ...]:
    """One number or several."""
    many = given if isinstance(given, Sequence) and not isinstance(given, str) else (given,)
    return tuple(checked_number(each, name) for each in many)
