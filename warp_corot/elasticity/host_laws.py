"""Stresses of isotropic laws and their differentials on the host, for results in float64.

They are those of ``kernels.elements.constitutive``, for deformation gradients F [T, 3, 3] and Lamé's parameters [T, 1,
1].
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from warp_corot.elasticity.corotated.model import Corotated
from warp_corot.kernels.elements.constitutive import CONTINUED_BELOW

from .edge_stvk import EdgeStVK
from .linear import Linear
from .model import Model
from .neo_hookean import NeoHookean
from .stvk import StVenantKirchhoff

Tensors = npt.NDArray[np.float64]
_I = np.eye(3)


class HostLaw(NamedTuple):
    """A law's first Piola-Kirchhoff stress [Pa], [T, 3, 3].

    Attributes:
        stress: P of F, mu and lambda.
        differential: dP of F, dF, mu and lambda.
    """

    stress: Callable[..., Tensors]
    differential: Callable[..., Tensors]


def host_law(model: Model) -> HostLaw | None:
    """The law of a model whose elements have own rotations and dilatations; None if there is none."""
    if type(model) is EdgeStVK and model.springs == "biquadratic":
        return LAWS[StVenantKirchhoff]
    return LAWS.get(type(model))


def _turned(a: Tensors) -> Tensors:
    return np.swapaxes(a, -1, -2)


def _symmetric(a: Tensors) -> Tensors:
    return 0.5 * (a + _turned(a))


def _trace(a: Tensors) -> Tensors:
    return np.trace(a, axis1=-2, axis2=-1)[..., None, None]


def _product(a: Tensors, b: Tensors) -> Tensors:
    """a : b."""
    return np.sum(a * b, axis=(-2, -1))[..., None, None]


def _hooke(strain: Tensors, mu: Any, lam: Any) -> Tensors:
    return 2.0 * mu * strain + lam * _trace(strain) * _I


def _linear_stress(f: Tensors, mu: Any, lam: Any) -> Tensors:
    return _hooke(_symmetric(f) - _I, mu, lam)


def _linear_differential(f: Tensors, df: Tensors, mu: Any, lam: Any) -> Tensors:
    return _hooke(_symmetric(df), mu, lam)


def _stvk_stress(f: Tensors, mu: Any, lam: Any) -> Tensors:
    return f @ _hooke(0.5 * (_turned(f) @ f - _I), mu, lam)


def _stvk_differential(f: Tensors, df: Tensors, mu: Any, lam: Any) -> Tensors:
    return df @ _hooke(0.5 * (_turned(f) @ f - _I), mu, lam) + f @ _hooke(_symmetric(_turned(f) @ df), mu, lam)


def rotation(f: Tensors) -> Tensors:
    """The proper rotations nearest to F."""
    u, _, vt = np.linalg.svd(f)
    u[..., :, 2] *= np.sign(np.linalg.det(u @ vt))[..., None]
    return u @ vt


def _corotated_stress(f: Tensors, mu: Any, lam: Any) -> Tensors:
    r = rotation(f)
    return 2.0 * mu * (f - r) + lam * (_product(r, f) - 3.0) * r


def _corotated_differential(f: Tensors, df: Tensors, mu: Any, lam: Any) -> Tensors:
    """With dR = R [w]x, (tr(S) I - S) w = axial(R^T dF)."""
    r = rotation(f)
    stretch, b = _symmetric(_turned(r) @ f), _turned(r) @ df
    axial = np.stack([b[..., 2, 1] - b[..., 1, 2], b[..., 0, 2] - b[..., 2, 0], b[..., 1, 0] - b[..., 0, 1]], axis=-1)
    w = np.linalg.solve(_trace(stretch) * _I - stretch, axial[..., None])[..., 0]
    skew = np.zeros_like(b)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        skew[..., k, j], skew[..., j, k] = w[..., i], -w[..., i]
    turning = r @ skew
    return 2.0 * mu * (df - turning) + lam * _product(r, df) * r + lam * (_product(r, f) - 3.0) * turning


def cofactor(f: Tensors) -> Tensors:
    """The derivative of det F."""
    c0, c1, c2 = (f[..., :, k] for k in range(3))
    return np.stack([np.cross(c1, c2), np.cross(c2, c0), np.cross(c0, c1)], axis=-1)


def cofactor_differential(f: Tensors, df: Tensors) -> Tensors:
    """Its differential in the direction dF."""
    (c0, c1, c2), (d0, d1, d2) = ([a[..., :, k] for k in range(3)] for a in (f, df))
    pairs = ((c1, c2, d1, d2), (c2, c0, d2, d0), (c0, c1, d0, d1))
    return np.stack([np.cross(da, b) + np.cross(a, db) for a, b, da, db in pairs], axis=-1)


def volumetric(f: Tensors, mu: Any, lam: Any) -> tuple[Tensors, Tensors]:
    """U'(J) and U''(J) of U = -mu ln J + lambda/2 (ln J)^2, J = det F; U is a parabola below ``CONTINUED_BELOW``."""
    det = np.linalg.det(f)[..., None, None]
    j = np.maximum(det, CONTINUED_BELOW)
    slope, curvature = (lam * np.log(j) - mu) / j, (mu + lam * (1.0 - np.log(j))) / j**2
    return slope + curvature * np.minimum(det - CONTINUED_BELOW, 0.0), curvature


def _neo_hookean_stress(f: Tensors, mu: Any, lam: Any) -> Tensors:
    return mu * f + volumetric(f, mu, lam)[0] * cofactor(f)


def _neo_hookean_differential(f: Tensors, df: Tensors, mu: Any, lam: Any) -> Tensors:
    slope, curvature = volumetric(f, mu, lam)
    cof = cofactor(f)
    return mu * df + slope * cofactor_differential(f, df) + curvature * _product(cof, df) * cof


LAWS: dict[type[Model], HostLaw] = {
    Linear: HostLaw(_linear_stress, _linear_differential),
    StVenantKirchhoff: HostLaw(_stvk_stress, _stvk_differential),
    Corotated: HostLaw(_corotated_stress, _corotated_differential),
    NeoHookean: HostLaw(_neo_hookean_stress, _neo_hookean_differential),
}
