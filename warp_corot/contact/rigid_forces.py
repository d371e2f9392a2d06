"""Forces of obstacles on soft surfaces: on nodes, and between nodes."""

from __future__ import annotations

import warp as wp

from warp_corot.kernels.contact import beside, touches, triangles, vertices
from warp_corot.kernels.contact.law import Law
from warp_corot.kernels.stepping.pace import Pace
from warp_corot.solvers.ranks import ALONE, Ranks

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
        pace: The clock.
        ranks: Who moves the other nodes of the triangles here.

    Attributes:
        forces: The force of each obstacle on each surface node itself in the last step [N], vec3 [O, S].
        totals: The same with the nodes' shares of the forces between them, when they were last published.
        touches: Obstacles at triangles.
        kinds: The state of each surface node with each obstacle in implicit steps; see
            ``kernels.contact.active``, [O, S].
        have_edges: Whether any of the obstacles can pass between the nodes.
    """

    def __init__(
        self,
        surface: ContactSurface,
        obstacles: Obstacles,
        search: Search,
        law: Law,
        pace: Pace,
        ranks: Ranks = ALONE,
    ):
        self.surface, self.obstacles, self.search, self.device = surface, obstacles, search, surface.device
        self._law, self._pace, self._ranks, self._taken = law, pace, ranks, -1
        self.have_edges = obstacles.have_edges
        search.finders.append(self._find)
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
        self.kinds = wp.zeros((obstacles, count), dtype=wp.int32, device=device)
        self.anchors = wp.zeros((obstacles, count), dtype=wp.vec4, device=device)
        self.touches = touches.Touches()
        shape = (obstacles, self.surface.triangle_count if self.have_edges else 0)
        for name in ("shares", "normal", "moved", "force", "more"):
            setattr(self.touches, name, wp.zeros(shape, dtype=wp.vec3, device=device))
        self.touches.gap = wp.zeros(shape, dtype=wp.float32, device=device)
        self.touches.acts = wp.zeros(shape, dtype=wp.int32, device=device)
        self._crowd = wp.zeros(count, dtype=wp.float32, device=device)
        self._yielding = self.surface.arrays.yielding

    def forget(self) -> None:
        """Forget the last step."""
        self.anchors.zero_()
        self.kinds.zero_()
        self.touches.force.zero_()

    @property
    def state(self) -> dict[str, wp.array]:
        """The arrays that it keeps from step to step."""
        touches = self.touches
        sides = {"touch_normals": touches.normal.flatten(), "touch_forces": touches.force.flatten()}
        return {"anchors": self.anchors.flatten(), **sides}

    # --- launches --------------------------------------------------------------------------------------------------

    def launch_begin(self) -> None:
        """Launch the first forces: those between nodes from the last step, and those on nodes."""
        if self.have_edges:
            self._yielding = self._ranks.completed_yielding(self.surface.arrays.yielding)
            rigid = [self.obstacles.shapes, self.obstacles.motions]
            inputs = [*rigid, self._law, self.surface.arrays, self.surface.triangles, self.touches]
            self._on_touches(touches.find_touches, inputs)
            self._apply()
        self._touch_nodes(1)

    def launch_round(self) -> None:
        """Launch one round of the forces between nodes."""
        if not self.have_edges:
            return
        step = [self._law, self._pace, self.surface.arrays, self.surface.triangles]
        self._ranks.complete_surface(self.surface.arrays.d)
        self._on_touches(triangles.judge_touches, [*step, self.touches])
        inputs = [self.surface.corner_starts, self.surface.corners, self.touches, self._crowd]
        self._on_nodes(triangles.crowd_nodes, inputs)
        self._ranks.complete_surface(self._crowd)
        inputs = [self.obstacles.shapes, *step, self._crowd, self._yielding, self.touches]
        self._on_touches(triangles.solve_touches, inputs)
        self._apply()

    def launch_correction(self) -> None:
        """Launch the forces on nodes again, because other forces have moved them since."""
        self._touch_nodes(0)

    def launch_end(self) -> None:
        """Launch the places at which nodes stick from now on."""
        rigid = [self.obstacles.shapes, self.obstacles.motions]
        self._on_nodes(vertices.keep_anchors, [*rigid, self.surface.arrays, self.forces, self.anchors])

    def launch_totals(self) -> wp.array:
        """Launch the sums of all forces of each obstacle on each node, [O, S]."""
        if not self.have_edges:
            return self.forces
        inputs = [self.surface.corner_starts, self.surface.corners, self.touches, self.forces]
        wp.launch(triangles.share_touches, self.forces.shape, inputs, [self.totals], device=self.device)
        return self.totals

    def _find(self) -> None:
        """Launch the search for nodes and triangles near obstacles."""
        watch, near, arrays = self.search.watch, self.search.near, self.surface.arrays
        inputs = [watch, self.obstacles.shapes, self.obstacles.motions, self._law, arrays]
        outputs = [near, self.forces, self.anchors]
        wp.launch(beside.find_nodes_beside, self.surface.count, inputs, outputs, device=self.device)
        if self.have_edges:
            inputs += [self.surface.triangles]
            dim = (self.obstacles.count, self.surface.triangle_count)
            wp.launch(beside.find_triangles_beside, dim, inputs, [near, self.touches], device=self.device)

    def _touch_nodes(self, is_first: int) -> None:
        rigid = [self.obstacles.shapes, self.obstacles.motions]
        inputs = [is_first, *rigid, self._law, self._pace, self.anchors, self.surface.arrays, self.forces]
        self._on_nodes(vertices.touch_obstacles, inputs)

    def _apply(self) -> None:
        """Launch the addition of these forces to the nodes."""
        inputs = [self.surface.corner_starts, self.surface.corners, self.touches, self.surface.arrays]
        self._on_nodes(triangles.apply_touches, inputs)

    def _on_nodes(self, kernel: wp.Kernel, inputs: list) -> None:
        among = self.search.at_nodes
        wp.launch(kernel, among[0], [*among, *inputs], device=self.device)

    def _on_touches(self, kernel: wp.Kernel, inputs: list) -> None:
        among = self.search.at_touches
        wp.launch(kernel, among[0], [*among, *inputs], device=self.device)
