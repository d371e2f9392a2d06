"""The largest stable time step of a model; see ``solvers.stable_step``."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import warp as wp

from warp_corot.elasticity.model import isotropic_material
from warp_corot.errors import InputError
from warp_corot.kernels.elements.constitutive import IsotropicMaterial, linear_stress
from warp_corot.kernels.elements.elements import GeneralElements
from warp_corot.kernels.elements.forces import law_stress, scatter_forces
from warp_corot.kernels.stepping.lanczos import add_scaled, scale_by
from warp_corot.solvers.steps.stable_step import SmallForces, largest_eigenvalue

from .contact import Contacts
from .library import newton
from .others import Others
from .tetrahedra import Tetrahedra

#: Fraction of the largest stable step that errors suggest: elements stiffen when strained.
SAFETY = 0.7
#: Number of attempts to lengthen a step, and the largest eigenvalue, of 4, from which it is long enough.
LENGTHENINGS = 6
ENOUGH = 3.95


class _SmallMotions:
    """Forces of small displacements from rest, or of velocities there: of elements, of everything else, and of a
    spring or damper at every particle.

    Elements turn with their rotations; if these are negligible, the model is linear elasticity.
    """

    def __init__(
        self, elements: GeneralElements, mu: wp.array, lam: wp.array, others: Others, damping: bool, at_particles: float
    ):
        self.elements, self.others, self.damping, self.at_particles = elements, others, damping, at_particles
        self.material = isotropic_material([mu, lam, 1])
        self.kernel = scatter_forces(GeneralElements, IsotropicMaterial, law_stress(linear_stress))

    def add_forces(self, u: wp.array, f: wp.array) -> None:
        count = len(self.elements.volume)
        wp.launch(self.kernel, dim=count, inputs=[self.elements, self.material, u], outputs=[f], device=u.device)
        self.others.add_linear_forces(u, f, self.damping)
        wp.launch(add_scaled, dim=len(u), inputs=[-self.at_particles, u], outputs=[f], device=u.device)

    @contextmanager
    def state_kept(self) -> Iterator[None]:
        yield


class _Sum:
    """dt^2 K + 2 dt C, as forces."""

    def __init__(self, dt: float, elastic: _SmallMotions, viscous: _SmallMotions):
        self.parts = (dt * dt, elastic), (2.0 * dt, viscous)
        #: The scaled displacements of each part, kept because launches may be recorded.
        self._scaled: list[wp.array] = []

    def add_forces(self, u: wp.array, f: wp.array) -> None:
        if not self._scaled:
            self._scaled = [wp.empty_like(u) for _ in self.parts]
        for (factor, motions), scaled in zip(self.parts, self._scaled, strict=True):
            wp.copy(scaled, u)
            wp.launch(scale_by, dim=len(u), inputs=[factor, scaled], device=u.device)
            motions.add_forces(scaled, f)

    @contextmanager
    def state_kept(self) -> Iterator[None]:
        yield


def stable_step(
    tets: Tetrahedra, others: Others, stiffness: float = 0.0, damping: float = 0.0, of_bodies: float = 0.0
) -> float:
    """The largest stable step of symplectic Euler about rest [s]; infinite if nothing can move.

    It is stable while no eigenvalue of dt^2 M^-1 K + 2 dt M^-1 C is above 4. With w^2 the largest eigenvalue of M^-1 K
    and c that of M^-1 C, which may belong to other motions, w^2 dt^2 + 2 c dt = 4 gives a step that is short enough;
    then it is lengthened as far as possible. K and C are those of tetrahedra at rest and of springs, triangles and
    bending edges about the model's initial positions, all together.

    Args:
        tets, others: The parts of the model.
        stiffness: Stiffness of a spring at every particle [N/m], for contact.
        damping: Damping of a damper at every particle [N s/m].
        of_bodies: Stiffness over mass at the other end of this spring [1/s^2]; 0: that end does not move. Bodies that
            are touched in several places need no shorter steps; see ``kernels.newton.yielding``.
    """
    model = tets.model
    active = (model.particle_flags.numpy() & int(newton.ParticleFlags.ACTIVE)) != 0
    inverse = np.where(active, model.particle_inv_mass.numpy(), 0.0)
    inverse_mass = wp.array(inverse, dtype=wp.float32, device=model.device)
    smallest = float(tets.elements.volume.numpy().astype(np.float64).min())

    def largest(motions: SmallForces) -> float:
        return largest_eigenvalue(motions, inverse_mass, smallest, model.particle_count)

    elastic = _SmallMotions(tets.elements, tets.mu, tets.lam, others, False, stiffness)
    w2 = largest(elastic) + of_bodies
    if not (tets.damped or others.damped or damping > 0):
        return 2.0 / math.sqrt(w2) if w2 > 0 else math.inf
    viscosity = model.tet_materials.numpy().reshape(-1, 3)[:, 2]
    half, whole = (wp.array(s * viscosity, dtype=wp.float32, device=model.device) for s in (0.5, 1.0))
    viscous = _SmallMotions(tets.elements, half, whole, others, True, damping)
    c = largest(viscous)
    if w2 == 0.0 and c == 0.0:
        return math.inf
    dt = 4.0 / (c + math.sqrt(c * c + 4.0 * w2))
    for _ in range(LENGTHENINGS if w2 > 0 and c > 0 else 0):
        found = largest(_Sum(dt, elastic, viscous)) + dt * dt * of_bodies
        if found >= ENOUGH:
            break
        # Eigenvalues grow no faster than dt^2.
        dt *= math.sqrt(4.0 / found)
    return dt


def stable_steps(tets: Tetrahedra, others: Others, contacts: Contacts) -> tuple[float, float]:
    """The largest stable step about rest [s], and the same with a contact or an attachment at every particle."""
    alone = stable_step(tets, others)
    stiffness, damping = others.contact
    stiffness += contacts.stiffest
    if not (stiffness > 0 or damping > 0):
        return alone, alone
    return alone, min(alone, stable_step(tets, others, stiffness, damping, contacts.stiffest * contacts.lightest))


def check_substep(dt: float, count: int, stable_dt: float, contact_dt: float) -> None:
    """Check a step of ``dt`` in ``count`` substeps against the result of ``stable_steps`` [s].

    Raises:
        InputError: The substeps are too long.
    """
    if dt / count > stable_dt:
        each = f", {count} substeps of {dt / count:.3g} s" if count > 1 else ""
        needed = math.ceil(dt / (SAFETY * contact_dt))
        raise InputError(
            f"dt is {dt:.3g} s{each}; the largest stable step is about {stable_dt:.3g} s: "
            f"make shorter steps, or SolverCorotated(..., substeps={needed}), or substeps=None"
        )
