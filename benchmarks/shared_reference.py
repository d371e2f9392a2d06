"""Float64 forces of a dilatation that groups of elements share, on a sample of a mesh's elements."""

from __future__ import annotations

import numpy as np
from problem import Sample

#: Below this J the logarithm of neo-Hookean tissue is continued by a parabola.
CONTINUED_BELOW = 0.5
#: An element is held on its own from this |theta| on; over this range its stiffness grows to lambda.
FREE, RAMP = 0.25, 0.5


def cofactors(F: np.ndarray) -> np.ndarray:
    """Cofactors of matrices [n, 3, 3]."""
    rows = [np.cross(F[:, (i + 1) % 3], F[:, (i + 2) % 3]) for i in range(3)]
    return np.stack(rows, axis=1)


def measured(law: str, F: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """theta [n] and d theta / dF [n, 3, 3] of deformation gradients, for a law of the oracle."""
    if law == "linear":
        return np.trace(F, axis1=1, axis2=2) - 3.0, np.broadcast_to(np.eye(3), F.shape)
    if law == "stvk":
        return 0.5 * (np.einsum("nij,nij->n", F, F) - 3.0), F
    return np.linalg.det(F) - 1.0, cofactors(F)


def slope(law: str, theta: np.ndarray) -> np.ndarray:
    """w'(theta): theta itself, or ln(J) / J of neo-Hookean tissue."""
    if law != "neo_hookean":
        return theta
    J = np.maximum(1.0 + theta, CONTINUED_BELOW)
    return np.log(J) / J + (1.0 - np.log(J)) / J**2 * np.minimum(1.0 + theta - CONTINUED_BELOW, 0.0)


def held(law: str, theta: np.ndarray) -> np.ndarray:
    """h'(theta) of single elements."""
    if law in ("linear", "stvk"):
        return np.zeros_like(theta)
    beyond = np.maximum(np.abs(theta) - FREE, 0.0)
    far = np.maximum(beyond - RAMP, 0.0)
    return np.sign(theta) * (beyond**2 - far**2) / (2.0 * RAMP)


def pressure_forces(
    law: str,
    sample: Sample,
    points: np.ndarray,
    tets: np.ndarray,
    u: np.ndarray,
    groups: np.ndarray,
    lam: np.ndarray,
) -> np.ndarray:
    """Nodal forces [n, 3] of the shared dilatation, at the sample's nodes [N].

    Args:
        law: A law of the oracle.
        sample: Nodes with their elements.
        points, tets: The whole mesh at rest.
        u: Displacements [N, 3] of the whole mesh.
        groups: The group of each element, int [T].
        lam: Lamé's first parameter of each element [T].
    """
    wanted = np.zeros(int(groups.max()) + 1, bool)
    wanted[groups[sample.elements]] = True
    members = np.flatnonzero(wanted[groups])
    rest, moved = points[tets[members]], (points + u)[tets[members]]
    edges, deformed = (np.swapaxes(x[:, 1:] - x[:, :1], 1, 2) for x in (rest, moved))
    theta, _ = measured(law, deformed @ np.linalg.inv(edges))
    weights = lam[members] * np.abs(np.linalg.det(edges)) / 6.0
    sums, totals = (np.bincount(groups[members], w, len(wanted)) for w in (weights * theta, weights))
    pressures = slope(law, sums / np.where(totals > 0.0, totals, 1.0))

    mesh = sample.mesh
    F = mesh.deformation_gradients(points[sample.used] + u[sample.used].astype(float))
    theta, change = measured(law, F)
    own = lam[sample.elements] * (pressures[groups[sample.elements]] + held(law, theta))
    forces = -np.einsum("t,tiJ,taJ->tai", mesh.volumes * own, change, mesh.gradients)
    return mesh.assemble(forces)[sample.rows]
