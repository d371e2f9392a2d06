"""Everything in a model besides tetrahedra: rigid bodies and joints, springs, triangles and bending edges.

Another of Newton's solvers steps these, on a view of the model without tetrahedra. Here are their small motions, for
the largest stable step: the forces of ``newton.solvers.SolverSemiImplicit``, linearised about the model's positions. An
element that is shorter or smaller there than at rest counts as if it were at rest, since that is its stiffer state; a
longer one also has its tension across it.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.errors import InputError
from warp_corot.kernels.implicit.tangent import add_products

from .library import ModelView, SolverBase, SolverSemiImplicit, Step, newton

#: Effective number of contacts of a particle with others in a heap, for their total stiffness. A pair that moves
#: against each other counts twice, and opposite contacts count with the square of the cosine of their directions.
CONTACTS = 4.0
#: Newton leaves out bending edges below twice this area and this length [m^2, m].
LEAST = 1e-6

Array = npt.NDArray[np.float64]
#: Nodes of elements [E, n], the matrix from their displacements to strains [E, s, 3 n], and the stiffness and damping
#: of these [E, s, s].
Elements = tuple[npt.NDArray[np.int32], Array, Array, Array]


class Others:
    """Steps of everything besides tetrahedra.

    Args:
        model: The model.
        rigid_solver: "semi-implicit", a user's solver, or None: bodies do not move.
        particle_contact: Whether particles collide with one another.

    Attributes:
        has_particles: Whether particles are integrated here, because something besides tetrahedra acts on them.
        has_bodies: Whether bodies are integrated here.
        damped: Whether springs, triangles or bending edges have dampers.
        is_own: Whether the bodies' solver is the one that is made here.
        contact: Stiffness [N/m] and damping [N s/m] of each contact between particles.
        moved: Particles as the solvers of bodies have moved them in the last step, without the forces of this package:
            positions and velocities, vec3 [P].
    """

    def __init__(self, model: newton.Model, rigid_solver: SolverBase | str | None, particle_contact: bool):
        self.is_own = own = rigid_solver == "semi-implicit"
        if not own and rigid_solver is not None and not isinstance(rigid_solver, SolverBase):
            raise InputError(f"rigid_solver is {rigid_solver!r}; it must be 'semi-implicit', a solver or None")
        self.model, self.device = model, model.device
        self._particle_contact = particle_contact
        if own or rigid_solver is None:
            _warn_of_ignored(model)
        self._triangles = triangles = bool(model.tri_count) and bool(np.any(model.tri_materials.numpy()))
        self._edges = edges = bool(model.edge_count) and bool(np.any(model.edge_bending_properties.numpy()))
        self.has_particles = bool(model.spring_count) or triangles or edges or particle_contact
        self.has_bodies = bool(model.body_count) and rigid_solver is not None
        self._rigid = rigid_solver if isinstance(rigid_solver, SolverBase) else None
        self._solver: SolverSemiImplicit | None = None
        if self.has_particles or (own and model.body_count):
            view = ModelView(model, "warp_corot_others")
            view.tet_count = 0
            if not triangles:
                view.tri_count = 0
            if not edges:
                view.edge_count = 0
            if not self.has_particles:
                view.particle_count = 0
            if not particle_contact:
                view.particle_grid = None
            elif model.device.is_cpu and model.particle_grid is not None:
                # About as many cells as particles: clearing Newton's two million would dominate a step.
                size = 2 ** math.ceil(math.log2(max(model.particle_count, 1)) / 3)
                view.particle_grid = wp.HashGrid(*3 * [min(max(size, 8), 128)], device=model.device)
            if not own and model.body_count:
                view.body_count = view.joint_count = 0
            try:
                self._solver = SolverSemiImplicit(view, enable_tri_contact=False)
            except ValueError as error:
                raise InputError(f"{error} Give another rigid_solver, or None.") from None
        #: Copies of contacts without those of particles, by the original contacts.
        self._rigid_contacts: tuple[newton.Contacts, newton.Contacts] | None = None
        count = model.particle_count if self._solver is not None or self._rigid is not None else 0
        self._no_forces, *self.moved = (wp.zeros(count, dtype=wp.vec3, device=model.device) for _ in range(3))
        self.refresh()

    def refresh(self) -> None:
        """Read the current stiffness and damping of everything."""
        model = self.model
        acts = self._particle_contact and model.particle_grid is not None
        self.contact = (CONTACTS * model.particle_ke, CONTACTS * model.particle_kd) if acts else (0.0, 0.0)
        nodes, blocks = [np.empty((0, 2), np.int32)], [np.empty((0, 2, 3, 3))]
        for ids, strain, stiffness, damping in self._elements():
            pairs = np.stack(np.broadcast_arrays(ids[:, :, None], ids[:, None, :]), axis=-1)
            nodes.append(pairs.reshape(-1, 2))
            sizes = (*ids.shape, 3, ids.shape[1], 3)
            both = [np.einsum("esi,est,etj->eij", strain, m, strain).reshape(sizes) for m in (stiffness, damping)]
            blocks.append(np.stack(both, axis=1).transpose(0, 2, 4, 1, 3, 5).reshape(-1, 2, 3, 3))
        self._blocks = np.concatenate(blocks)
        self._pairs = [wp.array(ids, dtype=wp.int32, device=self.device) for ids in np.concatenate(nodes).T]
        self.damped = bool(self._blocks[:, 1].any())

    def linear_forces(self, a: float, b: float) -> Callable[[wp.array, wp.array], None]:
        """A function that adds -(a K + b C) u, with stiffness K and damping C about the model's positions, to f, both
        vec4 [P].

        Contact between particles is not included.
        """
        found = -(a * self._blocks[:, 0] + b * self._blocks[:, 1])
        inputs = [*self._pairs, wp.array(found, dtype=wp.mat33, device=self.device)]
        return lambda u, f: wp.launch(add_products, len(found), [*inputs, u], [f], device=self.device)

    def _elements(self) -> Iterator[Elements]:
        model = self.model
        x = model.particle_q.numpy().astype(np.float64)
        if model.spring_count:
            arrays = model.spring_rest_length, model.spring_stiffness, model.spring_damping
            yield _springs(x, model.spring_indices.numpy().reshape(-1, 2), *(array.numpy() for array in arrays))
        if self._triangles:
            yield _triangles(x, *(a.numpy() for a in (model.tri_indices, model.tri_poses, model.tri_materials)))
        if self._edges:
            yield _hinges(x, model.edge_indices.numpy().reshape(-1, 4), model.edge_bending_properties.numpy())

    def step(self, substep: Step, body_f: wp.array | None) -> None:
        """Make a step of bodies with the given wrenches, and of particles into ``moved``."""
        if self.has_particles:
            self._no_forces.zero_()  # Newton's solver adds its own
        now = with_changes(substep.state_in, particle_f=self._no_forces, body_f=body_f)
        out = with_changes(substep.state_out, particle_q=self.moved[0], particle_qd=self.moved[1])
        rigid = self._without_soft(substep.contacts)
        if self._solver is not None:
            self._solver.step(now, out, substep.control, rigid, substep.dt)
        if self._rigid is not None and self.has_bodies:
            self._rigid.step(now, out, substep.control, rigid, substep.dt)

    @property
    def solvers(self) -> list[SolverBase]:
        """The solvers that step all this."""
        return [solver for solver in (self._solver, self._rigid) if solver is not None]

    def _without_soft(self, contacts: newton.Contacts | None) -> newton.Contacts | None:
        if contacts is None:
            return None
        if self._rigid_contacts is None or self._rigid_contacts[0] is not contacts:
            self._rigid_contacts = contacts, with_changes(contacts, soft_contact_max=0)
        return self._rigid_contacts[1]


def _warn_of_ignored(model: newton.Model) -> None:
    """Warn, in one line, of parts of a model that nothing steps."""
    counts = {"tendons": model.tendon_count, "muscles": model.muscle_count}
    there = [f"{count} {name}" for name, count in counts.items() if count]
    if there:
        warnings.warn(
            f"the model has {' and '.join(there)}, which are ignored here; another rigid_solver may step them",
            UserWarning,
            stacklevel=4,
        )


def with_changes(given: Any, **changes: Any) -> Any:
    """An object with the same attributes but for some; faster than ``copy.copy``, since it is made in every substep."""
    made = object.__new__(type(given))
    made.__dict__.update(vars(given), **changes)
    return made


# --- small motions ---------------------------------------------------------------------------------------------------


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
