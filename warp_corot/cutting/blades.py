"""The blades of a simulation: their motion, the cuts that they make, and the forces at their edges."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warp_corot.contact.obstacles import Obstacles
from warp_corot.discretization.sizes import allocated
from warp_corot.errors import InputError
from warp_corot.kernels.remesh import blades as kernels
from warp_corot.kernels.remesh.cut_surface import BUNDLE, Surface
from warp_corot.mesh.lattice import volume_shares

from .blade import Blade

if TYPE_CHECKING:
    from warp_corot.remesh.changing import Changing
    from warp_corot.solvers.system import System

#: Distance of points on an edge, and the largest motion between two cuts, over the size of an element there.
SPACING, MOTION = 0.5, 0.25
#: Arrays of edges from which a run goes on.
KEPT = ("state", "former", "nodes", "weights", "size", "modulus", "push", "move", "dt", "work")
#: Passes that refine before each cut.
REFINEMENTS = 3
#: Cuts in a row that change no mesh, after which the stable step is found again; that takes as long as a hundred steps.
SETTLED = 64
#: The most points on an edge.
MOST_POINTS = 1 << 14
#: The most steps between two cuts.
MOST_STEPS = 64


class EdgePoints:
    """The edges of blades in one body.

    Args:
        blades: The blades.
        changing: The body's.
        size: Size of its elements where blades cut [m].
    """

    def __init__(self, blades: Sequence[Blade], changing: Changing, size: float):
        self.changing, self.device = changing, changing.device
        rows = [blade.sampled(SPACING * size) for blade in blades]
        counts = [len(row) for row in rows]
        self.count = total = sum(counts)
        of_points = "x best nodes weights size modulus dt state swept former"
        sizes = [(total, of_points), (2 * total, "push move"), (2, "bounds"), (len(rows), "work")]
        edges = self.edges = allocated(kernels.Edges, self.device, sizes)
        edges.blade = self._ints(np.repeat(np.arange(len(rows)), counts))
        edges.local = wp.array(np.concatenate(rows), dtype=wp.vec3, device=self.device)
        goes_on = np.ones(total, np.int32)
        goes_on[np.cumsum(counts) - 1] = 0
        edges.goes_on = self._ints(goes_on)
        edges.common = changing.carried_material.modulus
        boxes = 1 + -(-2 * total // int(BUNDLE))
        sizes = [(3 * total, "points"), (2 * total, "triangles debt"), (2 * boxes, "bounds")]
        surface = self.surface = allocated(Surface, self.device, sizes)
        surface.count = 2 * total
        levels = [-1 if blade.level is None else blade.level for blade in blades]
        surface.levels = self._ints(np.repeat(levels, 2 * np.array(counts)))
        self.refines = max(levels) >= 0
        self._graph: wp.Graph | None = None
        self._is_recorded = False

    @property
    def restored(self) -> list[wp.array]:
        """Arrays that a run which went wrong puts back."""
        edges = self.edges
        return [edges.work, edges.push, edges.move, edges.dt, self.surface.debt]

    def cut(self, motions: Any) -> bool:
        """Cut the body along what has been swept since the last time; returns whether its mesh has changed."""
        launch = partial(self._launch_cut, motions)
        if not self._is_recorded:
            self._graph, self._is_recorded = self.changing.recorded(launch), True
        return self.changing.change(launch, self._graph)

    def _launch_cut(self, motions: Any) -> None:
        self.launch_sweep(motions)
        self.changing.launch_cut(self.surface, REFINEMENTS if self.refines else 0)
        self.launch_binding(motions, moved=self.refines)

    def launch_sweep(self, motions: Any, *, begins: bool = False) -> None:
        """Launch the search for the strips that the edges have swept since the last one; none if it ``begins``."""
        self._find(motions)
        self._launch(kernels.empty_boxes, [self.surface.bounds], len(self.surface.bounds))
        self._launch(kernels.sweep_points, [int(begins), self._pools, self._carried, self.edges, self.surface])
        self._launch(kernels.sweep_strips, [self.edges, self.surface])

    def launch_binding(self, motions: Any, *, moved: bool = True) -> None:
        """Launch the binding of the points to the leaves in which they are, and their search if these have moved in the
        list of leaves."""
        if moved:
            self._find(motions)
        self._launch(kernels.bind_points, [self._pools, self._carried, self.edges])

    def launch_decision(self, begins: wp.array, motions: Any, pace: Any, wrenches: wp.array) -> None:
        """Launch the pushes of a step."""
        inputs = [begins, motions, pace, self._carried, self.edges, self.surface.debt, wrenches]
        self._launch(kernels.decide_pushes, inputs)

    def launch_pushes(self) -> None:
        """Launch the forces of the pushes on the body's nodes."""
        self._launch(kernels.push_tissue, [self.edges, self.changing.body.state.forces], 2 * self.count)

    def restart(self) -> None:
        """Forget what has been swept."""
        for array in (self.edges.state, self.edges.work, self.edges.push, self.surface.debt):
            array.zero_()

    @property
    def _pools(self) -> Any:
        return self.changing.forest.pools

    @property
    def _carried(self) -> Any:
        return self.changing.forest.carriage.arrays

    def _find(self, motions: Any) -> None:
        threads = self.changing.forest.threads
        self._launch(kernels.empty_boxes, [self.edges.bounds], 2)
        self._launch(kernels.place_points, [motions, self.edges])
        self._launch(kernels.find_leaves, [threads, self._pools, self._carried, self.edges], threads)

    def _launch(self, kernel: wp.Kernel, inputs: list[Any], dim: int | None = None) -> None:
        """Launch a kernel over the points, or another number of threads."""
        wp.launch(kernel, self.count if dim is None else dim, inputs, device=self.device)

    def _ints(self, values: Any) -> wp.array:
        return wp.array(np.asarray(values, np.int32), dtype=wp.int32, device=self.device)


