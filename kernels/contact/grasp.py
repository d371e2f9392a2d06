"""Springs that pull points of bodies to places: nodes that a tool holds, and patches that a person holds on the page.

A row is a spring that pulls the weighted mean of several points; up to four nodes carry each point. In implicit steps
its force is that at the end of a step, and the matrix has its stiffness. A rigid grasp has a spring that is stiffer
than the body, with the force of the last step as a multiplier, so that what is at rest has no offset; in explicit steps
it is a constraint.
"""

import warp as wp

from warp_corot.kernels.elements.elements import add_force, load_node, store_node
from warp_corot.kernels.modules import INLINED

from .law import SETTLING
from .motion import Motions, Part, foreseen
from .shapes import carried

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": INLINED})


@wp.struct
class Spring:
    """The spring of a row, between a place and the mean of its points."""

    first: int  # its first entry in ``Attachments.points``
    count: int  # the number of these; 0 while it holds nothing
    target: wp.vec3  # the displacement to which it pulls the mean [m]
    stiffness: float  # [N/m]
    damping: float  # [N s/m]
    limit: float  # the largest force [N]


@wp.struct
class Attachments:
    """Springs, [R], and the points that they hold."""

    springs: wp.array[Spring]
    points: wp.array[wp.int32]
    shares: wp.array[wp.float32]  # the weight of each in its row
    nodes: wp.array[wp.vec4i]  # of each point, with their weights
    weights: wp.array[wp.vec4]
    multiplier: wp.array[wp.vec3]  # [R] [N]
    force: wp.array[wp.vec3]  # [R] on the body [N]
    moved: wp.array[wp.vec3]  # [R] the displacement of the mean [m]
    softened: wp.array[wp.float32]  # [R] the stiffness that gives the force, which is no larger than the limit [N/m]


@wp.func
def mean_of(row: int, values: wp.array[wp.vec4], of: Attachments):
    """The mean of nodal vectors at the points of a row."""
    mean = wp.vec3()
    for entry in range(of.springs[row].first, of.springs[row].first + of.springs[row].count):
        p = of.points[entry]
        for m in range(4):
            if of.weights[p][m] != 0.0:
                mean += (of.shares[entry] * of.weights[p][m]) * load_node(values, of.nodes[p][m])
    return mean


@wp.func
def add_to_points(row: int, force: wp.vec3, of: Attachments, y: wp.array[wp.vec4]):
    """Add a force on the mean of a row to the nodes of its points."""
    for entry in range(of.springs[row].first, of.springs[row].first + of.springs[row].count):
        p = of.points[entry]
        for m in range(4):
            if of.weights[p][m] != 0.0:
                add_force(y, of.nodes[p][m], (of.shares[entry] * of.weights[p][m]) * force)


@wp.kernel(enable_backward=False)
def pull(u: wp.array[wp.vec4], v: wp.array[wp.vec4], of: Attachments, f: wp.array[wp.vec4]):
    """Add the springs' forces in a state with displacements u and velocities v to f."""
    row = wp.tid()
    spring = of.springs[row]
    of.force[row] = wp.vec3()
    if spring.count == 0:
        return
    moved = mean_of(row, u, of)
    stretch = spring.target - moved
    force = of.multiplier[row] + spring.stiffness * stretch
    if spring.damping > 0.0:
        force -= spring.damping * mean_of(row, v, of)
    size = wp.length(force)
    if size > spring.limit:
        force *= spring.limit / size
    of.force[row] = force
    of.moved[row] = moved
    of.softened[row] = wp.min(spring.stiffness, spring.limit / wp.max(wp.length(stretch), 1.0e-30))
    add_to_points(row, force, of, f)


@wp.kernel(enable_backward=False)
def add_products(of: Attachments, p: wp.array[wp.vec4], y: wp.array[wp.vec4]):
    """y += K p."""
    row = wp.tid()
    add_to_points(row, of.softened[row] * mean_of(row, p, of), of, y)


@wp.kernel(enable_backward=False)
def add_blocks(of: Attachments, blocks: wp.array[wp.mat33]):
    """Add the blocks on K's diagonal, or a part of them where points of a row share nodes."""
    row = wp.tid()
    for entry in range(of.springs[row].first, of.springs[row].first + of.springs[row].count):
        p = of.points[entry]
        for m in range(4):
            w = of.shares[entry] * of.weights[p][m]
            if w != 0.0:
                wp.atomic_add(blocks, of.nodes[p][m], (w * w * of.softened[row]) * wp.identity(n=3, dtype=float))


# --- nodes that a tool holds at fixed places in its frame -------------------------------------------------------------

#: Whether a node is held: not while the grasp is open, yes, or not because it was out of reach when the grasp closed.
OPEN, HELD, MISSED = (wp.constant(k) for k in range(3))


