"""Derivatives with respect to the users' input, from those with respect to the kernels' input."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from warp_corot.errors import InputError
from warp_corot.inputs.checks import shown

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody

Array = npt.NDArray[np.float64]

#: The sums of ``ElementWork`` that each of these needs.
NEEDS = {
    "young": "lame",
    "poisson": "lame",
    "rest": "rest",
    "activation": "activation",
    "density": None,
    "loads": None,
    "boundary": None,
    "gravity": None,
    "obstacles": None,
}


def needed(names: Sequence[str]) -> set[str]:
    """The sums of ``ElementWork`` for derivatives of these names."""
    return {need for name in names if (need := NEEDS.get(name)) is not None}


def checked_names(wrt: str | Sequence[str], known: Collection[str]) -> tuple[str, ...]:
    """Names of derivatives, each once.

    Raises:
        InputError: A name is not one of those known, or there are none.
    """
    given = (wrt,) if isinstance(wrt, str) or not isinstance(wrt, Iterable) else tuple(wrt)
    names = tuple(each for place, each in enumerate(given) if each not in given[:place])
    wanted = ", ".join(map(repr, known))
    for name in names:
        if not isinstance(name, str) or name not in known:
            raise InputError(f"wrt has {shown(name)}; it must be one or several of {wanted}")
    if not names:
        raise InputError(f"wrt is empty; it must be one or several of {wanted}")
    return names


def requested(found: object, name: str, known: Collection[str]) -> Any:
    """A derivative by its name.

    Raises:
        InputError: It was not requested.
    """
    if name not in known or getattr(found, name) is None:
        raise InputError(f"{shown(name)} is not one of the requested derivatives")
    return getattr(found, name)


def of_young(body: SoftBody, of_mu: Array, of_lam: Array) -> Array | float:
    """The derivative with respect to Young's modulus, in the shape of the material's value."""
    _, nu = _young_and_poisson(body)
    d_mu, d_lam = 1.0 / (2.0 * (1.0 + nu)), nu / ((1.0 + nu) * (1.0 - 2.0 * nu))
    return _of_shape(body, "young", d_mu * _filled(body, of_mu) + d_lam * _filled(body, of_lam))


def of_poisson(body: SoftBody, of_mu: Array, of_lam: Array) -> Array | float:
    """The derivative with respect to Poisson's ratio, in the shape of the material's value."""
    young, nu = _young_and_poisson(body)
    d_mu = -young / (2.0 * (1.0 + nu) ** 2)
    d_lam = young * (1.0 + 2.0 * nu**2) / ((1.0 + nu) * (1.0 - 2.0 * nu)) ** 2
    return _of_shape(body, "poisson", d_mu * _filled(body, of_mu) + d_lam * _filled(body, of_lam))


def of_density(body: SoftBody, work: Array) -> Array | float:
    """The derivative with respect to density, in the shape of the material's value.

    Args:
        work: The work of the nodes' accelerations in the adjoint motion for each unit of mass, [worlds * N].
    """
    return _of_shape(body, "density", _filled(body, body.mesh.volumes * means_of_elements(body, work)))


def weight_densities(body: SoftBody, work: Array) -> Array:
    """The work of ``of_density`` for each unit of elements' volume, [worlds * T]."""
    density = np.broadcast_to(np.asarray(body.material.density), (body.worlds, len(body.mesh.tets)))
    return np.asarray(_filled(body, density * means_of_elements(body, work))).ravel()


def means_of_elements(body: SoftBody, values: Array) -> Array:
    """Means of nodal values, [worlds * N], over elements, [worlds, T]."""
    return np.asarray(values.reshape(body.worlds, -1)[:, body.mesh.tets].mean(axis=2))


def _young_and_poisson(body: SoftBody) -> tuple[Array, Array]:
    material = body.material.isotropic
    return np.asarray(material.young, np.float64), np.asarray(material.poisson, np.float64)


def _filled(body: SoftBody, values: Array) -> Array:
    """Values of elements times their filled fraction, [worlds, T]."""
    fill = body.discretization.fill
    of_worlds = values.reshape(body.worlds, -1)
    return of_worlds if fill is None else of_worlds * fill


def _of_shape(body: SoftBody, name: str, values: Array) -> Array | float:
    """Values of elements, [worlds, T], summed to the shape of a field of the material: the derivative with respect to a
    value of many elements is a sum over them.
    """
    shape = np.shape(getattr(body.material, name))
    if shape == ():
        return float(values.sum())
    if len(shape) == 1:
        values = values.sum(axis=0)
        return values if shape == values.shape else values.sum(keepdims=True)
    for axis, count in enumerate(shape):
        if count == 1:
            values = values.sum(axis=axis, keepdims=True)
    return values
