"""Substeps: the largest stable time step of a model (see ``solvers.stability``), and how many the current state
needs (see ``kernels.stepping.stability``)."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.elasticity import Corotated
from warp_corot.kernels.implicit.tangent import add_products
from warp_corot.kernels.newton import elements as of_elements
from warp_corot.kernels.newton.particles import Particles
from warp_corot.kernels.stepping import stability
from warp_corot.kernels.stepping.stability import add_scaled
from warp_corot.mesh.topology import linked, node_pairs
from warp_corot.solvers.pace import Mapped
from warp_corot.solvers.stability import Curvature, largest_eigenvalue

from .library import newton
from .tetrahedra import Tetrahedra

#: Number of substeps between measurements. A measurement takes about as long as four substeps.
INTERVAL = 64
#: A recorded step has at least this many times the substeps that the model needs at rest, since it cannot change them.
HEADROOM = 1.5
#: Number of retries of a failed step, each with twice the substeps.
RETRIES = 4
#: Factor on the used fraction of the safe substep at each measurement after a retry.
RECOVERY = 1.02
#: Fraction of the largest stable step that errors suggest: elements stiffen when strained.
SAFETY = 0.7
#: The way of a particle that may meet something in a substep, over the size of the smallest element: contact is no
#: stiffer than elements, so that a body that falls as fast as waves travel in it would sink in as far as it does.
STRIDE = 0.5
#: Number of attempts to lengthen a step, and the largest eigenvalue, of 4, from which it is long enough.
LENGTHENINGS = 6
ENOUGH = 3.95
#: Newton leaves out bending edges below twice this area and this length [m^2, m].
LEAST = 1e-6
#: The arrays of ``kernels.newton.elements.SafeSubstep`` on the device: names, shapes and types.
SAFE: tuple[tuple[str, Any, Any], ...] = (
    *(("at_rest", (1, 4), wp.float64), ("found", (1, 3), wp.float32), ("allowed", 1, wp.float64)),
    *(("turn", 1, wp.int32), ("excess", 1, wp.float32)),
)


class _SmallMotions:
    """Forces -(a K + b C) u of small displacements from rest: of elements, of everything else, and of a spring and a
    damper at every particle.

    Elements turn with their rotations; if these are negligible, the model is linear elasticity, and viscosity adds to
    its moduli.
    """

    def __init__(self, tets: Tetrahedra, stiff: StiffParts, a: float, b: float, at_particles: float):
        self._tets, self._stiff, self._at_particles = tets, stiff.linear_forces(a, b), at_particles
        mu, lam, viscosity = (array.numpy().astype(np.float64) for array in (tets.mu, tets.lam, tets.k_damp))
        moduli = (a * mu + 0.5 * b * viscosity, a * lam + b * viscosity)
        self._moduli = [wp.array(m, dtype=wp.float32, device=tets.device) for m in moduli]

    def add_forces(self, u: wp.array, f: wp.array) -> None:
        self._tets.add_linear_forces(u, f, self._moduli)
        self._stiff(u, f)
        wp.launch(add_scaled, dim=len(u), inputs=[-self._at_particles, u], outputs=[f], device=u.device)

    def state_kept(self) -> AbstractContextManager[None]:
        return nullcontext()


def stable_step(tets: Tetrahedra, stiff: StiffParts, stiffness: float = 0.0, damping: float = 0.0) -> float:
    """The largest stable step of symplectic Euler about rest [s]; infinite if nothing can move.

    It is stable while no eigenvalue of dt^2 M^-1 K + 2 dt M^-1 C is above 4. With w^2 the largest eigenvalue of M^-1 K
    and c that of M^-1 C, which may belong to other motions, w^2 dt^2 + 2 c dt = 4 gives a step that is short enough;
    then it is lengthened as far as possible. K and C are those of tetrahedra at rest and of springs, triangles and
    bending edges about the model's initial positions, all together.

    Args:
        tets, stiff: The parts of the model.
        stiffness: Stiffness of a spring at every particle [N/m], for contact with other particles.
        damping: Damping of a damper at every particle [N s/m].
    """
    inverse = free_inverse_masses(tets.model)
    inverse_mass = wp.array(inverse, dtype=wp.float32, device=tets.device)
    smallest = float(tets.elements.volume.numpy().astype(np.float64).min())

    def largest(a: float, b: float) -> float:
        motions = _SmallMotions(tets, stiff, a, b, a * stiffness + b * damping)
        return largest_eigenvalue(motions, inverse_mass, smallest, len(inverse))

    w2 = largest(1.0, 0.0)
    c = largest(0.0, 1.0) if tets.damped or stiff.damped or damping > 0 else 0.0
    if w2 == 0.0 and c == 0.0:
        return math.inf
    dt = 4.0 / (c + math.sqrt(c * c + 4.0 * w2))
    for _ in range(LENGTHENINGS if w2 > 0 and c > 0 else 0):
        found = largest(dt * dt, 2.0 * dt)
        if found >= ENOUGH:
            break
        # Eigenvalues grow no faster than dt^2.
        dt *= math.sqrt(4.0 / found)
    return dt


def free_inverse_masses(model: newton.Model) -> npt.NDArray[np.floating]:
    """Inverse masses of particles [1/kg], zero for those that do not move, float32 [P]."""
    active = (model.particle_flags.numpy() & int(newton.ParticleFlags.ACTIVE)) != 0
    return np.where(active, model.particle_inv_mass.numpy(), 0.0)


def stable_steps(tets: Tetrahedra, stiff: StiffParts, contact: tuple[float, float]) -> tuple[float, float]:
    """The largest stable step about rest [s], and the same with contacts of each particle with others of this stiffness
    [N/m] and damping [N s/m]."""
    alone = stable_step(tets, stiff)
    return alone, min(alone, stable_step(tets, stiff, *contact)) if any(contact) else alone


class Following:
    """The safe substep of a model, which follows the state by launches that may be recorded.

    On the CPU the host gets the result of a measurement at once. On CUDA it does not wait: it uses the values that the
    device has written to the host's memory so far.

    Args:
        model: The model.
        tetrahedra: Its tetrahedra. Everything else in the model is assumed to be as stiff as at rest.

    Attributes:
        share: The fraction of the safe substep that is used; less than one after a failed step.
        reach: The size of the largest body [m]: a larger motion in a substep is a failure.
        made: Number of substeps of the last step.
        was_recorded: Whether the last step was recorded.
    """

    def __init__(self, model: newton.Model, tetrahedra: Tetrahedra):
        self.model, self.tetrahedra = model, tetrahedra
        self.device = model.device
        self._launch = partial(wp.launch, device=self.device)
        self._f = wp.zeros(model.particle_count, dtype=wp.vec4, device=self.device)
        self._seen, self._safe = Mapped(1, self.device), of_elements.SafeSubstep()
        for name, shape, dtype in SAFE:
            setattr(self._safe, name, wp.zeros(shape, dtype=dtype, device=self.device))
        self._safe.seen = self._seen.array
        self._curvature = Curvature(model.particle_count, self._safe.found[0])
        self.share, self.made, self.was_recorded = 1.0, 1, False
        self.reach = _size(model, tetrahedra.tets)
        self._since, self._recording = INTERVAL, False
        # Loading kernels within a recording would end it on some drivers.
        wp.load_module(of_elements.find_posed_strains.module, self.device)

    def find_rest(self, stable: float) -> None:
        """Set the largest stable substep at rest [s], the reference of measurements."""
        tets, inverse = self.tetrahedra, free_inverse_masses(self.model)
        has_tets = np.zeros(len(inverse), bool)
        has_tets[tets.tets] = True
        inverse *= has_tets
        self._inverse_mass = wp.array(inverse, dtype=wp.float32, device=self.device)
        self._curvature.fit(inverse, float(tets.elements.volume.numpy().min()))
        curvature = self._curvature.at_rest(tets.add_linear_forces, self._inverse_mass, len(inverse))
        row = [stable, curvature, Corotated.step_safety, Corotated.strained_safety]
        self._longest = stable * Corotated.step_safety
        safe = self._safe
        safe.stride, safe.falls = 0.0, INTERVAL * float(np.linalg.norm(self.model.gravity.numpy(), axis=1).max())
        if self.model.shape_count:
            safe.stride = STRIDE * float(tets.elements.volume.numpy().min()) ** (1 / 3)
            self._longest = min(self._longest, math.sqrt(safe.stride / max(safe.falls, 1e-30)))
        if not math.isfinite(stable):
            row[0] = self._longest = 1e30
        safe.at_rest.assign(np.array([row]))
        safe.allowed.fill_(self._longest)
        self._seen.values[0] = self._longest
        self._since = INTERVAL

    @property
    def substep(self) -> float:
        """The substep that the host would use now [s]; does not wait."""
        return self.share * float(self._seen.values[0])

    @property
    def recorded_substep(self) -> float:
        """The longest substep that would be recorded now [s]; does not wait."""
        return min(self.substep, self._longest / HEADROOM)

    def count_for(self, dt: float) -> int:
        """Number of substeps in a time [s]."""
        longest = self.recorded_substep if self.device.is_capturing else self.substep
        # A quotient that exceeds one by rounding counts as one.
        return max(1, math.ceil(dt / longest * (1.0 - 1e-6)))

    def is_due(self) -> bool:
        """Whether the next substep begins with a measurement; the first one of a recording does."""
        begins, self._recording = self.device.is_capturing and not self._recording, self.device.is_capturing
        self.was_recorded = self.device.is_capturing
        due = begins or self._since >= INTERVAL
        self._since = 1 if due else self._since + 1
        return due

    def measure(self, particles: Particles, dt: float, substep: float) -> None:
        """Measure at a state whose displacements have been gathered.

        Args:
            particles: The particles in it.
            dt: The remaining time of the step [s].
            substep: The planned length of a substep [s].
        """
        tets, model = self.tetrahedra, self.model
        self._f.zero_()
        tets.add_elastic_forces(tets.u, self._f)
        self._curvature.find(tets.add_elastic_forces, self._inverse_mass, tets.u, self._f, model.particle_count)
        inputs = [tets.elements, particles, max(dt, INTERVAL * substep), model.tet_count, self._safe]
        self._launch(of_elements.find_posed_strains, -(-model.tet_count // int(stability.TURNS)), inputs)
        recorded = wp.float64(substep if self.device.is_capturing else 0.0)
        self._launch(of_elements.take_safe_substep, 1, [recorded, self._safe])
        self.recover()

    def recover(self) -> None:
        """Increase the used fraction of the safe substep a little after a failed step."""
        self.share = min(1.0, RECOVERY * self.share)

    def take_excess(self) -> float:
        """The largest factor by which recorded substeps were too long since the last call; waits for the device."""
        excess = float(self._safe.excess.numpy()[0])
        self._safe.excess.zero_()
        return excess


def _size(model: newton.Model, tets: npt.NDArray[np.integer]) -> float:
    """The diagonal of the bounding box of the largest connected body of tetrahedra [m]."""
    count = model.particle_count
    body = linked(node_pairs(tets), count)
    number, x = int(body.max()) + 1, model.particle_q.numpy()
    low, high = (np.full((number, 3), value) for value in (np.inf, -np.inf))
    np.minimum.at(low, body, x)
    np.maximum.at(high, body, x)
    return float(np.linalg.norm(high - low, axis=1).max())


# --- small motions of everything besides tetrahedra ------------------------------------------------------------------

Array = npt.NDArray[np.float64]
#: Nodes of elements [E, n], the matrix from their displacements to strains [E, s, 3 n], and the stiffness and damping
#: of these [E, s, s].
Elements = tuple[npt.NDArray[np.int32], Array, Array, Array]


class StiffParts:
    """Springs, triangles and bending edges of a model: the forces of ``newton.solvers.SolverSemiImplicit``, linearised
    about the model's positions.

    An element that is shorter or smaller there than at rest counts as if it were at rest, since that is its stiffer
    state; a longer one also has its tension across it.

    Args:
        model: The model.
        triangles, edges: Whether triangles and bending edges have a stiffness.

    Attributes:
        damped: Whether there are dampers.
    """

    def __init__(self, model: newton.Model, triangles: bool, edges: bool):
        x, elements, self._device = model.particle_q.numpy().astype(np.float64), list[Elements](), model.device
        if model.spring_count:
            arrays = model.spring_rest_length, model.spring_stiffness, model.spring_damping
            ends = model.spring_indices.numpy().reshape(-1, 2)
            elements.append(_springs(x, ends, *(array.numpy() for array in arrays)))
        if triangles:
            arrays = model.tri_indices, model.tri_poses, model.tri_materials
            elements.append(_triangles(x, *(array.numpy() for array in arrays)))
        if edges:
            nodes = model.edge_indices.numpy().reshape(-1, 4)
            elements.append(_hinges(x, nodes, model.edge_bending_properties.numpy()))
        pairs, blocks = [np.empty((0, 2), np.int32)], [np.empty((0, 2, 3, 3))]
        for ids, strain, stiffness, damping in elements:
            both = np.stack(np.broadcast_arrays(ids[:, :, None], ids[:, None, :]), axis=-1)
            pairs.append(both.reshape(-1, 2))
            sizes = (*ids.shape, 3, ids.shape[1], 3)
            found = [np.einsum("esi,est,etj->eij", strain, m, strain).reshape(sizes) for m in (stiffness, damping)]
            blocks.append(np.stack(found, axis=1).transpose(0, 2, 4, 1, 3, 5).reshape(-1, 2, 3, 3))
        self._blocks = np.concatenate(blocks)
        self._pairs = [wp.array(ids, dtype=wp.int32, device=self._device) for ids in np.concatenate(pairs).T]
        self.damped = bool(self._blocks[:, 1].any())

    def linear_forces(self, a: float, b: float) -> Callable[[wp.array, wp.array], None]:
        """A function that adds -(a K + b C) u, with stiffness K and damping C, to f, both vec4 [P]."""
        found = -(a * self._blocks[:, 0] + b * self._blocks[:, 1])
        inputs = [*self._pairs, wp.array(found, dtype=wp.mat33, device=self._device)]
        return lambda u, f: wp.launch(add_products, len(found), [*inputs, u], [f], device=self._device)


def _springs(x: Array, ends: npt.NDArray[np.int32], rest: Array, stiffness: Array, damping: Array) -> Elements:
    """K = k (d d^T + (1 - L/l) (1 - d d^T)) for the difference of a spring's ends and its direction d."""
    used = (ends >= 0).all(axis=1)
    ends, rest, stiffness, damping = ends[used], rest[used], stiffness[used], damping[used]
    along, length = _split(x[ends[:, 0]] - x[ends[:, 1]])
    whole = _outer(along, along)
    tension = np.where(length > rest, 1.0 - rest / np.maximum(length, LEAST), 0.0)[:, None, None]
    strain = np.broadcast_to(np.hstack([np.eye(3), -np.eye(3)]), (len(ends), 3, 6))
    k, c = (a[:, None, None] for a in (stiffness, damping))
    return ends, strain, k * (whole + tension * (np.eye(3) - whole)), c * whole


