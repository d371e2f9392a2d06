"""Everything in a model besides tetrahedra: rigid bodies and joints, springs, triangles and bending edges.

Another of Newton's solvers steps these, on a view of the model without tetrahedra.
"""

from __future__ import annotations

import copy
import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import warp as wp

from warp_corot.errors import InputError
from warp_corot.kernels.newton.linear import scatter_bending, scatter_springs, scatter_triangles

from .checks import Step
from .library import ModelView, SolverBase, SolverSemiImplicit, newton

#: Effective number of contacts of a particle with others in a heap, for their total stiffness. A pair that moves
#: against each other counts twice, and opposite contacts count with the square of the cosine of their directions.
CONTACTS = 4.0


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
        particle_forces: The forces on particles in the step [N], vec3 [P].
    """

    def __init__(self, model: newton.Model, rigid_solver: SolverBase | str | None, particle_contact: bool):
        self.is_own = own = rigid_solver == "semi-implicit"
        if not own and rigid_solver is not None and not isinstance(rigid_solver, SolverBase):
            raise InputError(f"rigid_solver is {rigid_solver!r}; it must be 'semi-implicit', a solver or None")
        self.model = model
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
                view.particle_grid = _grid_for(model)
            if not own and model.body_count:
                view.body_count = view.joint_count = 0
            try:
                self._solver = SolverSemiImplicit(view, enable_tri_contact=False)
            except ValueError as error:
                raise InputError(f"{error} Give another rigid_solver, or None.") from None
        #: Copies of contacts without those of particles, by the original contacts.
        self._rigid_contacts: tuple[newton.Contacts, newton.Contacts] | None = None
        self.particle_forces = wp.empty(model.particle_count, dtype=wp.vec3, device=model.device)
        #: Stiffness and damping at the last ``refresh``.
        self._seen: list[np.ndarray] = []
        self.refresh()

    def refresh(self) -> bool:
        """Read the current stiffness and damping of everything.

        Returns:
            Whether they have changed since the last call.
        """
        model = self.model
        present: list[np.ndarray] = [np.zeros(2)]
        dampers = [0.0]
        if self._particle_contact and model.particle_grid is not None:
            present[0] = CONTACTS * np.array([model.particle_ke, model.particle_kd], np.float64)
        if model.spring_count:
            present += [model.spring_stiffness.numpy().copy(), model.spring_damping.numpy().copy()]
            dampers.append(float(present[-1].max()))
        if self._triangles:
            present.append(model.tri_materials.numpy()[:, :3].copy())
            dampers.append(float(present[-1][:, 2].max()))
        if self._edges:
            present.append(model.edge_bending_properties.numpy().copy())
            dampers.append(float(present[-1][:, 1].max()))
        self.contact = float(present[0][0]), float(present[0][1])
        self.damped = max(dampers) > 0.0
        same = len(present) == len(self._seen) and all(map(np.array_equal, present, self._seen))
        self._seen = present
        return not same

    def add_linear_forces(self, u: wp.array, f: wp.array, damping: bool) -> None:
        """Add the forces of small displacements from the model's initial positions, or of velocities there, vec4 [P].

        Contact between particles is not included.
        """
        model, x = self.model, self.model.particle_q
        if model.spring_count:
            modulus = model.spring_damping if damping else model.spring_stiffness
            inputs = [x, model.spring_indices, model.spring_rest_length, modulus, int(damping), u]
            wp.launch(scatter_springs, dim=model.spring_count, inputs=inputs, outputs=[f], device=model.device)
        if self._triangles:
            inputs = [x, model.tri_indices, model.tri_poses, model.tri_materials, int(damping), u]
            wp.launch(scatter_triangles, dim=model.tri_count, inputs=inputs, outputs=[f], device=model.device)
        if self._edges:
            inputs = [x, model.edge_indices, model.edge_bending_properties, int(damping), u]
            wp.launch(scatter_bending, dim=model.edge_count, inputs=inputs, outputs=[f], device=model.device)

    def step(self, substep: Step, body_f: wp.array | None) -> None:
        """Make a step with the given wrenches on bodies and forces on particles."""
        now, out, control, contacts, dt, _ = substep
        rigid = self._without_soft(contacts)
        with _forces(now, self.particle_forces if self.has_particles else now.particle_f, body_f):
            if self._solver is not None:
                self._solver.step(now, out, control, rigid, dt)
            if self._rigid is not None and self.has_bodies:
                self._rigid.step(now, out, control, rigid, dt)

    def notify_model_changed(self, flags: int) -> None:
        for solver in (self._solver, self._rigid):
            if solver is not None:
                solver.notify_model_changed(flags)

    def reset(self, state: newton.State, world_mask: wp.array | None, flags: int | None) -> None:
        for solver in (self._solver, self._rigid):
            if solver is not None:
                solver.reset(state, world_mask, flags)

    def _without_soft(self, contacts: newton.Contacts | None) -> newton.Contacts | None:
        if contacts is None:
            return None
        if self._rigid_contacts is None or self._rigid_contacts[0] is not contacts:
            rigid = copy.copy(contacts)
            rigid.soft_contact_max = 0
            self._rigid_contacts = contacts, rigid
        return self._rigid_contacts[1]


def _grid_for(model: newton.Model) -> wp.HashGrid:
    """A grid with about as many cells as particles: clearing Newton's two million cells would dominate a step."""
    size = 2 ** math.ceil(math.log2(max(model.particle_count, 1)) / 3)
    return wp.HashGrid(*3 * [min(max(size, 8), 128)], device=model.device)


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


@contextmanager
def _forces(state: newton.State, particle_f: wp.array | None, body_f: wp.array | None) -> Iterator[None]:
    """Replace a state's forces inside the block."""
    kept = state.particle_f, state.body_f
    state.particle_f, state.body_f = particle_f, body_f
    try:
        yield
    finally:
        state.particle_f, state.body_f = kept
