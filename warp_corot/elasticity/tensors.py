"""Strain and stress tensors of elements on the host, in float64, for files."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from warp_corot.elasticity.corotated.model import Corotated
from warp_corot.kernels.elements.constitutive import CONTINUED_BELOW
from warp_corot.kernels.elements.ogden import part_of_volume, stretch_limits
from warp_corot.materials.isotropic import Isotropic

from .edge_stvk import EdgeStVK
from .linear import Linear
from .mass_spring import MassSpring
from .model import Model
from .neo_hookean import NeoHookean
from .ogden import Ogden
from .stvk import StVenantKirchhoff

Tensors = npt.NDArray[np.float64]

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

    def hooke(strain: Tensors) -> Tensors:
        return 2.0 * mu * strain + lam * _trace(strain) * np.eye(3)

    if isinstance(model, Linear):
        return hooke(0.5 * (f + np.swapaxes(f, 1, 2)) - np.eye(3))
    if isinstance(model, Corotated):
        r = _rotations(f)
        stretch = np.swapaxes(r, 1, 2) @ f
        return r @ hooke(0.5 * (stretch + np.swapaxes(stretch, 1, 2)) - np.eye(3)) @ np.swapaxes(r, 1, 2)
    det = np.linalg.det(f)[:, None, None]
    if isinstance(model, NeoHookean):
        piola = _neo_hookean(f, det, mu, lam)
    elif isinstance(model, Ogden):
        part = sum(part_of_volume(*term) for term in model.terms)
        piola = _neo_hookean(f, det, part * mu, lam) + mu * _ogden_excess(f, model.terms)
    else:
        piola = f @ hooke(green_strain(f)) @ np.swapaxes(f, 1, 2)
    return piola / np.maximum(np.abs(det), LEAST_J)


def _neo_hookean(f: Tensors, det: Tensors, mu: Tensors, lam: Tensors) -> Tensors:
    """P F^T = mu (F F^T - J I) + V'(J) J I with the volumetric energy's slope V', continued as in the kernels."""
    d = np.maximum(det, CONTINUED_BELOW)
    slope = (lam * np.log(d) + mu * (d - 1.0)) / d
    curvature = (mu + lam * (1.0 - np.log(CONTINUED_BELOW))) / CONTINUED_BELOW**2
    slope = slope + np.minimum(det - CONTINUED_BELOW, 0.0) * curvature
    return mu * (f @ np.swapaxes(f, 1, 2) - det * np.eye(3)) + slope * det * np.eye(3)


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


def _trace(a: Tensors) -> Tensors:
    return np.trace(a, axis1=1, axis2=2)[:, None, None]


def _rotations(f: Tensors) -> Tensors:
    """The proper rotations nearest to F."""
    u, _, vt = np.linalg.svd(f)
    u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    return u @ vt
