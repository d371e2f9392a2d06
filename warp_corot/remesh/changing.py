"""A body whose mesh follows its motion: it shares the pools' arrays, and the host reads the counts after each pass."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.changing.passes import CutPass, RemeshPass, Survey
from warp_corot.discretization.changing.plan import DevicePlan, launch_size
from warp_corot.discretization.changing.pools import DeviceForest, PassCounts
from warp_corot.discretization.changing.transfer import Column
from warp_corot.discretization.sizes import Clock
from warp_corot.errors import InputError
from warp_corot.kernels.remesh.criteria import elongation, marking_kernel, nearness
from warp_corot.kernels.remesh.cut_surface import Surface
from warp_corot.kernels.remesh.pools import MEAN_OF_CONTENTS
from warp_corot.kernels.stepping.integrate import set_start
from warp_corot.mesh import TetForest
from warp_corot.mesh.lattice import volume_shares

from .carried_material import ChangingMesh, carried_material
from .conditions import CarriedConditions
from .remeshing import OnlineRemesh

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody
    from warp_corot.elasticity import ForceField

#: The number of launched nodes is a multiple of this.
NODE_GRANULE = 256


class Changing:
    """The remeshing and the cutting of one body.

    It is made before the body's force field, whose launches then run over the pools.

    Args:
        body: The body.
        options: The user's options; None: the mesh only changes where it is cut.
        carried: Numbers of elements that the force field will keep; see ``Model.carried``.
        is_cut: Whether the body may be cut.
        level: The level to which blades refine a mesh that is not remeshed.

    Attributes:
        body: The body.
        options: The user's options with defaults filled in; see `OnlineRemesh.on`.
        is_remeshed: Whether there were any.
        cuts: The cuts; None if the body is not cut.
        forest: The pools.
        passes: The passes that change the pools.
        carried_material: The material data that elements carry.
        conditions: Supports, loads and active stress.
        survey: The data that limit the time step.
        discretization: The mesh as the force field sees it.
        is_full: Whether refinement was left out because the capacity was reached.

    Raises:
        InputError: A general mesh, more than one world, or options that do not fit the mesh.
    """

    def __init__(
        self,
        body: SoftBody,
        options: OnlineRemesh | None,
        carried: Sequence[str] = (),
        *,
        is_cut: bool = False,
        level: int | None = None,
    ):
        self.is_remeshed = options is not None
        self.options = fitted(options or OnlineRemesh(max_level=level), body)
        mesh = body.mesh
        assert isinstance(mesh, TetForest)
        self.body = body
        self.device = body.device
        self.is_full = False
        self.carried_material = carried_material(body.discretization)
        self.carried_material.values |= {name: Column(0.0, int(MEAN_OF_CONTENTS)) for name in carried}
        assert self.options.capacity is not None
        assert self.options.max_level is not None
        self.forest = DeviceForest(
            mesh,
            self.options.capacity,
            density=self.carried_material.density(len(mesh.tets)),
            values=self.carried_material.values,
            node_capacity=_room_for_nodes(mesh, self.options.capacity) if is_cut else None,
            device=self.device,
        )
        self.cuts = CutPass(self.forest, self.carried_material.toughness) if is_cut else None
        self.conditions = CarriedConditions(body, self.forest)
        self.passes = RemeshPass(
            self.forest,
            criterion=self.options.criterion or elongation,
            refine_above=self.options.refine_above,
            simplify_below=self.options.simplify_below,
            min_level=self.options.min_level,
            max_level=self.options.max_level,
            parameters=self.options.parameters,
            lame=self.carried_material.lame,
        )
        self.survey = Survey(self.forest, self.carried_material.modulus)
        self.discretization = ChangingMesh(body.discretization, self.forest, self.carried_material)
        #: The data that the host reads after a pass: counts of the pools and of the plan, the survey, and nodes that
        #: follow keyframes.
        self._report: wp.array | None = None
        self._report_parts: list[int] = []
        #: A recorded pass with its consequences; None if the device's graphs have no conditional nodes.
        self._graph: wp.Graph | None = None
        self._give_pools_to(body)

    # --- interface for the body ------------------------------------------------------------------------------------

    def remember(self) -> None:
        """Make the current mesh and state those that ``reset`` restores."""
        self.body.state.adopt_positions()
        self.forest.remember()
        self.conditions.keep()

    # --- passes ----------------------------------------------------------------------------------------------------

    def serve(self, field: ForceField) -> None:
        """Keep the plan of the body's force field up to date, and notify the field after each pass."""
        self.field = field
        field.load_kernels()
        parts = self._found()
        self._report_parts = [len(part) for part in parts]
        self._report = wp.zeros(sum(self._report_parts), dtype=wp.int32, device=self.device)
        self.renew()
        self.conditions.keep()
        self.survey.settle()
        self._graph = self.recorded(self._launch)

    def run(self) -> None:
        """Make one pass over the mesh, and update what depends on the mesh if it has changed."""
        if self.options.near is not None:
            assert self.options.parameters is not None
            self.options.parameters.assign(self.options.place)
        self.change(self._launch, self._graph)

    def cut(self, surface: Surface | float) -> float:
        """Cut the body along a surface, or where the stress is above a number [Pa], and update what depends on it.

        Returns the area [m^2] at rest.
        """
        assert self.cuts is not None
        before = self.cut_area
        self._read_user()
        if isinstance(surface, float):
            self.cuts.launch_tear(surface, self.passes.contents)
        else:
            self.cuts.launch_cut(surface)
        self._launch_derived()
        self._look()
        return self.cut_area - before

    def launch_cut(self, surface: Surface, refinements: int) -> None:
        """Launch a cut along triangles, after passes that refine leaves there, and whatever is derived from the mesh;
        or record it."""
        assert self.cuts is not None
        for k in range(refinements):
            self.cuts.launch_marks(surface)
            self.passes.launch(marked=True, goes_on=k > 0)
            self.cuts.launch_after_pass()
        self.cuts.launch_cut(surface, goes_on=refinements > 0)
        self._launch_derived()

    def change(self, launch: Callable[[], None], graph: wp.Graph | None) -> bool:
        """Change the mesh by launches, or by their recording, and update what depends on it; returns whether it has
        changed."""
        self._read_user()
        if graph is None:
            launch()
        else:
            wp.capture_launch(graph)
        return self._look()

    def recorded(self, launch: Callable[[], None]) -> wp.Graph | None:
        """A recording of launches; None if the device's graphs have no conditional nodes, which passes need."""
        if self.device.is_cuda and not wp.is_conditional_graph_supported():
            return None
        with wp.ScopedCapture(device=self.device) as capture:
            launch()
        return capture.graph

    @property
    def is_cut(self) -> bool:
        """Whether the body can be cut."""
        return self.cuts is not None

    @property
    def cut_area(self) -> float:
        """The area of all cuts so far, at rest [m^2]; waits for the device."""
        return float(self.forest.carriage.arrays.cut_area.numpy()[0])

    def renew(self) -> None:
        """Derive everything from the current mesh."""
        self._plan.outdate()
        self._launch_derived()
        self._look(anyway=True)

    def reset(self, chosen: wp.array, clock: Clock) -> None:
        """Restore the initial mesh and state, or those of the last ``remember``, if the world is chosen.

        Loads, held nodes and keyframes are the last ones given on that mesh.
        """
        if chosen.numpy()[0]:
            starts = self.body.conditions.world_starts
            wp.launch(set_start, dim=1, inputs=[clock.arrays], outputs=[starts], device=self.device)
            self.restore()

    def restore(self) -> None:
        """Restore the initial mesh and state, as ``reset`` does, but leave the time at which motions begin."""
        self.conditions.note()
        self.forest.restart()
        self.conditions.put_back()
        self.renew()
        self.conditions.keep()
        self.body.conditions.find_inverse_masses()

    # --- pieces ----------------------------------------------------------------------------------------------------

    @property
    def _plan(self) -> DevicePlan:
        assert self.discretization.kept is not None
        return self.discretization.kept

    def _give_pools_to(self, body: SoftBody) -> None:
        """Make the body use the pools' arrays from now on, with their contents."""
        arrays, initial = self.forest.carriage.arrays, body.state.initial
        body.state.move_into(arrays.rest, arrays.u, arrays.v, arrays.reaction)
        body.conditions.move_into(arrays.held, arrays.mass32, arrays.inverse_mass, arrays.load)
        body.follow_mesh(self, self.discretization)
        self._keep_initial_state(initial)

    def _read_user(self) -> None:
        """Read what the user has written, before the mesh changes."""
        self.body.state.adopt_positions()
        self.conditions.note()
        self.field.note()

    def _launch(self) -> None:
        """Launch a pass and everything that is derived from the mesh, or record it."""
        self.passes.launch()
        if self.cuts is not None:
            self.cuts.launch_after_pass()
        self._launch_derived()

    def _launch_derived(self) -> None:
        self.discretization.launch()
        self.field.derive()
        goes = self._plan.counts.goes
        self.survey.launch(goes)
        self.conditions.launch(goes)
        start = 0
        for part in self._found():
            wp.copy(self._report, part, dest_offset=start)
            start += len(part)

    def _found(self) -> tuple[wp.array, ...]:
        """Results of launches that the host reads, int32."""
        return self.forest.pools.counts, self._plan.class_counts, self.survey.found, self.conditions.found

    def _look(self, *, anyway: bool = False) -> bool:
        """Read the device's results once; if the mesh has changed, update the body and its force field, and return
        True."""
        assert self._report is not None
        counted, classes, surveyed, followers = np.split(self._report.numpy(), np.cumsum(self._report_parts)[:-1])
        counts = PassCounts.of(counted)
        self.is_full = counts.full
        if not (counts.added or counts.removed or anyway):
            return False
        body = self.body
        limit = self.forest.node_capacity
        nodes = launch_size(counts.nodes, body.sizes.launch_nodes, NODE_GRANULE, limit)
        elements = launch_size(counts.leaves, body.sizes.launch_elements, 1, self._plan.counts.most)
        moved = body.sizes.set_launches(nodes, elements)
        if self._plan.refresh(classes) or moved:
            self.field.follow()
            body.sizes.relaunch()
        self.survey.read(surveyed)
        smallest = float(volume_shares(self.survey.finest_level)) * self.forest.source.cell_size**3
        self.discretization.mesh_changed(counts.nodes, counts.leaves, smallest)
        body.expire_views()
        body.state.publish_positions()
        self.conditions.follow(followers)
        for binding in body.bindings:
            binding.rebind(self.forest.pools)
        return True

    def _keep_initial_state(self, initial: tuple[wp.array, wp.array] | None) -> None:
        """Let ``reset`` restore rest on the current mesh, or the body's initial state."""
        arrays, count = self.forest.carriage.arrays, self.body.node_count
        present = [wp.clone(array) for array in (arrays.u, arrays.v)]
        arrays.u.zero_()
        free = ~self.body.constrained
        velocities = self._of_nodes(arrays.v)
        velocities[free] = 0.0
        arrays.v[:count].assign(velocities)
        if initial is not None:
            for array, kept in zip((arrays.u, arrays.v), initial, strict=True):
                wp.copy(array, kept, count=count)
        self.body.state.publish_positions()
        self.remember()
        for array, kept in zip((arrays.u, arrays.v), present, strict=True):
            wp.copy(array, kept)
        self.body.state.publish_positions()

    def _of_nodes(self, array: wp.array) -> npt.NDArray[Any]:
        return array[: self.body.node_count].numpy().copy()


