"""Forces of obstacles on soft surfaces: on nodes, and between nodes."""

from __future__ import annotations

import warp as wp

from warp_corot.kernels.contact import sums, touches
from warp_corot.kernels.contact.law import Law
from warp_corot.kernels.contact.vertices import Rigid

from .obstacles import Obstacles
from .search import Search
from .surface import ContactSurface


class RigidForces:
    """Forces of obstacles.

    Args:
        surface: The bodies' surfaces.
        obstacles: The obstacles.
        search: The search for nearby surfaces.
        law: The law of contact: how far gaps may close in a step.

    Attributes:
        forces: The force of each obstacle on each surface node itself in the last step [N], vec3 [O, S].
        totals: The same with the nodes' shares of the forces between them, when they were last published.
        touches: Obstacles at triangles.
        have_edges: Whether any of the obstacles can pass between the nodes.
    """

    def __init__(self, surface: ContactSurface, obstacles: Obstacles, search: Search, law: Law):
        self.surface, self.obstacles, self.search, self.device = surface, obstacles, search, surface.device
        self._law, self._taken = law, -1
        self.have_edges = obstacles.have_edges
        search.rigid = self
        self.follow()

    def follow(self) -> None:
        """Update to the present surfaces."""
        if self.surface.revision == self._taken:
            self.forget()
            return
        self._taken, device = self.surface.revision, self.device
        count, obstacles = self.surface.count, self.obstacles.count
        self.forces = wp.zeros((obstacles, count), dtype=wp.vec3, device=device)
        self.totals = wp.zeros_like(self.forces)
        self.anchors = wp.zeros((obstacles, count), dtype=wp.vec4, device=device)
        self._away, self._moved = wp.zeros_like(self.anchors), wp.zeros_like(self.forces)
        self.allowances = wp.zeros((obstacles, count), dtype=wp.float32, device=device)
        self.touches = touches.Touches()
        shape = (obstacles, self.surface.triangle_count if self.have_edges else 0)
        for name in ("shares", "normal", "moved", "force", "more"):
            setattr(self.touches, name, wp.zeros(shape, dtype=wp.vec3, device=device))
        for name in ("gap", "friction", "allowance"):
            setattr(self.touches, name, wp.zeros(shape, dtype=wp.float32, device=device))
        self.touches.warmth = self.surface.warmth
        self.touches.acts = wp.zeros(shape, dtype=wp.int32, device=device)
        self._more = wp.zeros_like(self.forces)
        self._acts = wp.zeros((obstacles, count), dtype=wp.int32, device=device)

    @property
    def is_separate(self) -> bool:
        """Whether no two contacts of obstacles share a place."""
        return not self.have_edges and self.obstacles.count == 1

    def forget(self) -> None:
        """Forget the last step."""
        self.anchors.zero_()
        self.touches.force.zero_()
        for allowances in (self.allowances, self.touches.allowance):
            allowances.zero_()
        self.forces.zero_()

    def reset(self, chosen: wp.array) -> None:
        """Forget the last step in chosen worlds, nonzero in int32 [worlds]."""
        count = max(self.surface.count, self.surface.triangle_count if self.have_edges else 0)
        inputs = [chosen, self.surface.triangles]
        wp.launch(
            sums.forget_places,
            (self.obstacles.count, count),
            inputs,
            [self.arrays, self.touches],
            device=self.device,
        )

    @property
    def state(self) -> dict[str, wp.array]:
        """The arrays that it keeps from step to step."""
        touches = self.touches
        sides = {"touch_normals": touches.normal.flatten(), "touch_forces": touches.force.flatten()}
        sides |= {"allowances": self.allowances.flatten(), "touch_allowances": touches.allowance.flatten()}
        return {"anchors": self.anchors.flatten(), "forces": self.forces.flatten(), **sides}

    # --- launches --------------------------------------------------------------------------------------------------

    def launch_totals(self) -> wp.array:
        """Launch the sums of all forces of each obstacle on each node, [O, S]."""
        if not self.have_edges:
            return self.forces
        inputs = [self.surface.corner_starts, self.surface.corners, self.touches, self.forces]
        wp.launch(sums.share_touches, self.forces.shape, inputs, [self.totals], device=self.device)
        return self.totals

    @property
    def arrays(self) -> Rigid:
        """The obstacles, the surfaces and what is between them, as they are now."""
        rigid = Rigid()
        rigid.shapes, rigid.motions, rigid.law = self.obstacles.shapes, self.obstacles.motions, self._law
        rigid.surface, rigid.forces, rigid.anchors = self.surface.arrays, self.forces, self.anchors
        rigid.away, rigid.moved, rigid.allowance = self._away, self._moved, self.allowances
        rigid.more, rigid.acts = self._more, self._acts
        return rigid