def _triangles(x: Array, nodes: npt.NDArray[np.int32], pose: Array, materials: Array) -> Elements:
    """K of the energy A (k_mu/2 F:F + k_lambda/2 (J - 1 - k_mu/k_lambda)^2), J = |F1 x F2|, and dampers of F and J."""
    nodes, materials = nodes.reshape(-1, 3), materials.astype(np.float64)
    mu, lam, rate = (m[:, None, None] for m in (materials[:, 0], np.maximum(materials[:, 1], 0.0), materials[:, 2]))
    ends = np.concatenate([-pose.sum(axis=1, keepdims=True), pose], axis=1)  # [E, 3 nodes, 2 columns of F]
    strain = np.einsum("eka,ij->eaikj", ends, np.eye(3)).reshape(-1, 6, 9)
    area = (0.5 / np.linalg.det(pose))[:, None, None]
    f1, f2 = np.einsum("eka,eki->aei", ends, x[nodes])
    n, ratio = _split(np.cross(f1, f2))
    flat = (ratio < LEAST)[:, None, None]  # there is no normal: at rest no strain is stiffer than the largest modulus
    smaller = np.sqrt(np.clip(ratio, LEAST, 1.0))[:, None]
    f1, f2, ratio = f1 / smaller, f2 / smaller, np.maximum(ratio, 1.0)[:, None, None]
    widening = np.hstack([np.cross(f2, n), np.cross(n, f1)])
    widening = _outer(widening, widening)
    # Of the normal, which turns with the columns of F.
    turning = (np.eye(3) - _outer(n, n)) @ np.concatenate([-_skew(f2), _skew(f1)], axis=2) / ratio
    across = np.concatenate([_skew(f2) @ turning, -_skew(f1) @ turning], axis=1)
    across[:, :3, 3:] -= _skew(n)
    across[:, 3:, :3] += _skew(n)
    tension = np.where(lam > 0.0, lam * (ratio - 1.0) - mu, 0.0)
    stiffness = mu * np.eye(6) + lam * widening + tension * across
    damping = rate * (np.eye(6) + (lam > 0.0) * widening)
    stiffness = np.where(flat, 2.0 * np.maximum(mu, lam) * np.eye(6), stiffness)
    return nodes, strain, area * stiffness, area * np.where(flat, 3.0 * rate * np.eye(6), damping)


