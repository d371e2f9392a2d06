"""A tool that holds a patch of a body."""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.body.controls import Nodes, chosen_nodes, nodes_at
from warp_corot.body.soft_body import SoftBody
from warp_corot.errors import InputError, StabilityWarning, depth_of_user
from warp_corot.inputs.checks import checked_number, shown
from warp_corot.kernels.contact import grasp as kernels
from warp_corot.kernels.contact.motion import Part
from warp_corot.mesh import TetForest
from warp_corot.solvers.system import Constraint

from .tool import Tool

#: Stiffness of a node that is held rigidly in implicit steps, over that of an element.
RIGID = 1000.0


#: The largest force of a spring without a limit [N].
UNLIMITED = 1e30


class Attachments:
    """Springs on points of a body, as forces of its system or of an implicit step; all launches may be recorded.

    Args:
        body: The body.

    Attributes:
        arrays: The springs and their points, as a struct for kernels.
    """

    def __init__(self, body: SoftBody):
        self.body, self.device = body, body.device

    def make(self, rows: int) -> None:
        """Make room for springs, each of which has one entry."""
        self.arrays = kernels.Attachments()
        self.arrays.springs = wp.zeros(rows, dtype=kernels.Spring, device=self.device)
        self.arrays.points = wp.array(np.arange(rows), dtype=wp.int32, device=self.device)
        self.arrays.shares = wp.full(rows, 1.0, dtype=wp.float32, device=self.device)
        self.arrays.softened = wp.zeros(rows, dtype=wp.float32, device=self.device)
        for name in ("multiplier", "force", "moved"):
            setattr(self.arrays, name, wp.zeros(rows, dtype=wp.vec3, device=self.device))

    def add_forces(self) -> None:
        """Launch the springs' forces in the present state."""
        state = self.body.state
        self._pull(kernels.pull, [state.displacements, state.velocities, self.arrays, state.forces])

    def add_stiffness(self, body: SoftBody, p: wp.array, y: wp.array) -> None:
        """Launch y += K p, where K are springs as soft as their limits make them."""
        if body is self.body:
            self._pull(kernels.add_products, [self.arrays, p, y])

    def add_diagonal(self, body: SoftBody, blocks: wp.array) -> None:
        """Launch the addition of the blocks on K's diagonal."""
        if body is self.body:
            self._pull(kernels.add_blocks, [self.arrays, blocks])

    def _pull(self, kernel: wp.Kernel, inputs: list) -> None:
        if len(self.arrays.springs):
            wp.launch(kernel, len(self.arrays.springs), inputs, device=self.device)


def rows_of_springs(count: int) -> npt.NDArray[np.void]:
    """Springs of zeros, for the host to fill in."""
    of_spring: Any = kernels.Spring
    return np.zeros(count, dtype=of_spring.numpy_dtype())


