"""How large an explicit step may be: the largest frequency of the body about its rest shape."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

if TYPE_CHECKING:
    from ..body import SoftBody
    from ..elasticity import ForceField

LANCZOS_STEPS = 30

# Probing displacements as a share of the smallest element's size: small enough to be linear, large enough for float32.
PROBE = 1e-3


def largest_frequency(body: SoftBody, field: ForceField) -> float:
    """Largest angular frequency [rad/s] of small motions about rest; explicit central differences need dt < 2 / it.

    Lanczos' iteration on M^-1/2 K M^-1/2, where K is applied as the force field itself does it for small displacements,
    so that whatever model and elements there are is what is measured. The Ritz value's residual is added to it. Zero if
    no node is free to move.
    """
    weight = np.sqrt(body.node_inverse_mass.numpy().astype(np.float64))
    free = weight > 0
    if not free.any():
        return 0.0
    probe = PROBE * float(np.min(body.mesh.volumes)) ** (1.0 / 3.0)
    u = np.zeros((body.node_count, 4), np.float32)
    u_device = wp.zeros_like(body.node_displacements)
    f_device = wp.zeros_like(body.node_forces)

    def apply(q: np.ndarray) -> np.ndarray:
        motion = weight[:, None] * q
        scale = probe / np.abs(motion).max()
        u[:, :3] = scale * motion
        u_device.assign(u)
        f_device.zero_()
        field.add_forces(u_device, f_device)
        return -(weight[:, None] / scale) * f_device.numpy()[:, :3]

    rng = np.random.default_rng(0)
    q = rng.standard_normal((body.node_count, 3)) * free[:, None]
    q /= np.linalg.norm(q)
    before = np.zeros_like(q)
    diagonal: list[float] = []
    off: list[float] = [0.0]
    with field.state_kept():
        for _ in range(min(LANCZOS_STEPS, 3 * int(free.sum()))):
            w = apply(q) - off[-1] * before
            diagonal.append(float(np.vdot(q, w)))
            w -= diagonal[-1] * q
            off.append(float(np.linalg.norm(w)))
            if off[-1] <= 1e-6 * max(map(abs, diagonal)):
                break
            before, q = q, w / off[-1]
    size = len(diagonal)
    tridiagonal = np.diag(diagonal) + np.diag(off[1:size], 1) + np.diag(off[1:size], -1)
    values, vectors = np.linalg.eigh(tridiagonal)
    bound = values[-1] + off[size] * abs(vectors[-1, -1])
    return float(np.sqrt(max(bound, 0.0)))
