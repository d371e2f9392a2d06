"""Strain and stress tensors of elements on the host, in float64, for files."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from warp_corot.elasticity.corotated.model import Corotated
from warp_corot.kernels.elements.ogden import part_of_volume, stretch_limits
from warp_corot.materials.isotropic import Isotropic

from .edge_stvk import EdgeStVK
from .host_laws import LAWS, Tensors, rotation
from .linear import Linear
from .mass_spring import MassSpring
from .model import Model
from .neo_hookean import NeoHookean
from .ogden import Ogden
from .stvk import StVenantKirchhoff

#: Keeps |J| away from zero, as in ``kernels/elements/constitutive.py``.
LEAST_J = 1.0e-3


def gradients(points: npt.ArrayLike, tets: npt.ArrayLike, displacements: npt.ArrayLike) -> Tensors:
    """Deformation gradients F of tetrahedra, [T, 3, 3].

    Args:
        points: At rest [m], [N, 3].
        tets: [T, 4].
        displacements: [m], [N, 3].
    """
    x, u, t = np.asarray(points, np.float64), np.asarray(displacements, np.float64), np.asarray(tets)
    rest = np.swapaxes(x[t[:, 1:]] - x[t[:, :1]], 1, 2)
    moved = np.swapaxes(u[t[:, 1:]] - u[t[:, :1]], 1, 2)
    return np.eye(3) + moved @ np.linalg.inv(rest)


def green_strain(f: Tensors) -> Tensors:
    """Green-Lagrange strain (F^T F - I) / 2, [T, 3, 3]."""
    return 0.5 * (np.swapaxes(f, 1, 2) @ f - np.eye(3))


def has_tensor(model: Model, material: object) -> bool:
    """Whether `cauchy_stress` knows the law."""
    known = (Linear, Corotated, StVenantKirchhoff, NeoHookean, Ogden, EdgeStVK, MassSpring)
    shared = getattr(model, "rotation_level", None) is not None
    return type(model) in known and isinstance(material, Isotropic) and not shared


def cauchy_stress(model: Model, f: Tensors, young: npt.ArrayLike, poisson: npt.ArrayLike) -> Tensors:
    """Cauchy stress [Pa], [T, 3, 3]; `Simulation.von_mises` is its equivalent stress.

    For Corotated it is the stress of the law, R (2 mu e + lambda tr(e) I) R^T with e = sym(R^T F) - I, and for Linear
    that of small strains, both without the factor 1 / J.

    Args:
        model: The elastic law; see `has_tensor`.
        f: Deformation gradients.
        young: Young's modulus [Pa], a number or [T].
        poisson: Poisson's ratio, likewise.
    """
    e, nu = (np.broadcast_to(np.asarray(value, np.float64), len(f))[:, None, None] for value in (young, poisson))
    mu, lam = e / (2.0 * (1.0 + nu)), e * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))
    if isinstance(model, MassSpring):
        mu = lam = 0.4 * e  # springs have a Poisson's ratio of 1/4
    if isinstance(model, Ogden):
        part = sum(part_of_volume(*term) for term in model.terms)
        kirchhoff = LAWS[NeoHookean].stress(f, part * mu, lam) @ np.swapaxes(f, 1, 2)
        kirchhoff = kirchhoff + mu * _ogden_excess(f, model.terms)
    else:
        piola = LAWS.get(type(model), LAWS[StVenantKirchhoff]).stress(f, mu, lam)
        if isinstance(model, Linear):
            return piola
        if isinstance(model, Corotated):
            return piola @ np.swapaxes(rotation(f), 1, 2)
        kirchhoff = piola @ np.swapaxes(f, 1, 2)
    return kirchhoff / np.maximum(np.abs(np.linalg.det(f)), LEAST_J)[:, None, None]


def _ogden_excess(f: Tensors, terms: tuple[tuple[float, float], ...]) -> Tensors:
    """P F^T / mu of the part of Ogden's law beyond neo-Hookean; see ``kernels.elements.ogden``."""
    squares, axes = np.linalg.eigh(np.swapaxes(f, 1, 2) @ f)
    slope = np.zeros_like(squares)
    for share, alpha in terms:
        m, part = 2.0 * share / alpha, part_of_volume(share, alpha)
        low, high = stretch_limits(alpha)
        c = np.clip(squares, low**2, high**2)
        power = c ** (0.5 * alpha - 1.0)
        curvature = m * (0.5 * alpha - 1.0) * power / c + (m - part) / c**2
        slope += m * (power - 1.0) - (m - part) * (1.0 / c - 1.0) + (squares - c) * curvature
    turned = f @ axes
    return (turned * slope[:, None, :]) @ np.swapaxes(turned, 1, 2)