class Grasp(Attachments, Constraint):
    """A patch of a body's surface that moves with a tool, from the present places of both until it is released.

    It is one of the simulation's constraints as soon as it is made. In implicit steps a rigidly held patch gives way a
    little while forces change. ``tool.wrench`` does not include the force of a grasp.

    Args:
        body: The body.
        patch: Its nodes, as for ``SoftBody.fix``; nodes inside the body are left out.
        tool: The tool that holds them; an obstacle of the same simulation.
        stiffness: Stiffness of the whole patch [N/m]; None: the patch is held rigidly.
        closed: Opens and closes the grasp in each world, int32 [worlds] on the device, which every step reads: from the
            step that finds a number other than zero, the world's tool holds those nodes that are then within reach.
            None: the grasp is closed from now on. A reset of a world opens its grasp; checkpoints refuse it.
        reach: The largest distance from the tool's origin of nodes that are taken hold of [m].

    Raises:
        InputError: The tool is in no simulation or the body in another, the patch has no node of the surface, the body
            is remeshed in several worlds or with ``closed``, the stiffness is not positive, or ``closed`` has another
            type, length or device.
    """

    #: Whether its stiffness couples no two nodes.
    is_diagonal = True
    launch_revision = 0

    def __init__(
        self,
        body: SoftBody,
        patch: Nodes,
        *,
        tool: Tool,
        stiffness: float | None = None,
        closed: wp.array | None = None,
        reach: float = math.inf,
    ):
        if not isinstance(body, SoftBody):
            raise InputError(f"body is {shown(body)}; it must be a SoftBody")
        if not isinstance(tool, Tool):
            raise InputError(f"tool is {shown(tool)}; it must be a Tool among a simulation's obstacles")
        self._obstacles, self._number = tool.place_among_obstacles()
        system = self._obstacles.system
        if body not in system.bodies:
            raise InputError("the body is in no simulation with this tool; both must be in one")
        if body.changing is not None and body.worlds > 1:
            raise InputError(
                f"the body is remeshed in {body.worlds} worlds; a grasp of one that is must be in one world"
            )
        if stiffness is not None and not 0.0 < checked_number(stiffness, "stiffness", "N/m") < math.inf:
            raise InputError(f"stiffness is {stiffness}; it must be a positive number [N/m], or None")
        if closed is not None:
            given = isinstance(closed, wp.array) and (closed.dtype, closed.shape, closed.device)
            if given != (wp.int32, (body.worlds,), body.device) or body.changing is not None:
                raise InputError(
                    f"closed is {shown(closed)}; it must be a Warp array int32 [{body.worlds}] on {body.device}, of a "
                    "body that is not remeshed"
                )
        if not checked_number(reach, "reach", "m") > 0.0:
            raise InputError(f"reach is {reach}; it must be a positive distance [m]")
        chosen = chosen_nodes(nodes_at(patch, lambda: body.mesh), body.world_node_count, 1).indices
        nodes = np.intersect1d(chosen, body.surface_triangles)
        if not len(nodes):
            raise InputError("the patch has no node of the body's surface; it must have one at least")
        super().__init__(body)
        self.tool, self._system = tool, system
        self.stiffness = None if stiffness is None else float(stiffness)
        self.closed, self._reach = closed, min(float(reach), 1e30)
        self._closed = wp.ones(body.worlds, dtype=wp.int32, device=self.device) if closed is None else closed
        self._take(nodes)
        self._wrenches: wp.array = wp.zeros(body.worlds, dtype=wp.spatial_vectorf, device=self.device)
        body.state.adopt_positions()
        self._held.zero_()
        self._take_hold(self._obstacles.motions.later)
        system.constraints.append(self)
        system.changes += 1

    @property
    def is_holding(self) -> bool:
        """Whether the patch is held."""
        return self in self._system.constraints

    @property
    def wrench(self) -> wp.array:
        """Force of the patch on the tool and torque about its origin in the last step [N, N m], a live
        ``wp.spatial_vector`` [worlds]: force first."""
        return self._wrenches

    def release(self) -> None:
        """Release the patch; further calls do nothing."""
        if self.is_holding:
            self._system.constraints.remove(self)
            # The sum must not return to an earlier value.
            self._system.changes += 1 + self.launch_revision
            self.arrays.force.zero_()
            self._wrenches.zero_()

    def again(self, body: SoftBody) -> Grasp:
        """The same grasp of a body that continues this one's in a simulation that has taken the tool."""
        grasp = Grasp(body, self.nodes, tool=self.tool, stiffness=self.stiffness, closed=self.closed, reach=self._reach)
        for array, former in ((grasp._places, self._places), (grasp.arrays.force, self.arrays.force)):
            if len(array) == len(former):
                wp.copy(array, former)
        return grasp

    # --- as a constraint -------------------------------------------------------------------------------------------

    is_full = False

    @property
    def state(self) -> dict[str, wp.array]:
        return {}

    @property
    def kept(self) -> dict[str, wp.array]:
        """The arrays for a checkpoint: the nodes' places in the tool's frame, and the last forces."""
        return {"places": self._places, "forces": self.arrays.force, "wrenches": self._wrenches}

    def prepare(self) -> None:
        """Hold the same patch of a changed mesh: its remaining nodes, and new ones between two of them.

        Warns:
            StabilityWarning: No node remains, so that it holds nothing.
        """
        if self.body.version == self._version:
            return
        places = dict(zip(self._lattice, self._places.numpy(), strict=True))
        mesh = self.body.mesh
        assert isinstance(mesh, TetForest)
        held = patch_of(mesh, np.unique(self.body.surface_triangles), places)
        if not held:
            warnings.warn(
                "remeshing has left no node of a grasped patch, which is no longer held; the patch must have corners "
                "of coarse elements, or remeshing a min_level that keeps it",
                StabilityWarning,
                stacklevel=depth_of_user(),
            )
        nodes = np.array(sorted(held), np.int32)
        self._take(nodes)
        self._places.assign(np.array([held[node] for node in nodes.tolist()], np.float32).reshape(-1, 3))

    def launch(self, offset: int, damping: float) -> None:
        if not len(self._nodes):
            return
        if self.closed is not None:
            self._take_hold(self._obstacles.motions.now)
        part = Part()
        part.dynamics, part.pace = self._system.dynamics(self.body, damping), self._system.pace.arrays
        part.offset = offset
        self._launch(kernels.hold_in_tool, [self._grip, self._stiffness, part], [self.body.state.contact_forces])

    def launch_begin(self) -> None:
        """Launch the beginning of an implicit step."""
        if self.closed is not None:
            self._take_hold(self._obstacles.motions.now)
        inputs = [int(self.stiffness is None), self.body.conditions.inverse_mass, self.body.state.rest]
        self._launch(kernels.aim, [self._grip, *inputs], [self.arrays])

    def launch_held(self, body: SoftBody) -> None:
        """Launch the addition of its forces at the end of an implicit step to those of contact."""
        if body is self.body:
            self._launch(kernels.add_held_forces, [self._grip], [body.state.contact_forces])

    def publish(self) -> None:
        wp.launch(kernels.sum_held, self.body.worlds, [self._grip], [self._wrenches], device=self.device)

    def reset(self, chosen: wp.array) -> None:
        """Open the grasp in chosen worlds, if it opens at all; otherwise it goes on holding."""
        if self.closed is not None:
            self._launch(kernels.open_grasps, [chosen], [self._grip])

    # --- pieces ----------------------------------------------------------------------------------------------------

    def _launch(self, kernel: wp.Kernel, inputs: list, outputs: list) -> None:
        if len(self._nodes):
            wp.launch(kernel, len(self._nodes), inputs, outputs, device=self.device)

    def _take_hold(self, poses: wp.array) -> None:
        """Launch the opening and closing, with the tools in these poses, [worlds, O]."""
        state = self.body.state
        inputs = [poses, self._closed, self._reach, state.rest, state.displacements]
        self._launch(kernels.take_hold, inputs, [self._grip])

    @property
    def _grip(self) -> kernels.Grip:
        """The nodes as a struct for kernels."""
        grip = kernels.Grip()
        grip.nodes, grip.per_world, grip.tool = self._nodes, self._per_world, self._number
        grip.motions, grip.places, grip.held = self._obstacles.motions, self._places, self._held
        grip.forces = self.arrays.force
        return grip

    def _rigid_stiffness(self) -> float:
        """The stiffness of a node that is held rigidly in implicit steps [N/m]."""
        mesh = self.body.mesh
        size = float(np.mean(mesh.volumes)) ** (1.0 / 3.0)
        return RIGID * float(np.max(self.body.material.isotropic.young)) * size

    def _take(self, nodes: npt.NDArray[np.integer]) -> None:
        """Hold these nodes of each world; their places are set afterwards."""
        body, device = self.body, self.device
        self.nodes, self._per_world, self._version = nodes, len(nodes), body.version
        mesh = body.mesh
        self._lattice: list[tuple[int, ...]] = []
        if body.changing is not None and isinstance(mesh, TetForest):
            self._lattice = list(map(tuple, mesh.lattice[nodes].tolist()))
        self._stiffness = 0.0 if self.stiffness is None else self.stiffness / max(len(nodes), 1)
        everywhere = (nodes + body.world_node_count * np.arange(body.worlds)[:, None]).ravel()
        self._nodes = wp.array(everywhere, dtype=wp.int32, device=device)
        self._places = wp.zeros(len(everywhere), dtype=wp.vec3, device=device)
        self.make(len(everywhere))
        rows = rows_of_springs(len(everywhere))
        rows["first"], rows["stiffness"] = np.arange(len(rows)), self._stiffness or self._rigid_stiffness()
        rows["limit"] = UNLIMITED
        self.arrays.springs = wp.array(rows, dtype=kernels.Spring, device=device)
        self.arrays.nodes = wp.array(np.repeat(everywhere[:, None], 4, axis=1), dtype=wp.vec4i, device=device)
        self.arrays.weights = wp.array(np.tile([1.0, 0.0, 0.0, 0.0], (len(rows), 1)), dtype=wp.vec4, device=device)
        # New nodes of a changed mesh are held like those between which they lie.
        self._held = wp.full(len(everywhere), kernels.HELD, dtype=wp.int32, device=device)
        self.launch_revision += 1


Place = npt.NDArray[np.float32]


def patch_of(
    mesh: TetForest, surface: npt.NDArray[np.integer], places: dict[tuple[int, ...], Place]
) -> dict[int, Place]:
    """The nodes of a forest's surface that belong to a patch, with their places in the tool's frame.

    Args:
        mesh: The present mesh.
        surface: The nodes on its surface.
        places: Places of the patch's nodes on the mesh before, by their lattice points.

    Returns:
        Places by node: of former nodes, and of new ones halfway between two nodes of the patch.
    """
    points = list(map(tuple, mesh.lattice.tolist()))
    held = {node: places[points[node]] for node in surface.tolist() if points[node] in places}
    left = [node for node in surface.tolist() if node not in held]
    grows = True
    while grows:
        ends = {node: mesh.node_ends[node].tolist() for node in left}
        new = {node: 0.5 * (held[a] + held[b]) for node, (a, b) in ends.items() if a in held and b in held}
        held |= new
        left = [node for node in left if node not in new]
        grows = bool(new)
    return held
