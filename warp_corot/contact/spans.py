"""Obstacles at the triangles and at the borne places of one body in implicit steps; see ``kernels.contact.spans``."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_corot.kernels.contact import span_places as finding
from warp_corot.kernels.contact import spans as kernels
from warp_corot.kernels.contact.law import Law
from warp_corot.kernels.contact.nearest_span import Rolling
from warp_corot.kernels.contact.touches import Touches
from warp_corot.kernels.implicit.assembled import Couplings
from warp_corot.kernels.stepping.pace import Pace
from warp_corot.solvers.implicit.operator import Springs

from .carriers import PlaceCarriers
from .rigid_forces import RigidForces

#: The stiffness of a span over that of its point.
STIFF = 32.0
#: Maximum number of threads of launches over those that are listed.
MOST_THREADS = 1 << 14
#: Types of the arrays of ``Spans``, and of those of ``Touches`` that points need.
FIELDS = {
    "listed": wp.int32,
    "base": wp.float32,
    "target": wp.float32,
    "stiffness": wp.float32,
    "multiplier": wp.vec3,
    "most": wp.float32,
    "derivative": wp.mat33,
    "rolling": Rolling,
    "bend": wp.float32,
    "tilt": wp.vec3,
    "moment": wp.vec3,
}
OF_POINTS = {
    "shares": wp.vec3,
    "normal": wp.vec3,
    "moved": wp.vec3,
    "more": wp.vec3,
    "gap": wp.float32,
    "friction": wp.float32,
    "acts": wp.int32,
}


@dataclass(frozen=True)
class Items:
    """Things that obstacles may touch: triangles, or places as triangles whose corners are all there.

    Attributes:
        locate: The kernel that finds obstacles there.
        corners: The corners of all items, as places, vec3i.
        start, count: The items of the body.
        touches, spans: What is known about obstacles there, as structs for kernels.
    """

    locate: wp.Kernel
    corners: wp.array
    start: int
    count: int
    touches: Touches
    spans: kernels.Spans


class Spans:
    """Springs between obstacles and the triangles of a body, and its places if nodes bear them.

    Args:
        rigid: Forces of obstacles.
        k: The number of the body.
        thickness: The shortest way through each obstacle, halved [m], float32 [O].
        law: How fast things that overlap are pushed apart.
        pace: The clock.
    """

    def __init__(self, rigid: RigidForces, k: int, thickness: wp.array, law: Law, pace: Pace):
        self._rigid, self._k, self._thickness, self._law, self._pace = rigid, k, thickness, law, pace
        self.device = rigid.device
        self._carriers = PlaceCarriers(rigid.surface, rigid.surface.bodies)
        self.prepare()

    def prepare(self) -> None:
        """Update to the present surface; not while launches are recorded."""
        surface, rigid = self._rigid.surface, self._rigid
        part, device = surface.parts[self._k], self.device
        self._is_borne = part.bearers > 0
        self._carriers.follow()
        self._count, self._due, self._goes, self._solves = (
            wp.zeros(1, dtype=wp.int32, device=device) for _ in range(4)
        )
        self._items: list[Items] = []
        if rigid.have_edges:
            spans, count = self._made(rigid.touches), surface.worlds * part.triangles
            each = Items(finding.locate_spans, surface.triangles, part.triangle_start, count, rigid.touches, spans)
            self._items.append(each)
        if part.bearers:
            touches = self._touches_of_points()
            spans, count = self._made(touches), surface.worlds * part.nodes
            used = np.where(surface.arrays.node.numpy() < 0, -1, np.arange(surface.count))
            corners = wp.array(np.repeat(used[:, None], 3, axis=1), dtype=wp.vec3i, device=device)
            self._items.append(Items(finding.locate_points, corners, part.start, count, touches, spans))
        self.springs = self._made_springs()

    # --- launches ----------------------------------------------------------------------------------------------------

    def launch_begin(self, blocks: wp.array, d: wp.array) -> None:
        """Launch the beginning of a step; see ``PlaceCarriers``. Motions d are a guess [m], vec4."""
        self._carriers.launch_begin(self._k, 0, blocks, d, d)

    def launch_located(self, which: int, d: wp.array, changed: wp.array) -> None:
        """Launch the search for obstacles at items.

        Args:
            which: ``finding.FIRST`` at the beginning of the step, ``AGAIN`` to find them again after motions d if that
                is due, or ``MISSING`` to add those that are missing then.
            d: Motions [m], vec4; a guess at the beginning.
            changed: Nonzero afterwards if some are added, int32 [1].
        """
        obstacles, arrays = self._rigid.obstacles, self._rigid.surface.arrays
        if which != finding.MISSING:
            start, offset, count, _nodes = self._carriers.nodes_of(self._k)
            inputs = [start + offset, int(which), self._carriers.arrays, self._items[0].spans, self._items[-1].spans]
            wp.launch(finding.empty_spans, count, inputs, device=self.device)
        rigid = [int(which), obstacles.shapes, self._thickness, obstacles.motions, self._law, self._pace, arrays]
        for each in self._items:
            # One thread of the CPU sees at once that nothing is to be found.
            threads = 1 if self.device.is_cpu else each.count
            inputs = [threads, each.start, each.count, *rigid, each.corners, d]
            inputs += [self._carriers.arrays, each.touches, each.spans, changed]
            wp.launch(each.locate, threads, inputs, device=self.device)
        for each in self._items:
            self._on_listed(finding.stiffen_spans, each, [*self._places(each), each.touches, each.spans])

    def launch_judgement(
        self, d: wp.array, changed: wp.array, locates: wp.array, rounds: wp.array, most: int, going: wp.array
    ) -> None:
        """Launch the decision whether they are found again after motions d; see ``kernels.judge_spans``. Those that are
        missing are looked for if the step would end, which sets ``changed``."""
        wp.copy(self._goes, going)
        self.launch_located(finding.MISSING, d, changed)
        inputs = [locates, changed, self._count, rounds, most]
        wp.launch(kernels.judge_spans, 1, [*inputs, self._due, self._solves, going], device=self.device)

    def update(self, d: wp.array, *, is_solved: bool = False) -> None:
        """Launch forces and their derivatives after motions d, which are those of a solve if ``is_solved``."""
        for each in self._items:
            self._on_listed(
                kernels.update_spans, each, [int(is_solved), *self._places(each), d, each.touches, each.spans]
            )

    def add_forces(self, y: wp.array) -> None:
        """Launch the addition of their forces at free nodes [N]."""
        for each in self._items:
            self._on_listed(kernels.add_span_forces, each, [*self._places(each), each.touches, each.spans, y])

    def add_products(self, x: wp.array, y: wp.array) -> None:
        """Launch the addition of their derivative times x."""
        for each in self._items:
            self._on_listed(kernels.add_span_products, each, [*self._places(each), each.touches, each.spans, x, y])

    def add_couplings(self, couplings: Couplings) -> None:
        """Launch the addition of their derivative to an assembled matrix."""
        for each in self._items:
            self._on_listed(kernels.couple_spans, each, [*self._places(each), each.touches, each.spans, couplings])

    def add_slopes(self, d: wp.array, change: wp.array, search: wp.array, slopes: wp.array) -> None:
        """Launch the power along a change; see ``solvers.implicit.conjugate_gradients``."""
        for each in self._items:
            inputs = [int(len(search) == 1), *self._places(each), each.touches, each.spans, d, change, search, slopes]
            self._on_listed(kernels.add_span_slopes, each, inputs)

    def _update_springs(self) -> None:
        """Launch the stiffness of ``springs``, from the derivatives of the last ``update``."""
        surface = self._rigid.surface
        part = surface.parts[self._k]
        inputs = [part.start, surface.corner_starts, surface.corners, self._items[0].touches, self._items[0].spans]
        last = self._items[-1]
        inputs += [int(len(self._items) > 1), last.touches, last.spans]
        count = surface.worlds * part.nodes
        wp.launch(kernels.gather_stiffness, count, inputs, [self.springs.stiffness], device=self.device)

    def launch_end(self, d: wp.array) -> None:
        """Launch the motions of borne places and the forces on them, and the addition of forces on triangles."""
        surface, device = self._rigid.surface, self.device
        part = surface.parts[self._k]
        for each in self._items:
            if each.locate is finding.locate_points:
                inputs = [self._carriers.arrays, d, each.touches, surface.arrays]
                self._launch(kernels.end_points, each, inputs)
        if self._rigid.have_edges:
            inputs = [part.start, surface.corner_starts, surface.corners, self._rigid.touches, surface.arrays]
            wp.launch(kernels.gather_spans, surface.worlds * part.nodes, inputs, device=device)
        self._carriers.launch_end(self._k)

    # --- pieces ------------------------------------------------------------------------------------------------------

    def _made(self, touches: Touches) -> kernels.Spans:
        spans = kernels.Spans()
        for name, dtype in FIELDS.items():
            setattr(spans, name, wp.zeros(touches.force.shape, dtype=dtype, device=self.device))
        spans.count, spans.due, spans.goes, spans.solves = self._count, self._due, self._goes, self._solves
        spans.list = wp.zeros(touches.force.size, dtype=wp.int32, device=self.device)
        spans.length = wp.zeros(1, dtype=wp.int32, device=self.device)
        spans.stiff = STIFF
        spans.are_borne = int(self._is_borne)
        return spans

    def _made_springs(self) -> Springs:
        """The places of the body, with the nodes that bear them."""
        surface, device = self._rigid.surface, self.device
        part = surface.parts[self._k]
        count = surface.worlds * part.nodes if self._is_borne else 0
        nodes, weights = wp.zeros(count, dtype=wp.vec4i, device=device), wp.zeros(count, dtype=wp.vec4, device=device)
        inputs = [part.start, surface.arrays, surface.bearers]
        wp.launch(kernels.find_bearers, count, inputs, [nodes, weights], device=device)
        stiffness = wp.zeros(count, dtype=wp.mat33, device=device)
        return Springs(nodes, weights, stiffness, self._update_springs)

    def _touches_of_points(self) -> Touches:
        """Those of places, whose forces are those of obstacles on nodes in explicit steps."""
        touches = Touches()
        touches.force = self._rigid.forces
        for name, dtype in OF_POINTS.items():
            setattr(touches, name, wp.zeros(touches.force.shape, dtype=dtype, device=self.device))
        return touches

    def _places(self, each: Items) -> list:
        return [self._rigid.surface.arrays, each.corners, self._carriers.arrays]

    def _on_listed(self, kernel: wp.Kernel, each: Items, inputs: list) -> None:
        """Launch a kernel over the spans that are listed."""
        threads = 1 if self.device.is_cpu else min(each.spans.list.size, MOST_THREADS)
        wp.launch(kernel, threads, [threads, *inputs], device=self.device)

    def _launch(self, kernel: wp.Kernel, each: Items, inputs: list) -> None:
        wp.launch(kernel, each.count, [each.start, *inputs], device=self.device)