@wp.struct
class Grip:
    """Nodes that a tool holds, [R]: as many in each world."""

    nodes: wp.array[wp.int32]
    per_world: int
    tool: int  # its number among the obstacles
    motions: Motions
    places: wp.array[wp.vec3]  # in the tool's frame [m]
    held: wp.array[wp.int32]  # see ``HELD``
    forces: wp.array[wp.vec3]  # on the nodes [N]


@wp.kernel(enable_backward=False)
def take_hold(
    # In
    poses: wp.array2d[wp.transform],
    closed: wp.array[wp.int32],
    reach: float,
    rest: wp.array[wp.vec4],
    u: wp.array[wp.vec4],
    # In and out
    grip: Grip,
):
    """Let nodes go where the grasp is open. Where it has just closed, take hold of those within reach of the tool's
    origin, and record their positions in the tool's frame.
    """
    k = wp.tid()
    world = k / grip.per_world
    if closed[world] == 0:
        grip.held[k] = OPEN
    elif grip.held[k] == OPEN:
        i = grip.nodes[k]
        tool = wp.transform_inverse(poses[world, grip.tool])
        place = wp.transform_point(tool, load_node(rest, i) + load_node(u, i))
        grip.places[k] = place
        grip.held[k] = wp.where(wp.length(place) <= reach, HELD, MISSED)


@wp.kernel(enable_backward=False)
def open_grasps(chosen: wp.array[wp.int32], grip: Grip):
    """Let the nodes of chosen worlds go."""
    k = wp.tid()
    if chosen[k / grip.per_world] != 0:
        grip.held[k] = OPEN
        grip.forces[k] = wp.vec3()


@wp.func
def add_contact_force(i: int, force: wp.vec3, contact_forces: wp.array[wp.vec4]):
    store_node(contact_forces, i, load_node(contact_forces, i) + force)


@wp.kernel(enable_backward=False)
def hold_in_tool(grip: Grip, stiffness: float, part: Part, contact_forces: wp.array[wp.vec4]):
    """Find the forces that move nodes with the tool by the end of the step. If ``stiffness`` [N/m] is positive,
    implicit springs pull the nodes there instead. Of ``part`` only what moves the body counts.
    """
    k = wp.tid()
    i = grip.nodes[k]
    body = part.dynamics
    grip.forces[k] = wp.vec3()
    if body.inverse_mass[i] == 0.0 or grip.held[k] != HELD:
        return
    world = k / grip.per_world
    own = foreseen(i, part)
    now = grip.motions.now[world, grip.tool]
    way = carried(now, grip.motions.later[world, grip.tool], own.x) - own.d
    off = wp.transform_point(now, grip.places[k]) - own.x
    force = (way + SETTLING * off) / own.yielding
    if stiffness > 0.0:
        force = (stiffness / (1.0 + stiffness * own.yielding)) * (way + off)
    grip.forces[k] = force
    store_node(body.f, i, load_node(body.f, i) + force)
    add_contact_force(i, force, contact_forces)


@wp.kernel(enable_backward=False)
def aim(grip: Grip, is_rigid: int, inverse_mass: wp.array[wp.float32], rest: wp.array[wp.vec4], of: Attachments):
    """Let springs pull held nodes to where the tool will be at the end of an implicit step, from the last force."""
    k = wp.tid()
    i = grip.nodes[k]
    spring = of.springs[k]
    spring.count = wp.where(grip.held[k] == HELD and inverse_mass[i] > 0.0, 1, 0)
    later = grip.motions.later[k / grip.per_world, grip.tool]
    spring.target = wp.transform_point(later, grip.places[k]) - load_node(rest, i)
    of.springs[k] = spring
    of.multiplier[k] = wp.where(is_rigid != 0, of.force[k], wp.vec3())


@wp.kernel(enable_backward=False)
def add_held_forces(grip: Grip, contact_forces: wp.array[wp.vec4]):
    k = wp.tid()
    add_contact_force(grip.nodes[k], grip.forces[k], contact_forces)


@wp.kernel(enable_backward=False)
def sum_held(grip: Grip, wrenches: wp.array[wp.spatial_vector]):
    """Sum the wrench of the nodes on the tool, about its origin, in a fixed order."""
    world = wp.tid()
    force = wp.vec3d()
    torque = wp.vec3d()
    turn = wp.transform_get_rotation(grip.motions.later[world, grip.tool])
    for k in range(world * grip.per_world, (world + 1) * grip.per_world):
        force -= wp.vec3d(grip.forces[k])
        torque -= wp.vec3d(wp.cross(wp.quat_rotate(turn, grip.places[k]), grip.forces[k]))
    wrenches[world] = wp.spatial_vector(wp.vec3(force), wp.vec3(torque))
