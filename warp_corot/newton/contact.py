"""Contacts of soft bodies with rigid bodies and with one another, and attachments to rigid bodies, as rows.

Newton's pipeline finds the contacts: at particles, and on request at points of edges and triangles. Without these, a
body smaller than the particles' spacing sinks in between them. Particles' radii should exceed a body's motion in a
step; the pipeline's ``soft_contact_gap`` should exceed a body's motion between two ``collide``, or contacts are found
late, and what is deep then is let out slowly.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.errors import InputError
from warp_corot.kernels.newton import explicit, rows
from warp_corot.kernels.newton.particles import NO_ROW, UNKNOWN_BEFORE, Bodies, Memory, Particles
from warp_corot.mesh.topology import boundary_faces, linked, node_pairs

from .library import Step, Structs, newton

if TYPE_CHECKING:
    from .steps import Report

#: ``newton.BodyFlags.KINEMATIC``, for bodies with prescribed motion.
KINEMATIC = int(newton.BodyFlags.KINEMATIC)
#: Sine of an angle below which two edges are parallel, as in Newton's detector.
PARALLEL = 1e-5
#: Speed at which what was found too late is pushed out [m/s].
RECOVERY = 0.25
#: The fields of the law of contact.
LAW = ("stiffness", "damping", "slope", "friction", "adhesion", "recovery")


class Contacts:
    """Forces of contacts and attachments; reactions are wrenches about the bodies' centres of mass.

    Args:
        model: The model.
        report: Failures of worlds.
        margin: Distance at which soft bodies begin to push one another [m]; None: they do not.
        moves: Whether forces move bodies in a step; else they go on as they are.

    Attributes:
        rows: The rows of a step: those of its contacts with shapes, and then of attachments.
        contact_count, count: Number of contacts, and of all rows.
        law: The law of contact of a step.
        reactions: Wrenches of the particles on the bodies in the last substep [N, N m], spatial_vector [B].
    """

    def __init__(self, model: newton.Model, report: Report, margin: float | None = None, *, moves: bool = True):
        self.model, self.device, bodies = model, model.device, model.body_count
        self._launch = partial(wp.launch, device=self.device)
        self._report, like = report, model.state()
        #: Contacts of soft bodies with one another, if they have any.
        self.pairs = None if margin is None else SoftPairs(model, margin)
        self.rows = wp.zeros(0, dtype=rows.Row, device=self.device)
        self.contact_count = self.count = 0
        self._lists: explicit.PairLists | None = None
        #: In how many rows particles may be in a step; and the same with the pairs that touch.
        self._load = wp.zeros(model.particle_count, dtype=wp.float32, device=self.device)
        self._loads = self._load if self.pairs is None else wp.zeros_like(self._load)
        self._places = wp.zeros(bodies, dtype=wp.float32, device=self.device)
        #: Forces on particles before contact forces [N], which friction uses.
        self._before = wp.empty(model.particle_count, dtype=wp.vec4, device=self.device)
        self._no_wrenches = wp.empty(0, dtype=wp.spatial_vectorf, device=self.device)
        self.reactions = wp.zeros(bodies, dtype=wp.spatial_vectorf, device=self.device)
        fixed = KINEMATIC if moves else int(newton.BodyFlags.ALL)
        self._particles = Structs(Particles, "particle_", like, model, report)
        self._bodies = Structs(Bodies, "body_", like, model, report, fixed_flag=fixed, places=self._places)
        self._shapes = Structs(rows.Shapes, "shape_", model)
        self._attachments = Structs(rows.Attachments, "attachment_particle_body_", model)
        self._records: Structs | None = None
        self._no_records, self.law = rows.Records(), rows.ContactLaw()
        self._nearest = wp.empty(0, dtype=wp.int64, device=self.device)
        self._memory, self._no_memory = Memory(), Memory()
        self._memory.before, self._memory.after = (wp.zeros_like(self._load) for _ in range(2))
        self._last_dt = 0.0
        self.forget()
        self.refresh()

    def forget(self) -> None:
        """Forget which particles had contacts: these have jumped, or it was not asked."""
        self._memory.before.fill_(float(UNKNOWN_BEFORE))
        self._memory.after.fill_(float(NO_ROW))

    def refresh(self) -> None:
        """Check that attachments can be stepped.

        Raises:
            InputError: An attachment is rigid.
        """
        if self.model.attachment_particle_body_count:
            stiffness = self.model.attachment_particle_body_stiffness.numpy()
            bad = np.flatnonzero(~np.isfinite(stiffness))
            if len(bad):
                raise InputError(f"attachment {bad[0]} has stiffness {stiffness[bad[0]]}; it must be finite [N/m]")

    # --- launches ----------------------------------------------------------------------------------------------------

    def particles(self, state: newton.State) -> Particles:
        """Particles in a state."""
        return self._particles(state, self.model, self._report)

    def bodies(self, state: newton.State) -> Bodies:
        """Bodies in a state."""
        return self._bodies(state, self.model, self._report)

    def begin(self, step: Step) -> None:
        """Launch the rows of a step."""
        model, found = self.model, step.contacts
        touches = found is not None and model.shape_count
        self.contact_count = int(found.soft_contact_max) if found is not None and touches else 0
        self.count = self.contact_count + int(model.attachment_particle_body_count)
        self._lists = None if self.pairs is None or found is None else self.pairs.lists_of(found)
        if self._last_dt and not self.contact_count:
            self.forget()
        self._memory.eased, self._last_dt = RECOVERY * self._last_dt, step.dt if self.contact_count else 0.0
        if self.count or self._lists is not None:
            given = [model.soft_contact_ke, model.soft_contact_kd, model.soft_contact_kf, model.soft_contact_mu]
            for name, value in zip(LAW, [*given, model.particle_adhesion, RECOVERY], strict=True):
                setattr(self.law, name, value)
            self._load.zero_()
            self._places.zero_()
        if not self.count:
            return
        if len(self.rows) != self.count:
            self.rows = wp.zeros(self.count, dtype=rows.Row, device=self.device)
        records = self._records_of(found, step) if self.contact_count else self._no_records
        inputs = [self.contact_count, self.law, records, self._shapes(model), self._attachments(model)]
        inputs += [self.particles(step.state_in), self.bodies(step.state_in), self._memory, self._load]
        self._launch(rows.fill_rows, self.count, inputs, [self.rows])

    @property
    def memory(self) -> Memory:
        """What particles had in the last step and have in this one; empty without contacts."""
        return self._memory if self.contact_count else self._no_memory

    def add_forces(self, substep: Step, of_bodies: newton.State, f: wp.array, share: float = 1.0) -> None:
        """Add forces on particles to f, vec4 [P], and set ``reactions``.

        Args:
            substep: From the particles' state; its ``reported`` gets the wrenches of rigid and then soft contacts,
                spatial_vector [R + S].
            of_bodies: The state of the bodies.
            f: Forces [N], which already hold all others.
            share: The substep's share of the step, in the mean of ``reported``.
        """
        dt, particles, load = substep.dt, self.particles(substep.state_in), self._load
        if self.contact_count or self._lists is not None:
            wp.copy(self._before, f)
        if self.model.body_count:
            self.reactions.zero_()
        pairs, surfaces = self.pairs, []
        if self._lists is not None and pairs is not None:
            surfaces, load = [pairs.surfaces, self._lists, self.law], self._loads
            wp.copy(load, self._load)
            self._launch(explicit.count_pair_loads, pairs.size, [*surfaces, particles, load])
        if self.count:
            inputs = [dt, share, self.law, self.contact_count, substep.first_contact, self.rows, load, particles]
            inputs += [self.bodies(of_bodies), self._before]
            outputs = [f, self.reactions, self._no_wrenches if substep.reported is None else substep.reported]
            self._launch(explicit.scatter_rows, self.count, inputs, outputs)
        if surfaces and pairs is not None:
            self._launch(explicit.scatter_pairs, pairs.size, [*surfaces, dt, load, particles, self._before], [f])

    def _records_of(self, contacts: newton.Contacts | None, step: Step) -> rows.Records:
        if self._records is None:
            self._records = Structs(rows.Records, "soft_contact_", contacts)
        made = self._records(contacts)
        # These attributes are private to Newton; without features there are no records of meshes.
        features = getattr(contacts, "_soft_contact_mesh_features", None)
        data = getattr(contacts, "_soft_contact_mesh_data", None)
        if features is None or data is None:
            return made
        if made.features is not features:
            made.features, made.vertices = features, len(data.rigid_features[0])
        rivals = made.vertices + self.model.edge_count
        if len(self._nearest) != rivals:
            self._nearest = wp.empty(rivals, dtype=wp.int64, device=self.device)
        if made.nearest is not self._nearest:
            made.nearest = self._nearest
        self._nearest.fill_(int(rows.FAR))
        inputs = [self._shapes(self.model), step.state_in.particle_q, self.bodies(step.state_in), made]
        self._launch(rows.find_nearest, self.contact_count, inputs)
        return made


class SoftPairs:
    """Forces of pairs of vertices and triangles, and of edges, that ``newton.CollisionPipeline`` has found.

    Args:
        model: A model with triangles.
        margin: Distance at which surfaces begin to push one another [m].

    Attributes:
        surfaces: Triangles and edges of the model.
        size: Number of threads that go through the lists.
    """

    def __init__(self, model: newton.Model, margin: float):
        if not model.tri_count or not model.edge_count:
            raise InputError(
                "self_contact_margin is given, but the model has no triangles with edges that could touch: give "
                "add_forest and add_mesh surface=True"
            )
        self.margin = margin
        self._lists: Structs | None = None
        self.size = max(model.particle_count, model.edge_count)
        triangles, edges = model.tri_indices.numpy().reshape(-1, 3), model.edge_indices.numpy().reshape(-1, 4)
        tets = model.tet_indices.numpy().reshape(-1, 4)
        faces = boundary_faces(tets)[0]
        # The face of tetrahedra that each triangle is, whose normal points out of them, and the triangles at edges.
        face = _places(triangles, faces)
        alike = np.any([(np.roll(faces[face], k, axis=1) == triangles).all(axis=1) for k in range(3)], axis=0)
        facing = np.where(face < 0, 0.0, np.where(alike, 1.0, -1.0))
        sides = np.stack([_places(edges[:, [k, 2, 3]], triangles) for k in range(2)], axis=1)
        pairs = np.concatenate([node_pairs(tets)] + [triangles[:, [0, k]] for k in (1, 2)])
        parts = np.full(model.particle_count, -1)
        parts[triangles] = linked(pairs, model.particle_count)[triangles]
        self.surfaces = surfaces = explicit.Surfaces()
        surfaces.triangles, surfaces.edges = model.tri_indices, model.edge_indices
        surfaces.rest = wp.clone(model.particle_q)
        surfaces.facing = wp.array(facing, dtype=wp.float32, device=model.device)
        surfaces.outward = wp.array(np.where(facing[sides] == 0.0, -1, sides), dtype=wp.vec2i, device=model.device)
        surfaces.part = wp.array(parts, dtype=wp.int32, device=model.device)

    def lists_of(self, contacts: newton.Contacts) -> explicit.PairLists:
        """Newton's lists of pairs.

        Raises:
            InputError: The contacts have none.
        """
        data = contacts.soft_self_contact_data
        if data is None:
            raise InputError(
                "contacts hold no pairs of soft bodies, which self_contact_margin needs: call "
                "pipeline.init_soft_self_contact(margin=..., gap=...) before pipeline.contacts(), and "
                "pipeline.collide(state, contacts, soft_self_contact=True)"
            )
        if self._lists is None:
            self._lists = Structs(explicit.PairLists, "", data, margin=self.margin, parallel=PARALLEL)
        return self._lists(data)


def _places(wanted: npt.NDArray[np.integer], among: npt.NDArray[np.integer]) -> npt.NDArray[np.integer]:
    """The place of each row among others with the same numbers in any order; -1: there is none."""
    both = np.sort(np.concatenate([among, wanted]), axis=1)
    _, first, group = np.unique(both, axis=0, return_index=True, return_inverse=True)
    place = first[np.ravel(group)[len(among) :]]
    return np.where(place < len(among), place, -1)