def _hinges(x: Array, nodes: npt.NDArray[np.int32], properties: Array) -> Elements:
    """Dihedral angles near their rest values.

    Newton's forces are e k (theta - theta_0) d, where d is the angle's gradient g with lengths in place of inverse
    heights: K = e k d g^T. The symmetric part (K + K^T) / 2, used here, has an eigenvalue at least as large as the real
    part of any of K.
    """
    used = (nodes >= 0).all(axis=1)
    nodes, properties = nodes[used], properties[used].astype(np.float64)
    i, j, k, o = (x[nodes[:, c]] for c in range(4))
    n1, double1 = _split(np.cross(k - i, o - i))
    n2, double2 = _split(np.cross(o - j, k - j))
    e, length = _split(o - k)
    acts = (double1 >= LEAST) & (double2 >= LEAST) & (length >= LEAST)
    shares = [[-length, 0 * length], [0 * length, -length]]
    shares += [[np.einsum("ei,ei->e", p - c, e) * s for c in (i, j)] for p, s in ((o, 1.0), (k, -1.0))]
    parts = np.einsum("nhe,hei->hein", np.array(shares), np.stack([n1, n2])).transpose(0, 1, 3, 2)
    heights = np.maximum([double1, double2], LEAST)[:, :, None, None]
    strain = np.stack([parts.sum(axis=0), (parts / heights).sum(axis=0)], axis=1).reshape(len(nodes), 2, 12)
    k_e, k_d = (np.where(acts, length * column, 0.0)[:, None, None] for column in properties.T[:2])
    return nodes, strain, k_e * [[0.0, 0.5], [0.5, 0.0]], k_d * [[1.0, 0.0], [0.0, 0.0]]


def _split(vectors: Array) -> tuple[Array, Array]:
    """Directions of vectors and their lengths."""
    length = np.linalg.norm(vectors, axis=1)
    return vectors / np.where(length > 0.0, length, 1.0)[:, None], length


def _outer(a: Array, b: Array) -> Array:
    return a[:, :, None] * b[:, None, :]


def _skew(v: Array) -> Array:
    """The matrices of the products v x."""
    return np.cross(v[:, None, :], np.eye(3)).swapaxes(1, 2)
