"""States on the way to the static answer of a body that hardly changes its volume.

Along the direction of Newton's method, volumes are kept to first order only. With a lambda of thousands of mu, the rest
costs so much energy that a line search takes hundreds of short steps where tissue turns far. So bodies with a smaller
lambda are solved first, each from the answer of the one before.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from warp_corot.elasticity import ForceField

#: Lambda over mu of the first body; those that follow have more by this factor.
FIRST, FACTOR = 4.0, 10.0


def limits(field: ForceField) -> list[float]:
    """Ascending limits of lambda over mu up to a field's own, which is not included; empty if it needs none."""
    discretization = field.discretization
    if discretization.is_anisotropic or field.is_linear:
        return []
    mu, lam = discretization.mu.numpy(), discretization.lam.numpy()
    most = float(np.max(lam[mu > 0.0] / mu[mu > 0.0], initial=0.0))
    found = []
    limit = FIRST
    while limit * FACTOR <= 2.0 * most:
        found.append(limit)
        limit *= FACTOR
    return found


@contextmanager
def limited(field: ForceField, limit: float) -> Iterator[None]:
    """Inside this block, lambda of a field is at most this many times mu; launches that were recorded before use it,
    too.
    """
    discretization = field.discretization
    mu, lam = discretization.mu.numpy(), discretization.lam.numpy().copy()
    discretization.lam.assign(np.minimum(lam, limit * mu))
    field.take_material()
    try:
        yield
    finally:
        discretization.lam.assign(lam)
        field.take_material()
