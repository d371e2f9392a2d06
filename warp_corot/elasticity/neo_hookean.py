"""Compressible neo-Hookean material."""

from __future__ import annotations

from dataclasses import dataclass

from warp_corot.elasticity.model import Law
from warp_corot.kernels.elements.constitutive import neo_hookean_differential, neo_hookean_energy, neo_hookean_stress
from warp_corot.kernels.elements.dilatation import LOG_VOLUME

from .law_model import LawModel


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

    law = Law(neo_hookean_stress, neo_hookean_differential, neo_hookean_energy, "neo-hookean")
    shared = LOG_VOLUME
