"""Nodes that a tool holds at fixed places in its frame, rigidly or by springs.

In implicit steps both are springs to the tool's pose at the end of the step. The rigid one is stiffer than the body and
has the force of the last step as a multiplier, so a node at rest has no offset.
"""

import warp as wp

from warp_corot.kernels.elements.elements import load_node, store_node
from warp_corot.kernels.modules import INLINED
from warp_corot.kernels.stepping.pace import Pace

from .law import SETTLING
from .motion import Dynamics, Motions, foreseen
from .shapes import carried

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": INLINED})

#: Whether a node is held: not while the grasp is open, yes, or not because it was out of reach when the grasp closed.
OPEN, HELD, MISSED = (wp.constant(k) for k in range(3))


@wp.kernel(enable_backward=False)
def take_hold(
    # In
    nodes: wp.array[wp.int32],
    per_world: int,
    o: int,
    poses: wp.array2d[wp.transform],
    closed: wp.array[wp.int32],
    reach: float,
    rest: wp.array[wp.vec4],
    u: wp.array[wp.vec4],
    # In and out
    held: wp.array[wp.int32],
    # Out
    places: wp.array[wp.vec3],
):
    """Let nodes go where the grasp is open. Where it has just closed, take hold of those within reach of the tool's
    origin, and record their positions in the tool's frame.
    """
    k = wp.tid()
    world = k / per_world
    if closed[world] == 0:
        held[k] = OPEN
    elif held[k] == OPEN:
        i = nodes[k]
        place = wp.transform_point(wp.transform_inverse(poses[world, o]), load_node(rest, i) + load_node(u, i))
        places[k] = place
        held[k] = wp.where(wp.length(place) <= reach, HELD, MISSED)


@wp.kernel(enable_backward=False)
def open_grasps(chosen: wp.array[wp.int32], per_world: int, held: wp.array[wp.int32], forces: wp.array[wp.vec3]):
    """Let the nodes of chosen worlds go."""
    k = wp.tid()
    if chosen[k / per_world] != 0:
        held[k] = OPEN
        forces[k] = wp.vec3()


@wp.kernel(enable_backward=False)
def hold_in_tool(
    # In
    nodes: wp.array[wp.int32],
    per_world: int,
    o: int,
    motions: Motions,
    places: wp.array[wp.vec3],
    held: wp.array[wp.int32],
    stiffness: float,
    pace: Pace,
    offset: int,
    # In and out
    body: Dynamics,
    contact_forces: wp.array[wp.vec4],
    # Out
    forces: wp.array[wp.vec3],
):
    """Find the forces that move nodes with the tool by the end of the step. If ``stiffness`` [N/m] is positive,
    implicit springs pull the nodes there instead.
    """
    k = wp.tid()
    i = nodes[k]
    forces[k] = wp.vec3()
    if body.inverse_mass[i] == 0.0 or held[k] != HELD:
        return
    world = k / per_world
    own = foreseen(i, body, pace, offset)
    now = motions.now[world, o]
    way = carried(now, motions.later[world, o], own.x) - own.d
    off = wp.transform_point(now, places[k]) - own.x
    force = (way + SETTLING * off) / own.yielding
    if stiffness > 0.0:
        force = (stiffness / (1.0 + stiffness * own.yielding)) * (way + off)
    forces[k] = force
    store_node(body.f, i, load_node(body.f, i) + force)
    store_node(contact_forces, i, load_node(contact_forces, i) + force)


@wp.kernel(enable_backward=False)
def pull_to_tool(
    # In
    nodes: wp.array[wp.int32],
    per_world: int,
    o: int,
    motions: Motions,
    places: wp.array[wp.vec3],
    held: wp.array[wp.int32],
    stiffness: float,
    multipliers: wp.array[wp.vec3],
    inverse_mass: wp.array[wp.float32],
    rest: wp.array[wp.vec4],
    u: wp.array[wp.vec4],
    # In and out
    f: wp.array[wp.vec4],
    # Out
    forces: wp.array[wp.vec3],
):
    """Add the springs' forces in the body's state, with the tool in its pose at the end of the step."""
    k = wp.tid()
    i = nodes[k]
    force = wp.vec3()
    if inverse_mass[i] > 0.0 and held[k] == HELD:
        there = wp.transform_point(motions.later[k / per_world, o], places[k])
        force = multipliers[k] + stiffness * (there - load_node(rest, i) - load_node(u, i))
        store_node(f, i, load_node(f, i) + force)
    forces[k] = force


@wp.kernel(enable_backward=False)
def add_hold_product(
    nodes: wp.array[wp.int32], held: wp.array[wp.int32], stiffness: float, p: wp.array[wp.vec4], y: wp.array[wp.vec4]
):
    k = wp.tid()
    if held[k] == HELD:
        store_node(y, nodes[k], load_node(y, nodes[k]) + stiffness * load_node(p, nodes[k]))


@wp.kernel(enable_backward=False)
def add_hold_blocks(nodes: wp.array[wp.int32], held: wp.array[wp.int32], stiffness: float, blocks: wp.array[wp.mat33]):
    k = wp.tid()
    if held[k] == HELD:
        blocks[nodes[k]] = blocks[nodes[k]] + stiffness * wp.identity(3, dtype=wp.float32)


@wp.kernel(enable_backward=False)
def add_held_forces(nodes: wp.array[wp.int32], forces: wp.array[wp.vec3], contact_forces: wp.array[wp.vec4]):
    k = wp.tid()
    i = nodes[k]
    store_node(contact_forces, i, load_node(contact_forces, i) + forces[k])


@wp.kernel(enable_backward=False)
def sum_held(
    # In
    per_world: int,
    o: int,
    motions: Motions,
    places: wp.array[wp.vec3],
    forces: wp.array[wp.vec3],
    # Out
    wrenches: wp.array[wp.spatial_vector],
):
    """Sum the wrench of the nodes on the tool, about its origin, in a fixed order."""
    world = wp.tid()
    force = wp.vec3d()
    torque = wp.vec3d()
    turn = wp.transform_get_rotation(motions.later[world, o])
    for k in range(world * per_world, (world + 1) * per_world):
        force -= wp.vec3d(forces[k])
        torque -= wp.vec3d(wp.cross(wp.quat_rotate(turn, places[k]), forces[k]))
    wrenches[world] = wp.spatial_vector(wp.vec3(force), wp.vec3(torque))
