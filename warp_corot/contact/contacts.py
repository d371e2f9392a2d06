"""Contact as a constraint of a system: forces after all others, so that the step ends with surfaces side by side."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import chain

import numpy as np
import warp as wp

from warp_corot.inputs.cpu_threads import Regions, launch, team_of
from warp_corot.kernels.contact import bearing, motion, sums
from warp_corot.kernels.contact.explicit_rows import Rigid
from warp_corot.kernels.contact.explicit_step import BLOCK, begin_step, end_contact
from warp_corot.kernels.contact.law import SETTLING, Law
from warp_corot.kernels.contact.motion import Part
from warp_corot.solvers.halo import ALONE
from warp_corot.solvers.system import System

from .carried import CarriedForces
from .implicit import ImplicitContact
from .mass_split import Approach, MassSplit
from .obstacles import Obstacles, RigidForces
from .options import SURFACE, Contact, may_meet
from .reading import OVERLAP, warn_of_crushed, warn_of_overlaps
from .search import Pairs, Search, Sleep, smallest_size
from .skin import has_own_surface
from .surface import ContactSurface, SurfaceHalo, WholeSurface
from .tool import Obstacle

#: Gaps that come from rounding, in roundings of the largest coordinate.
ROUNDINGS = 16.0
#: Overlapping surfaces are pushed apart at this fraction of the speed of waves, and at most by the size of the smallest
#: element in this time [s]: explicit steps keep the speed, and stiff bodies would be thrown.
RECOVERY, UNHURRIED = 0.05, 0.01
#: Steps of less than this fraction of the stable one close less of a gap.
WHOLE = 0.5
#: Gaps at bodies' own surfaces of up to this fraction of the smallest element may stay as they are in implicit steps:
#: places share nodes, so that forces that close all gaps exactly take many solves. In static answers times ``FINE``.
SLACK, FINE = 0.0005, 0.2
#: Gaps of more than this fraction of the smallest element besides their own motion do not close in an explicit step:
#: nothing moves by more than a tenth of it.
CLOSING = 0.25
#: Number of grains in the force that moves the heaviest node across the smallest element in a step; the maximum is
#: 2^63.
GRAINS = 2.0**48
#: Number of warps that add up a wrench.
WARP, MOST_WARPS = 32, 64


class Contacts:
    """Contact of the bodies of a system.

    Args:
        system: The bodies.
        obstacles: Shapes and tools.
        options: The options of contact.
        stable_dt: Largest stable step of the bodies at rest [s], from which the speed of waves follows.
        dt: The length of a step, if it was given [s].
        on_surfaces: Whether contact acts on the bodies' own surfaces, if ``options`` say so; implicit steps over
            ranks support the boundary of the tetrahedra only.

    Attributes:
        surface: The surface nodes and triangles of all bodies.
        obstacles: The rigid obstacles.
        rigid: Forces of obstacles; None without.
        search: The search for nearby surfaces.

    Raises:
        InputError: As ``Obstacles``.
    """

    def __init__(
        self,
        system: System,
        obstacles: Sequence[Obstacle],
        options: Contact,
        *,
        stable_dt: float,
        dt: float | None = None,
        on_surfaces: bool = False,
    ):
        self.system, self.device, self.options = system, system.device, options
        self.obstacles = Obstacles(obstacles, options.friction, system, dt)
        meets = may_meet(len(system.bodies), options)
        are_own = on_surfaces and options.on == SURFACE
        have_own = are_own and any(has_own_surface(system.ranks.owned(body).whole.mesh) for body in system.bodies)
        is_whole = (meets or have_own) and not system.ranks.is_alone
        kind = {"are_own": are_own, "are_close": not meets}
        made = WholeSurface(system, **kind) if is_whole else ContactSurface(system.bodies, **kind)
        self.surface: ContactSurface = made
        #: The exchange with ranks that have other places of the surface.
        self.shared = SurfaceHalo(ALONE if is_whole else system.ranks, self.surface)
        self.law = self._law(stable_dt)
        self.search = Search(self.surface, self.obstacles, self.smallest, branches=system.ranks.is_alone)
        #: Contact between soft surfaces; None if they cannot touch one another.
        self.pairs = Pairs(self.surface, self.search, options, system.ranks) if meets else None
        self.rigid: RigidForces | None = None
        if self.obstacles.count:
            self.rigid = RigidForces(self.surface, self.obstacles, self.search, self.law)
        team = team_of(max(body.discretization.team.parts for body in system.bodies))
        #: The threads of the CPU that share the surface.
        self.regions = Regions(team, self.device)
        #: The forces of explicit steps.
        self.split = MassSplit(self)
        self._is_explicit = False
        #: Steps that visit only what may touch obstacles; None on CUDA, over ranks, and if soft surfaces may touch.
        self.approach: Approach | None = None
        if self.device.is_cpu and self.rigid is not None and self.pairs is None and system.ranks.is_alone:
            self.approach = Approach(self, self.rigid)
        #: Steps while nothing is near; None on the CPU, where nothing can be left out, and without searches.
        self.sleep = Sleep(self) if self.search.can_sleep else None
        self._revision = 0
        self._is_looked_at = self._has_crushed = False
        self._make_arrays()

    # --- as a constraint -------------------------------------------------------------------------------------------

    @property
    def launch_revision(self) -> int:
        pairs = 0 if self.pairs is None else self.pairs.revision
        return self._revision + self.surface.revision + self.obstacles.revision + pairs

    @property
    def state(self) -> dict[str, wp.array]:
        arrays = {} if self.rigid is None else {**self.rigid.state, **self.obstacles.state}
        return {name: array for name, array in arrays.items() if array.size}

    def prepare(self) -> None:
        if self.is_full:
            self.grow()
        if self.surface.is_outdated:
            before, carried = self.surface.revision, CarriedForces(self.surface, self.rigid, self.pairs)
            self.surface.follow()
            self._follow(before)
            carried.give_back()
        if self.pairs is not None:
            if not self.pairs.is_planted:
                self._predict(0, 0.0)
            self.pairs.prepare()
        self.split.follow()
        if self.approach is not None and self.approach.is_outdated:
            self.approach.follow()

    @property
    def is_full(self) -> bool:
        return self.search.has_missed or (self.pairs is not None and self.pairs.is_full)

    def grow(self) -> None:
        self.search.widen()
        if self.pairs is not None:
            self.pairs.grow()

    def forget(self) -> None:
        self.search.forget()
        if self.approach is not None:
            self.approach.forget()
        if self.pairs is not None:
            self.pairs.forget()

    def check_start(self) -> None:
        """Check once whether anything begins inside something else; overlaps are pushed apart slowly.

        Warns:
            StabilityWarning: There are overlaps.
        """
        if not self._is_looked_at:
            self._is_looked_at = True
            self._predict(0, 0.0)
            warn_of_overlaps(self, OVERLAP * self.smallest)

    def settle(self, share: float, *, exactly: bool) -> None:
        """Let surfaces be pushed apart by this share of an overlap in each step, without a warning: steps that seek a
        state of rest may begin inside obstacles. Before the first step. ``exactly``: own surfaces keep smaller gaps,
        which many contacts may not come to."""
        self.law.settling, self._is_looked_at = share, True
        if exactly:
            self.law.slack *= FINE

    def look(self) -> None:
        """Check whether elements are turned inside out, until the first time; waits for the device.

        Warns:
            StabilityWarning: Some elements are.
        """
        self._has_crushed = self._has_crushed or warn_of_crushed(self)

    def launch(self, offset: int, damping: float) -> None:
        self._is_explicit = True
        if self.approach is not None:
            self.obstacles.launch_targets()
            accounts = [each for k in range(len(self.system.bodies)) for each in self.system.constraint_accounts(k)]
            self.approach.launch(offset, damping, accounts if accounts and self.counts_work else None)
        elif self.sleep is not None:
            self.sleep.launch(offset, partial(self._act, offset, damping))
        else:
            self.obstacles.launch_targets()
            self._act(offset, damping, moves=True)

    def _act(self, offset: int, damping: float, *, moves: bool = False) -> None:
        """Launch the forces of a step; ``moves``: and the motion of obstacles."""
        system, surface = self.system, self.surface
        if self.device.is_cpu:
            self.search.watch.rest = 0.5 * self.law.closing
        self._predict(offset, damping, begins=True, moves=moves)
        self.search.launch(offset, follows=True, sleeps=self.sleep is not None)
        self.split.launch()
        follows = self.search.is_needed and not surface.is_whole
        for k, (body, part) in enumerate(zip(system.bodies, surface.parts, strict=True)):
            state, accounts = body.state, system.constraint_accounts(k)
            counts = bool(accounts) and self.counts_work
            if part.bearers and len(system.constraints) > 1:
                # Grasps add to the forces of nodes that bear nothing, too.
                state.contact_forces.zero_()
            start, count, _arrays = surface.nodes_of(k)
            inputs = [self.split.buffer, self.law.grain, surface.arrays, int(counts), self.part(k, offset, damping)]
            outputs = [self.split.sums, self.search.watch, accounts[0] if counts else None, state.contact_forces]
            ranges = (start, count), (part.start, self._count(k) if follows else 0)
            self._launch_ranges(end_contact, ranges, inputs, outputs, (k, offset))
        if surface.is_whole:
            self.split.launch_clear()
            self.search.launch_after()

    @property
    def counts_work(self) -> bool:
        """Whether it counts the work of its forces itself, at the nodes of the surface, as no other constraint adds to
        them."""
        return len(self.system.constraints) == 1 and self.system.ranks.is_alone

    def launch_motion(self, offset: int) -> None:
        """Launch the motion of obstacles in an implicit step."""
        if self.obstacles.count:
            self.obstacles.launch_motion(offset, self.search.watch)

    def implicit(self) -> ImplicitContact | None:
        """Contact in implicit steps, if anything may touch."""
        if self.rigid is None and self.pairs is None:
            return None
        return ImplicitContact(self)

    def measure(self) -> None:
        thinnest = self.obstacles.thinnest
        if self.pairs is not None:
            thinnest = min(thinnest, 0.5 * self.smallest)
        if not np.isfinite(thinnest):
            return
        for k, body in enumerate(self.system.bodies):
            start, count, arrays = self.surface.nodes_of(k)
            inputs = [start, arrays.node, body.state.velocities, thinnest]
            self._launch(motion.measure_rates, count, inputs, [self.system.motion_rates])

    def publish(self) -> None:
        surface, obstacles = self.surface, self.obstacles
        if self.approach is not None:
            self.approach.launch_end()
        elif self.sleep is not None:
            self.sleep.launch_check()
        forces = None
        if self.rigid is not None:
            forces = self.rigid.launch_totals()
            for number in range(obstacles.count if self.rigid.have_edges else 0):
                self.shared.clear(forces[number])
            threads = self._parts.shape[2] * self._lanes
            for part in surface.parts:
                inputs = [part.start, part.nodes, self._lanes, threads, surface.arrays, obstacles.motions, forces]
                wp.launch(
                    sums.sum_wrenches, (*obstacles.wrenches.shape, threads), inputs, [self._parts], device=self.device
                )
            self.shared.ranks.sum(self._parts)
            wp.launch(
                sums.fold_wrenches, obstacles.wrenches.shape, [self._parts], [obstacles.wrenches], device=self.device
            )
        self.search.launch_report()
        if self._is_explicit:
            self.split.launch_place_forces(forces)
            if self.approach is not None:
                self.approach.launch_completion()
        self._launch(sums.node_pressures, surface.count, [surface.arrays], [self._pressures])
        self.shared.exchange(self._pressures)
        for k, part in enumerate(surface.parts):
            inputs = [part.triangle_start, surface.arrays, self._pressures]
            outputs = [self._triangle_pressures[k]]
            self._launch(sums.triangle_pressures, self.system.worlds * part.triangles, inputs, outputs)

    def reset(self, chosen: wp.array) -> None:
        if self.rigid is not None:
            self.rigid.reset(chosen)
        self.forget()
        self.obstacles.reset(chosen)
        self._is_looked_at = False

    def take_rooms(self, rooms: Sequence[Sequence[int]], room: int) -> None:
        """Reserve the former room: ``surface.rooms``, and ``pairs.room`` if soft surfaces may touch."""
        before = self.surface.revision
        self.surface.make_room(rooms)
        self._follow(before)
        if self.pairs is not None:
            self.pairs.take_room(room)

    def continue_from(self, former: Contacts) -> None:
        """Go on from the contact of the same bodies before their meshes changed.

        Forces are carried if every rank has the whole surfaces, and forgotten if each has only a part.
        """
        self.obstacles.continue_from(former.obstacles)
        wp.copy(self.obstacles.wrenches, former.obstacles.wrenches)
        self.search.continue_from(former.search)
        self.take_law(former)
        self._is_looked_at, self._has_crushed = former._is_looked_at, former._has_crushed
        if self.surface.is_whole:
            carried = CarriedForces(former.surface, former.rigid, former.pairs)
            carried.go_on_with(self.surface, self.rigid, self.pairs)
            carried.give_back()

    def take_law(self, other: Contacts) -> None:
        """Take the constants of the law of contact from other contact, before the first step."""
        for name in ("tolerance", "recovery", "whole", "closing", "grain"):
            setattr(self.law, name, getattr(other.law, name))
        if self.approach is not None:
            self.approach.follow()

    # --- pieces ----------------------------------------------------------------------------------------------------

    def _follow(self, revision: int) -> None:
        """Update to the present surfaces, which have changed since that revision."""
        if self.surface.revision != revision:
            self._make_arrays()
        self._share_arrays()
        self.search.follow()
        if self.rigid is not None:
            self.rigid.follow()
        if self.pairs is not None:
            self.pairs.follow()
        if self.approach is not None:
            self.approach.follow()

    @property
    def smallest(self) -> float:
        """The size of the smallest element [m]."""
        return smallest_size([body.discretization.smallest_volume for body in self.system.bodies])

    def _law(self, stable_dt: float) -> Law:
        points = [np.abs(self.system.ranks.owned(body).bounds).max() for body in self.system.bodies]
        law = Law()
        law.settling, law.whole = float(SETTLING), WHOLE * stable_dt if np.isfinite(stable_dt) else 0.0
        law.tolerance = ROUNDINGS * 2.0**-24 * max(*points, 1e-3)
        law.recovery = min(RECOVERY / stable_dt, 1.0 / UNHURRIED) * self.smallest if np.isfinite(stable_dt) else 0.1
        heaviest = self.system.ranks.max(max(float(body.masses.max()) for body in self.system.bodies))
        step = stable_dt if np.isfinite(stable_dt) else 1.0
        law.slack = SLACK * self.smallest if self.surface.is_borne else 0.0
        law.closing = CLOSING * self.smallest
        law.grain = heaviest * self.smallest / step**2 / GRAINS
        return law

    def _predict(self, offset: int, damping: float, *, begins: bool = False, moves: bool = False) -> None:
        """Launch the motion of the surfaces without contact.

        Args:
            offset, damping: As for ``launch``.
            begins: Whether a step begins.
            moves: Whether obstacles move.
        """
        system, surface, obstacles = self.system, self.surface, self.obstacles
        world_starts = system.bodies[0].conditions.world_starts
        # On CUDA a launch takes longer than the work: places find the nodes that bear them by themselves.
        finds_borne = self.device.is_cuda and not surface.is_whole
        for k, part in enumerate(surface.parts):
            start, count, _arrays = surface.nodes_of(k)
            borne = self._count(k) if part.bearers and finds_borne else 0
            moved = system.worlds * obstacles.count if moves and k == 0 else 0
            frames = system.worlds if begins and k == 0 else 0
            inputs = [self.part(k, offset, damping), obstacles.motions, world_starts, int(moves)]
            outputs, ranges = [self.search.watch, surface.arrays], ((start, count), (part.start, borne))
            key = (k, offset, begins, moves)
            self._launch_ranges(begin_step, ranges, inputs, outputs, key, once=(frames, moved))
        if isinstance(surface, WholeSurface):
            surface.complete()
        elif self.rigid is not None and self.rigid.have_edges:
            self.shared.exchange(surface.arrays.d)
        for k, part in enumerate(surface.parts):
            if part.bearers and not finds_borne:
                inputs = [part.start, surface.bearers, surface.arrays]
                self.regions.launch_from(bearing.place_borne, self._count(k), inputs, [], k)

    def _make_arrays(self) -> None:
        surface, device = self.surface, self.device
        count, obstacles = surface.count, self.obstacles.count
        self._lanes = 1 if device.is_cpu else WARP
        # Halo add these arrays up, so they must be of one size.
        most = int(self.shared.ranks.max(float(max(part.nodes for part in surface.parts))))
        warps = 1 if device.is_cpu else max(min(most // WARP, MOST_WARPS), 1)
        self._parts = wp.zeros((obstacles, self.system.worlds, warps), dtype=wp.spatial_vectord, device=device)
        self._pressures = wp.zeros(count, dtype=wp.vec3, device=device)
        self._triangle_pressures = [
            wp.zeros(self.system.worlds * part.triangles, dtype=wp.float32, device=device) for part in surface.parts
        ]
        self._revision += 1
        self._share_arrays()

    def _share_arrays(self) -> None:
        """Give bodies the arrays that users read."""
        for body, part, pressures in zip(self.system.bodies, self.surface.parts, self._triangle_pressures, strict=True):
            body.state.make_contact_forces()
            body.state.contact_forces.zero_()
            triangles = len(part.skin.triangles)
            body.state.contact_pressures = pressures if self.system.worlds > 1 else pressures[:triangles]
            body.state.contact_surface = part.skin.own
            body.state.rebound_contact_surface = self.surface.rebound(body)

    def part(self, k: int, offset: int = 0, damping: float = 0.0) -> Part:
        """The surface of the k-th body in a step, as a struct for kernels."""
        part, of = Part(), self.surface.parts[k]
        part.number, part.place, part.shift = k, of.start, self.surface.count if of.bearers else 0
        part.start, _count, part.nodes = self.surface.nodes_of(k)
        part.dynamics = self.system.dynamics(self.system.bodies[k], damping)
        part.pace, part.offset = self.system.pace.arrays, offset
        return part

    @property
    def rigid_arrays(self) -> Rigid:
        """Contact with obstacles as a struct for kernels; without them only the surfaces and the law."""
        if self.rigid is not None:
            return self.rigid.arrays
        made = Rigid()
        made.surface, made.law = self.surface.arrays, self.law
        return made

    def _count(self, k: int) -> int:
        """Number of places of a body in all worlds."""
        return self.system.worlds * self.surface.parts[k].nodes

    def _launch_ranges(
        self,
        kernel: wp.Kernel,
        ranges: Sequence[tuple[int, int]],
        inputs: list,
        outputs: list,
        key: tuple,
        once: Sequence[int] = (),
    ) -> None:
        """Launch a kernel in parts, with a thread for each item of all ranges. Its first arguments are the beginning
        and the length of each range, and then numbers of things that the first part does ``once``."""
        bounds = [self.regions.team.bounds(count) for _, count in ranges]

        def phase(part: int) -> None:
            own = [
                (start + of[part][0], of[part][1] - of[part][0]) for (start, _), of in zip(ranges, bounds, strict=True)
            ]
            first = [number if part == 0 else 0 for number in once]
            dim = max(sum(count for _, count in own), 0, *first)
            launch(kernel, dim, [*chain(*own), *first, *inputs], outputs, device=self.device, block_dim=BLOCK)

        self.regions.launch((kernel, *key), phase)

    def _launch(self, kernel: wp.Kernel, dim: int, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)
