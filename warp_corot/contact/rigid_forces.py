"""Forces of obstacles on soft surfaces: on nodes, and between nodes."""

from __future__ import annotations

import warp as wp

from warp_corot.kernels.contact import beside, touches, triangles
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
        for name in ("gap", "friction"):
            setattr(self.touches, name, wp.zeros(shape, dtype=wp.float32, device=device))
        self.touches.acts = wp.zeros(shape, dtype=wp.int32, device=device)
        self._crowd = wp.zeros(count, dtype=wp.float32, device=device)
        self._skin = triangles.Skin()
        self._skin.triangles, self._skin.corners = self.surface.triangles, self.surface.corners
        self._skin.corner_starts = self.surface.corner_starts
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

    def launch_begin(self, *, is_end: bool) -> None:
        """Launch the first forces: those between nodes from the last step, and those on nodes."""
        parts = triangles.BEGIN
        if self.have_edges:
            self._yielding = self._ranks.completed_yielding(self.surface.arrays.yielding)
            rigid = [self.obstacles.shapes, self.obstacles.motions]
            inputs = [*rigid, self._law, self.surface.arrays, self.surface.triangles, self.touches]
            self._on_touches(touches.find_touches, inputs)
            parts |= triangles.ADD
        self._push(parts, is_end)

    def launch_round(self) -> None:
        """Launch one round of the forces between nodes; their sums at the nodes follow."""
        if not self.have_edges:
            return
        step = [self._law, self._pace, self.surface.arrays]
        self._ranks.complete_surface(self.surface.arrays.d)
        self._on_nodes(triangles.crowd_nodes, [*step, self._skin, self.touches, self._crowd])
        self._ranks.complete_surface(self._crowd)
        inputs = [*step, self.surface.triangles, self._crowd, self._yielding, self.touches]
        self._on_touches(triangles.solve_touches, inputs)

    def launch_sum(self) -> None:
        """Launch the sums of a round's forces at the nodes, where other forces have to know of them."""
        if self.have_edges:
            self._push(triangles.ADD, is_end=False)

    def launch_correction(self, *, has_summed: bool, is_end: bool) -> None:
        """Launch the forces on nodes again, because other forces have moved them since.

        Args:
            has_summed: Whether ``launch_sum`` came before.
            is_end: Whether these are the last forces of the step: nodes stick from now on where they do.
        """
        sums = self.have_edges and not has_summed
        self._push(triangles.CORRECT | (triangles.ADD if sums else 0), is_end)

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

    def _push(self, parts: int, is_end: bool) -> None:
        """Launch some of what moves one node at a time."""
        parts |= triangles.END if is_end else 0
        rigid = [self.obstacles.shapes, self.obstacles.motions]
        inputs = [parts, self._skin, *rigid, self._law, self._pace, self.touches, self.surface.arrays]
        self._on_nodes(triangles.push_nodes, [*inputs, self.forces, self.anchors])

    def _on_nodes(self, kernel: wp.Kernel, inputs: list) -> None:
        among = self.search.at_nodes
        wp.launch(kernel, among[0], [*among, *inputs], device=self.device)

    def _on_touches(self, kernel: wp.Kernel, inputs: list) -> None:
        among = self.search.at_touches
        wp.launch(kernel, among[0], [*among, *inputs], device=self.device)
