"""A shared dilatation on the host, in float64; see ``kernels.elements.dilatation``."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix, csr_matrix

from warp_corot.elasticity.host_laws import cofactor, cofactor_differential, volumetric
from warp_corot.kernels.elements import dilatation as kernels

from .field import DilatationField

Array = npt.NDArray[np.float64]


class Measured(NamedTuple):
    """Dilatations of elements.

    Attributes:
        theta: [T].
        slope: d theta / dF, [T, 3, 3].
        held, stiffness: h' and h'' of theta, [T].
    """

    theta: Array
    slope: Array
    held: Array
    stiffness: Array


class HostDilatation:
    """The shared dilatation of a field, for the elements of one world.

    Args:
        field: The field.

    Attributes:
        sharing: The weights of elements in groups, [groups, T].
    """

    def __init__(self, field: DilatationField):
        self._of, self.sharing = field.of, sharing_of(field)

    def measure(self, f: Array) -> Measured:
        """Measure the dilatations of deformation gradients [T, 3, 3]."""
        of = self._of
        if of is kernels.SMALL:
            theta, slope = np.trace(f, axis1=1, axis2=2) - 3.0, np.broadcast_to(np.eye(3), f.shape)
        elif of is kernels.GREEN:
            theta, slope = 0.5 * (np.sum(f * f, axis=(1, 2)) - 3.0), f
        else:
            theta, slope = np.linalg.det(f) - 1.0, cofactor(f)
        if of in (kernels.SMALL, kernels.GREEN):
            return Measured(theta, slope, np.zeros_like(theta), np.zeros_like(theta))
        free, ramp = float(kernels.FREE), float(kernels.RAMP)
        beyond = np.maximum(np.abs(theta) - free, 0.0)
        near = np.minimum(beyond, ramp)
        return Measured(theta, slope, np.sign(theta) * (0.5 * near**2 / ramp + beyond - near), near / ramp)

    def turning(self, f: Array, df: Array) -> Array:
        """The differential of d theta / dF."""
        if self._of is kernels.SMALL:
            return np.zeros_like(f)
        return df if self._of is kernels.GREEN else cofactor_differential(f, df)

    def law(self, theta: Array) -> tuple[Array, Array]:
        """w' and w'' of shared dilatations."""
        if self._of is not kernels.LOG_VOLUME:
            return theta, np.ones_like(theta)
        slope, curvature = volumetric((1.0 + theta)[:, None, None], 0.0, 1.0)
        return slope[:, 0, 0], curvature[:, 0, 0]

    def means(self, weights: Array, values: Array) -> Array:
        """Means of elements' values over groups, [groups]; zero for groups without weight."""
        total = self.sharing @ weights
        return np.asarray((self.sharing @ (weights * values)) / np.where(total != 0.0, total, 1.0))


def sharing_of(field: DilatationField) -> Any:
    """The elements of one world that share a dilatation, sparse [groups, T]: one for each element of a group."""
    count = len(field.discretization.mesh.tets)
    groups = [group for group in field.groups() if len(group) and group[0] < count]
    rows = np.repeat(np.arange(len(groups)), [len(group) for group in groups])
    columns = np.concatenate(groups)
    return csr_matrix(coo_matrix((np.ones(len(columns)), (rows, columns)), (len(groups), count)))
