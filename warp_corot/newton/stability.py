"""How large a time step of a model may be; see ``solvers.stable_step``."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import warp as wp

from ..kernels.constitutive import linear_stress
from ..kernels.elements import GeneralElements
from ..kernels.forces import scatter_forces
from ..kernels.lanczos import add_scaled
from ..solvers import largest_frequency
from .library import newton


class _Particles:
    """What of a body ``largest_frequency`` looks at."""

    def __init__(self, model: newton.Model, volumes: npt.NDArray[np.float64]):
        active = (model.particle_flags.numpy() & int(newton.ParticleFlags.ACTIVE)) != 0
        inverse = np.where(active, model.particle_inv_mass.numpy(), 0.0)
        self.device = model.device
        self.node_count = self.launch_nodes = model.particle_count
        self.node_inverse_mass = wp.array(inverse, dtype=wp.float32, device=model.device)
        self.node_displacements = wp.zeros(model.particle_count, dtype=wp.vec4, device=model.device)
        self.smallest_volume = float(volumes.min())


class _Springs:
    """Forces of small displacements from rest: of elements, and of a spring at every particle.

    Elements turn with their rotations; where there are none to speak of, the model is linear elasticity.
    """

    def __init__(self, elements: Any, mu: wp.array, lam: wp.array, stiffness: float):
        self.elements, self.stiffness = elements, stiffness
        self.lame = [mu, lam, 1]
        self.kernel = scatter_forces(GeneralElements, linear_stress)

    def add_forces(self, u: wp.array, f: wp.array) -> None:
        count = len(self.elements.volume)
        wp.launch(self.kernel, dim=count, inputs=[self.elements, *self.lame, u], outputs=[f], device=u.device)
        wp.launch(add_scaled, dim=len(u), inputs=[-self.stiffness, u], outputs=[f], device=u.device)

    @contextmanager
    def state_kept(self) -> Iterator[None]:
        yield


def stable_step(
    model: newton.Model,
    elements: Any,
    mu: wp.array,
    lam: wp.array,
    stiffness: float,
    damped: bool,
    lightest: float = 0.0,
) -> float:
    """The largest stable step of symplectic Euler about rest [s]; infinite if nothing can move.

    With the largest frequency w and the largest rate of damping c (each of its own motion, so that this is never too
    large) it is stable while w^2 dt^2 + 2 c dt < 4.

    Args:
        elements: All tetrahedra.
        mu, lam: Lamé's parameters [Pa], float32 [T].
        stiffness: Of a spring at every particle [N/m], for contact.
        damped: Whether there is any k_damp.
        lightest: Inverse mass of the lightest body at the other end of such a spring [1/kg]; 0: none moves. Bodies that
            are touched in several places need no shorter steps; see ``kernels.newton_contacts``.
    """
    body = cast(Any, _Particles(model, elements.volume.numpy().astype(np.float64)))
    w = largest_frequency(body, cast(Any, _Springs(elements, mu, lam, stiffness)))
    w = math.sqrt(w * w + stiffness * lightest)
    c = 0.0
    if damped:
        viscosity = model.tet_materials.numpy().reshape(-1, 3)[:, 2]
        half, whole = (wp.array(s * viscosity, dtype=wp.float32, device=model.device) for s in (0.5, 1.0))
        c = largest_frequency(body, cast(Any, _Springs(elements, half, whole, 0.0))) ** 2
    if w == 0.0 and c == 0.0:
        return math.inf
    return 4.0 / (c + math.sqrt(c * c + 4.0 * w * w))


def warn_of_left_out(model: newton.Model) -> None:
    """Say in a line what stable steps leave out."""
    there = [
        name
        for name, count, stiffness, columns in (
            ("springs", model.spring_count, model.spring_stiffness, 1),
            ("triangles", model.tri_count, model.tri_materials, 2),
            ("bending edges", model.edge_count, model.edge_bending_properties, 1),
        )
        if count and np.any(stiffness.numpy().reshape(count, -1)[:, :columns])
    ]
    if there:
        warnings.warn(
            f"the model has {' and '.join(there)} with stiffness, which stable_dt, contact_dt and substeps=None leave "
            "out: make steps short enough for them, too",
            UserWarning,
            stacklevel=3,
        )
