"""A tool that holds a patch of a body."""

from __future__ import annotations

import math

import numpy as np
import warp as wp

from warp_corot.body.places import Nodes, chosen_nodes, nodes_at
from warp_corot.body.soft_body import SoftBody
from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_number, shown
from warp_corot.kernels.contact import grasp as kernels

from .tool import Tool


class Grasp:
    """A patch of a body's surface that goes along with a tool, from where both are now until it is released.

    It is one of the simulation's constraints from the moment it is made. ``tool.wrench`` has what the tool feels
    besides.

    Args:
        body: The body.
        patch: Its nodes, as ``SoftBody.fix`` takes them; those inside it are left out.
        tool: What holds them; an obstacle of the same simulation.
        stiffness: Of the whole patch [N/m]; None: it is held rigidly.

    Raises:
        InputError: The tool is in no simulation or the body in another, no node of the surface is meant, a body that is
            remeshed, implicit steps, or a stiffness that is not positive.
    """

    def __init__(self, body: SoftBody, patch: Nodes, *, tool: Tool, stiffness: float | None = None):
        if not isinstance(body, SoftBody):
            raise InputError(f"body is {shown(body)}; it must be a SoftBody")
        if not isinstance(tool, Tool):
            raise InputError(f"tool is {shown(tool)}; it must be a Tool among a simulation's obstacles")
        self._obstacles, self._number = tool.place_among_obstacles()
        system = self._obstacles.system
        if body not in system.bodies:
            raise InputError("the body is in no simulation with this tool; both must be in one")
        if system.is_implicit:
            raise InputError("steps of the simulation are implicit; a grasp needs SymplecticEuler")
        if body.changing is not None:
            raise InputError("a body that is remeshed cannot be grasped; its nodes may change")
        if stiffness is not None and not 0.0 < checked_number(stiffness, "stiffness", "N/m") < math.inf:
            raise InputError(f"stiffness is {stiffness}; it must be a positive number [N/m], or None")
        chosen = chosen_nodes(nodes_at(patch, lambda: body.mesh), body.world_node_count, 1).indices
        nodes = np.intersect1d(chosen, body.surface_triangles)
        if not len(nodes):
            raise InputError("the patch has no node of the body's surface; it must have one at least")
        self.body, self.tool, self.device, self._system = body, tool, body.device, system
        self._per_world = len(nodes)
        everywhere = (nodes + body.world_node_count * np.arange(body.worlds)[:, None]).ravel()
        self.nodes = nodes
        self.stiffness = None if stiffness is None else float(stiffness)
        self._stiffness = 0.0 if stiffness is None else float(stiffness) / len(nodes)
        count = len(everywhere)
        self._nodes = wp.array(everywhere, dtype=wp.int32, device=self.device)
        self._places, self._forces = (wp.zeros(count, dtype=wp.vec3, device=self.device) for _ in range(2))
        self._wrenches: wp.array = wp.zeros(body.worlds, dtype=wp.spatial_vectorf, device=self.device)
        body.state.adopt_positions()
        state = body.state
        inputs = [self._nodes, self._per_world, self._number, self._obstacles.motions, state.rest, state.displacements]
        wp.launch(kernels.take_hold, count, inputs, [self._places], device=self.device)
        system.constraints.append(self)
        system.changes += 1

    @property
    def is_holding(self) -> bool:
        """Whether it has not been released."""
        return self in self._system.constraints

    @property
    def wrench(self) -> wp.array:
        """Force of the patch on the tool and torque about its origin in the last step [N, N m], a live
        ``wp.spatial_vector`` [worlds]: force first."""
        return self._wrenches

    def release(self) -> None:
        """Let the patch go; again is not wrong."""
        if self.is_holding:
            self._system.constraints.remove(self)
            self._system.changes += 1
            self._forces.zero_()
            self._wrenches.zero_()

    # --- as a constraint -------------------------------------------------------------------------------------------

    launch_revision = 0
    is_full = False

    @property
    def state(self) -> dict[str, wp.array]:
        return {}

    @property
    def kept(self) -> dict[str, wp.array]:
        """What a checkpoint holds: where nodes are in the tool's frame, and the last forces."""
        return {"places": self._places, "forces": self._forces, "wrenches": self._wrenches}

    def prepare(self) -> None:
        """Nothing changes."""

    def launch(self, offset: int, damping: float) -> None:
        system, state, conditions = self._system, self.body.state, self.body.conditions
        inputs = [self._nodes, self._per_world, self._number, self._obstacles.motions, self._places, self._stiffness]
        inputs += [damping, system.gravity, conditions.inverse_mass, int(conditions.has_loads), conditions.loads]
        inputs += [system.pace.arrays, offset, state.rest, state.displacements, state.velocities]
        outputs = [state.forces, state.contact_forces, self._forces]
        kernel = kernels.HOLD_IN_TOOL[conditions.loads.dtype]
        wp.launch(kernel, len(self._nodes), inputs, outputs, device=self.device)

    def measure(self) -> None:
        """It goes no faster than its tool."""

    def publish(self) -> None:
        inputs = [self._per_world, self._number, self._obstacles.motions, self._places, self._forces]
        wp.launch(kernels.sum_held, self.body.worlds, inputs, [self._wrenches], device=self.device)

    def grow(self) -> None:
        """It needs no room."""

    def forget(self) -> None:
        """It keeps nothing."""

    def reset(self, chosen: wp.array) -> None:
        """It goes on holding."""
