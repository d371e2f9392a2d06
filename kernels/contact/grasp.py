"""Nodes that a tool holds at fixed places in its frame, rigidly or by springs.

In implicit steps both are springs to the tool's pose at the end of the step. The rigid one is stiffer than the body and
has the force of the last step as a multiplier, so a node at rest has no offset.
"""

from typing import Any

import warp as wp

from warp_corot.kernels.elements.elements import load_node, store_node
from warp_corot.kernels.stepping.integrate import by_vectors
from warp_corot.kernels.stepping.pace import Pace

from .begin import foreseen
from .law import SETTLING
from .motion import Motions
from .shapes import carried

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def take_hold(
    # In
    nodes: wp.array[wp.int32],
    per_world: int,
    o: int,
    motions: Motions,
    rest: wp.array[wp.vec4],
    u: wp.array[wp.vec4],
    # Out
    places: wp.array[wp.vec3],
):
    """Record the positions of nodes in the tool's frame."""
    k = wp.tid()
    i = nodes[k]
    pose = motions.later[k / per_world, o]
    x = load_node(rest, i) + load_node(u, i)
    places[k] = wp.quat_rotate_inv(wp.transform_get_rotation(pose), x - wp.transform_get_translation(pose))


@wp.kernel(enable_backward=False)
def hold_in_tool(
    # In
    nodes: wp.array[wp.int32],
    per_world: int,
    o: int,
    motions: Motions,
    places: wp.array[wp.vec3],
    stiffness: float,
    damping: float,
    gravity: wp.vec3,
    inverse_mass: wp.array[wp.float32],
    has_load: int,
    load: wp.array[Any],
    pace: Pace,
    offset: int,
    rest: wp.array[wp.vec4],
    u: wp.array[wp.vec4],
    v: wp.array[wp.vec4],
    # In and out
    f: wp.array[wp.vec4],
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
    if inverse_mass[i] == 0.0:
        return
    world = k / per_world
    own = foreseen(i, damping, gravity, inverse_mass, has_load, load, pace, offset, rest, f, u, v)
    now = motions.now[world, o]
    way = carried(now, motions.later[world, o], own.x) - own.d
    off = wp.transform_point(now, places[k]) - own.x
    force = (way + SETTLING * off) / own.yielding
    if stiffness > 0.0:
        force = (stiffness / (1.0 + stiffness * own.yielding)) * (way + off)
    forces[k] = force
    store_node(f, i, load_node(f, i) + force)
    store_node(contact_forces, i, load_node(contact_forces, i) + force)


@wp.kernel(enable_backward=False)
def pull_to_tool(
    # In
    nodes: wp.array[wp.int32],
    per_world: int,
    o: int,
    motions: Motions,
    places: wp.array[wp.vec3],
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
    if inverse_mass[i] > 0.0:
        there = wp.transform_point(motions.later[k / per_world, o], places[k])
        force = multipliers[k] + stiffness * (there - load_node(rest, i) - load_node(u, i))
        store_node(f, i, load_node(f, i) + force)
    forces[k] = force


@wp.kernel(enable_backward=False)
def add_hold_product(nodes: wp.array[wp.int32], stiffness: float, p: wp.array[wp.vec4], y: wp.array[wp.vec4]):
    i = nodes[wp.tid()]
    store_node(y, i, load_node(y, i) + stiffness * load_node(p, i))


@wp.kernel(enable_backward=False)
def add_hold_blocks(nodes: wp.array[wp.int32], stiffness: float, blocks: wp.array[wp.mat33]):
    i = nodes[wp.tid()]
    blocks[i] = blocks[i] + stiffness * wp.identity(3, dtype=wp.float32)


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


HOLD_IN_TOOL = by_vectors(hold_in_tool, "load")