class Blades(Obstacles):
    """The blades of a simulation, as forces of its system.

    Args:
        given: The blades.
        system: The system.
        changing: The cutting of each body.
        longest: The longest step [s].

    Attributes:
        blades: The blades.
        every: Steps between two cuts.
        unchanged: Cuts since the last one that changed a mesh; at least ``SETTLED`` before the first.

    Raises:
        InputError: A blade is too fast to be followed or too long, or another simulation has it.
    """

    def __init__(self, given: Sequence[Blade], system: System, changing: Sequence[Changing], longest: float):
        self._size, self._longest = min(_size(each, given) for each in changing), longest
        for blade in given:
            longest_edge = MOST_POINTS * SPACING * self._size
            if blade.length > longest_edge:
                raise InputError(
                    f"edge is {blade.length:.3g} m long; on these elements at most {longest_edge:.3g} m can cut"
                )
        super().__init__(given, 0.0, system)
        self.blades = tuple(given)
        self.of_bodies = [EdgePoints(given, each, self._size) for each in changing]
        self.unchanged = SETTLED
        self._moved = wp.full(1, -1, dtype=wp.int64, device=self.device)
        self._begins = wp.zeros(1, dtype=wp.int32, device=self.device)
        self._sweep()

    def update(self) -> None:
        """As ``Obstacles.update``; but blades bound no step, and faster ones cut more often.

        Raises:
            InputError: A blade is too fast to be followed.
        """
        size = self._size
        far = self._longest * max((blade.fastest() or blade.speed) for blade in self.tools)
        if not far <= size:
            raise InputError(
                f"a blade goes {1e3 * far:.3g} mm in a step, farther than an element of {1e3 * size:.3g} mm; "
                f"it must be slower than {size / self._longest:.3g} m/s"
            )
        self.every = int(np.clip(MOTION * size / far, 1, MOST_STEPS))
        rates = wp.clone(self.system.motion_rates)
        super().update()
        wp.copy(self.system.motion_rates, rates)

    # --- as forces ---------------------------------------------------------------------------------------------------

    @property
    def restored(self) -> list[wp.array]:
        """Arrays that a run which went wrong puts back."""
        return [*self.state.values(), self._moved, *(array for each in self.of_bodies for array in each.restored)]

    @property
    def kept(self) -> dict[str, wp.array]:
        """Everything from which blades go on, by name, besides the meshes."""
        found = {"now": self.motions.now, "moved": self._moved, "wrenches": self.wrenches, **self.state}
        for k, each in enumerate(self.of_bodies):
            found |= {f"{k}.points": each.surface.points, f"{k}.debt": each.surface.debt}
            found |= {f"{k}.{name}": getattr(each.edges, name) for name in KEPT}
        return found

    def add_forces(self) -> None:
        """Launch the motion of the blades in a step, and the forces at their edges."""
        pace, offset = self.system.pace.arrays, self.system.offset
        wp.launch(kernels.begin_step, 1, [pace, offset, self._moved, self._begins], device=self.device)
        self.launch_targets()
        starts = self.system.bodies[0].conditions.world_starts
        inputs = [self._begins, self.motions, pace, starts, offset, self.wrenches]
        wp.launch(kernels.move_blades, self.count, inputs, device=self.device)
        for each in self.of_bodies:
            each.launch_decision(self._begins, self.motions, pace, self.wrenches)
            each.launch_pushes()

    # --- cuts --------------------------------------------------------------------------------------------------------

    def is_due(self, steps: int) -> bool:
        """Whether a cut is due after this number of steps."""
        return steps % self.every == 0

    def cut(self) -> bool:
        """Cut along what the blades have swept since the last cut; returns whether a mesh has changed."""
        changed = any([each.cut(self.motions) for each in self.of_bodies])
        self.unchanged = 0 if changed else self.unchanged + 1
        return changed

    @property
    def has_settled(self) -> bool:
        """Whether meshes have just been the same for some cuts after one that changed them."""
        return self.unchanged == SETTLED

    def bind_again(self) -> None:
        """Find the points' leaves again, after a pass has changed these."""
        for each in self.of_bodies:
            each.launch_binding(self.motions)

    def reset(self, chosen: wp.array) -> None:
        super().reset(chosen)
        if chosen.numpy()[0]:
            self._moved.fill_(-1)
            self.unchanged = SETTLED
            for each in self.of_bodies:
                each.restart()
            self._sweep()

    def continue_from(self, former: Obstacles) -> None:
        super().continue_from(former)
        self._sweep()

    def work_of(self, number: int) -> float:
        """Work of a blade on the tissue [J]; waits for the device."""
        return float(sum(each.edges.work.numpy()[number] for each in self.of_bodies))

    def _sweep(self) -> None:
        """Let the blades begin where they are."""
        for each in self.of_bodies:
            each.launch_sweep(self.motions, begins=True)


def _size(changing: Changing, blades: Sequence[Blade]) -> float:
    """Size of the smallest elements of a body, or of those at its blades [m]."""
    mesh = changing.forest.source
    finest = max(int(np.max(mesh.levels)), *(-1 if blade.level is None else blade.level for blade in blades), 0)
    return float(volume_shares(finest) ** (1.0 / 3.0)) * mesh.cell_size
