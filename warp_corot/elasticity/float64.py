"""Laws, stress tensors and the dilatation that elements share in float64, on the host: the templates of the CPU's fast
kernels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import warp as wp
from scipy.sparse import coo_matrix, csr_matrix

from warp_corot.errors import ConvergenceError
from warp_corot.kernels.elements import float64 as kernels
from warp_corot.kernels.elements.simd8 import IsotropicLaw
from warp_corot.materials.isotropic import Isotropic

from .corotated.model import Corotated
from .dilatation import DilatationField
from .laws import LawModel, Linear, Ogden
from .model import Model
from .springs import EdgeStVK, MassSpring

Array = npt.NDArray[np.float64]
#: An isotropic law's name or terms, as ``kernels.elements.simd8`` has them.
STVK, COROTATED = "stvk", "corotated"
#: Keeps |J| away from zero, as in ``kernels.elements.constitutive``.
LEAST_J = 1.0e-3


def float64_law(model: Model) -> IsotropicLaw | None:
    """The law of a model whose elements have own rotations; None if it does not exist in float64."""
    if type(model) is EdgeStVK and model.springs == "biquadratic":
        return STVK
    if type(model) is Corotated:
        return COROTATED
    return model.law if isinstance(model, LawModel) else None


def stresses(law: IsotropicLaw, a: Array, mu: npt.ArrayLike, lam: npt.ArrayLike, da: Array | None = None) -> Stresses:
    """First Piola-Kirchhoff stress P of displacement gradients.

    Args:
        law: The law.
        a: F - I, [T, 3, 3].
        mu, lam: Lamé's parameters [Pa], numbers or [T].
        da: Directions of the differential, [T, 3, 3]; None: zero.
    """
    count = len(a)
    lame = (np.broadcast_to(np.asarray(values, np.float64), count) for values in (mu, lam))
    given = [_matrices(a), _matrices(np.zeros_like(a) if da is None else da)]
    given += [wp.array(np.ascontiguousarray(values), dtype=wp.float64, device="cpu") for values in lame]
    p, dp, valid = (wp.zeros(count, dtype=kind, device="cpu") for kind in (wp.mat33d, wp.mat33d, wp.bool))
    wp.launch(kernels.stresses(law), count, given, [p, dp, valid], device="cpu")
    return Stresses(p.numpy(), dp.numpy(), valid.numpy())


class Stresses(NamedTuple):
    """Stresses P and their differentials [Pa], [T, 3, 3].

    Attributes:
        valid: Where the law holds, bool [T]; elsewhere P is zero: the corotated law needs a definite rotation.
    """

    p: Array
    dp: Array
    valid: npt.NDArray[np.bool_]

    def checked(self) -> Stresses:
        """The same.

        Raises:
            ConvergenceError: The law does not hold in an element.
        """
        if not self.valid.all():
            raise ConvergenceError(f"{(~self.valid).sum()} elements are so crushed that they have no rotation")
        return self


def displacement_gradients(points: npt.ArrayLike, tets: npt.ArrayLike, displacements: npt.ArrayLike) -> Array:
    """F - I of tetrahedra, [T, 3, 3].

    Args:
        points: At rest [m], [N, 3].
        tets: [T, 4].
        displacements: [m], [N, 3].
    """
    x, u, t = np.asarray(points, np.float64), np.asarray(displacements, np.float64), np.asarray(tets)
    rest, moved = (np.swapaxes(values[t[:, 1:]] - values[t[:, :1]], 1, 2) for values in (x, u))
    return np.asarray(moved @ np.linalg.inv(rest))


def green_strain(a: Array) -> Array:
    """Green-Lagrange strain (F^T F - I) / 2 of displacement gradients, [T, 3, 3]."""
    return 0.5 * (a + np.swapaxes(a, 1, 2) + np.swapaxes(a, 1, 2) @ a)


def has_tensor(model: Model, material: object) -> bool:
    """Whether `cauchy_stress` knows the law."""
    shared = getattr(model, "rotation_level", None) is not None
    known = isinstance(model, LawModel) or type(model) in (Corotated, Ogden, EdgeStVK, MassSpring)
    return known and isinstance(material, Isotropic) and not shared


def cauchy_stress(model: Model, a: Array, young: npt.ArrayLike, poisson: npt.ArrayLike) -> Array:
    """Cauchy stress [Pa], [T, 3, 3]; `Simulation.von_mises` is its equivalent stress.

    For Corotated it is the stress of the law, R (2 mu e + lambda tr(e) I) R^T with e = sym(R^T F) - I, zero in elements
    without a definite rotation; for Linear it is that of small strains. Both are without the factor 1 / J.

    Args:
        model: The elastic law; see `has_tensor`.
        a: Displacement gradients F - I.
        young: Young's modulus [Pa], a number or [T].
        poisson: Poisson's ratio, likewise.
    """
    e, nu = np.asarray(young, np.float64), np.asarray(poisson, np.float64)
    mu, lam = e / (2.0 * (1.0 + nu)), e * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))
    if isinstance(model, MassSpring):
        mu = lam = 0.4 * e  # springs have a Poisson's ratio of 1/4
    law = model.terms if isinstance(model, Ogden) else float64_law(model) or STVK
    piola, f = stresses(law, a, mu, lam).p, np.eye(3) + a
    if isinstance(model, Linear):
        return piola
    if isinstance(model, Corotated):
        rotations = f - stresses(law, a, 0.5, 0.0).p  # P = 2 mu (F - R) + ...
        return np.asarray(piola @ np.swapaxes(rotations, 1, 2))
    kirchhoff = piola @ np.swapaxes(f, 1, 2)
    return np.asarray(kirchhoff / np.maximum(np.abs(np.linalg.det(f)), LEAST_J)[:, None, None])


class Measured(NamedTuple):
    """Dilatations of elements.

    Attributes:
        theta: [T].
        held, stiffness: h' and h'' of theta, [T].
        slope, turning: d theta / dF and its differential, [T, 3, 3].
    """

    theta: Array
    held: Array
    stiffness: Array
    slope: Array
    turning: Array


class SharedDilatation:
    """The shared dilatation of a field, for the elements of one world; see ``kernels.elements.dilatation``.

    Args:
        field: The field.

    Attributes:
        sharing: The weights of elements in groups, sparse [groups, T]: one for each element of a group.
    """

    def __init__(self, field: DilatationField):
        self._of, count = field.of, len(field.discretization.mesh.tets)
        groups = [group for group in field.groups() if len(group) and group[0] < count]
        rows = np.repeat(np.arange(len(groups)), [len(group) for group in groups])
        columns = np.concatenate(groups)
        self.sharing = csr_matrix(coo_matrix((np.ones(len(columns)), (rows, columns)), (len(groups), count)))

    def measure(self, a: Array, da: Array | None = None) -> Measured:
        """Measure displacement gradients, in the direction ``da`` if there is one; both [T, 3, 3]."""
        numbers = wp.zeros(len(a), dtype=wp.vec3d, device="cpu")
        slope, turning = (wp.zeros(len(a), dtype=wp.mat33d, device="cpu") for _ in range(2))
        given = [_matrices(a), _matrices(np.zeros_like(a) if da is None else da)]
        wp.launch(kernels.dilatations(self._of), len(a), given, [numbers, slope, turning], device="cpu")
        theta, held, stiffness = numbers.numpy().T
        return Measured(theta, held, stiffness, slope.numpy(), turning.numpy())

    def law(self, theta: Array) -> tuple[Array, Array]:
        """w' and w'' of shared dilatations, [groups]."""
        found = wp.zeros(len(theta), dtype=wp.vec2d, device="cpu")
        given = [wp.array(theta, dtype=wp.float64, device="cpu")]
        wp.launch(kernels.pressures(self._of), len(theta), given, [found], device="cpu")
        slope, curvature = found.numpy().T
        return slope, curvature

    def means(self, weights: Array, values: Array) -> Array:
        """Means of elements' values over groups, [groups]; zero for groups without weight."""
        total = self.sharing @ weights
        return np.asarray((self.sharing @ (weights * values)) / np.where(total != 0.0, total, 1.0))


def _matrices(values: Array) -> wp.array:
    return wp.array(np.ascontiguousarray(values), dtype=wp.mat33d, device="cpu")