def _room_for_nodes(mesh: TetForest, capacity: int) -> int:
    """Places for the nodes of a mesh that is refined up to a capacity and cut."""
    return 2 * len(mesh.lattice) + (capacity - len(mesh.tets) + 1) // 2 + NODE_GRANULE


def fitted(options: OnlineRemesh, body: SoftBody) -> OnlineRemesh:
    """The options with defaults filled in from the body's mesh; see `OnlineRemesh.on`.

    Raises:
        InputError: A general mesh, more than one world, options that do not fit the mesh, parameters on another device,
            or a criterion that does not compile.
    """
    mesh = body.mesh
    if not isinstance(mesh, TetForest):
        raise InputError(f"only a TetForest can be remeshed or cut; the mesh of this body is a {type(mesh).__name__}")
    if body.worlds > 1:
        raise InputError(f"worlds is {body.worlds}; only a body in one world can be remeshed or cut")
    if options.near is not None:
        place = wp.array(options.place, dtype=wp.float32, device=body.device)
        options = replace(options, criterion=nearness, parameters=place)
    numbers = options.parameters
    if numbers is not None and numbers.device != body.device:
        raise InputError(f"parameters is on {numbers.device}; it must be on the body's device, {body.device}")
    if options.criterion is not None:
        try:
            wp.load_module(marking_kernel(options.criterion).module, body.device)
        except Exception as error:  # any error, since the user's code is compiled
            reason = str(error).strip().rpartition("\n")[2].lstrip(";")
            raise InputError(f"the criterion {options.criterion.func.__name__!r} does not compile: {reason}") from error
    return options.on(mesh)
