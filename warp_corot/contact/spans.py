"""Obstacles at the triangles of one body in implicit steps; see ``kernels.contact.spans``."""

from __future__ import annotations

from typing import Any

import warp as wp

from warp_corot.kernels.contact import spans as kernels
from warp_corot.kernels.contact.law import Law
from warp_corot.kernels.stepping.pace import Pace

from .rigid_forces import RigidForces

#: Types of the arrays of ``Spans``.
FIELDS = {
    "listed": wp.int32,
    "base": wp.float32,
    "target": wp.float32,
    "stiffness": wp.float32,
    "multiplier": wp.vec3,
    "most": wp.float32,
    "derivative": wp.mat33,
}


class Spans:
    """Springs between obstacles and the triangles of a body.

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
        self.prepare()

    def prepare(self) -> None:
        """Update to the present surface; not while launches are recorded."""
        shape = self._rigid.touches.force.shape
        self._spans = kernels.Spans()
        for name, dtype in FIELDS.items():
            setattr(self._spans, name, wp.zeros(shape, dtype=dtype, device=self.device))
        self._spans.crowd = wp.zeros(self._rigid.surface.count, dtype=wp.float32, device=self.device)
        self._spans.count, self._spans.due = (wp.zeros(1, dtype=wp.int32, device=self.device) for _ in range(2))

    # --- launches ----------------------------------------------------------------------------------------------------

    def launch_located(self, which: int, d: wp.array, stiffness: wp.array, changed: wp.array) -> None:
        """Launch the search for obstacles at triangles.

        Args:
            which: ``kernels.FIRST`` at the beginning of the step, ``AGAIN`` to find them again after motions d if that
                is due, or ``MISSING`` to add those that are missing then.
            d: Motions [m], vec4; a guess at the beginning.
            stiffness: That of friction at surface places [N/m]; see ``kernels.contact.active``.
            changed: Nonzero afterwards if some are added, int32 [1].
        """
        obstacles, surface = self._rigid.obstacles, self._rigid.surface
        part = surface.parts[self._k]
        if which != kernels.MISSING:
            count = surface.worlds * part.nodes
            wp.launch(kernels.empty_spans, count, [part.start, int(which), self._spans], device=self.device)
        inputs = [int(which), obstacles.shapes, self._thickness, obstacles.motions, self._law, self._pace]
        inputs += [*self._surface, d]
        self._launch(kernels.locate_spans, [*inputs, self._rigid.touches, self._spans, changed])
        inputs = [surface.arrays, stiffness, surface.triangles, self._rigid.touches]
        self._launch(kernels.stiffen_spans, [*inputs, self._spans])

    def launch_judgement(
        self, scalars: wp.array, near: float, changed: wp.array, rounds: wp.array, most: int, going: wp.array
    ) -> None:
        """Launch the decision whether they are found again; see ``kernels.judge_spans``."""
        inputs = [scalars, wp.float64(near), self._spans.count, changed, rounds, most]
        wp.launch(kernels.judge_spans, 1, [*inputs, self._spans.due, going], device=self.device)

    def update(self, d: wp.array) -> None:
        """Launch forces and their derivatives after motions d."""
        self._launch(kernels.update_spans, [*self._surface, d, self._rigid.touches, self._spans])

    def add_forces(self, y: wp.array) -> None:
        """Launch the addition of their forces at free nodes [N]."""
        self._launch(kernels.add_span_forces, [*self._surface, self._rigid.touches, y])

    def add_products(self, x: wp.array, y: wp.array) -> None:
        """Launch the addition of their derivative times x."""
        self._launch(kernels.add_span_products, [*self._surface, self._rigid.touches, self._spans, x, y])

    def add_slopes(self, d: wp.array, change: wp.array, search: wp.array, slopes: wp.array) -> None:
        """Launch the power along a change; see ``solvers.implicit.line_search``."""
        inputs = [int(len(search) == 1), *self._surface, self._rigid.touches, self._spans, d, change, search]
        self._launch(kernels.add_span_slopes, [*inputs, slopes])

    def launch_end(self, contact_forces: wp.array) -> None:
        """Launch the addition of their forces to those of contact at nodes."""
        surface = self._rigid.surface
        part = surface.parts[self._k]
        inputs = [part.start, surface.corner_starts, surface.corners, self._rigid.touches]
        outputs = [surface.arrays, contact_forces]
        count = surface.worlds * part.nodes
        wp.launch(kernels.gather_spans, count, inputs, outputs, device=self.device)

    # --- pieces ------------------------------------------------------------------------------------------------------

    @property
    def _surface(self) -> list[Any]:
        return [self._rigid.surface.arrays, self._rigid.surface.triangles]

    def _launch(self, kernel: wp.Kernel, inputs: list) -> None:
        part = self._rigid.surface.parts[self._k]
        count = self._rigid.surface.worlds * part.triangles
        wp.launch(kernel, count, [part.triangle_start, *inputs], device=self.device)
