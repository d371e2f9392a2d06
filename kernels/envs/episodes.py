"""Episodes of environments: their beginning, what is observed, and their end, for each world by itself.

A step of an environment is a row of launches without the host: tools are sent, the tissue moves, the worlds are
observed and judged, and those whose episode is over begin again. Numbers of an episode are drawn by a generator of its
world's seed and the episode's number, so a world's episodes do not depend on others.
"""

import warp as wp

from warp_corot.kernels.contact.motion import Motions, distance_between
from warp_corot.kernels.elements.elements import load_node, store_node

wp.set_module_options({"enable_backward": False})

#: Numbers of a tool in an observation: position [m], velocity [m/s], force [N] and torque [N m].
POSITION, VELOCITY, FORCE, TORQUE = (wp.constant(k) for k in (0, 3, 6, 9))
OF_TOOL = wp.constant(12)


@wp.struct
class Worlds:
    """The episodes of all worlds, [W], and what tasks write when they begin, for tools [O, W]."""

    seed: wp.array[wp.int32]
    number: wp.array[wp.int32]  # of the next episode since the world was seeded
    step: wp.array[wp.int32]  # steps done in this episode
    streak: wp.array[wp.int32]  # steps in a row for which the goal has been reached
    over: wp.array[wp.int32]  # the episode has ended
    again: wp.array[wp.int32]  # the world begins again in this step
    lost: wp.array[wp.int32]  # the state is not finite, or far away
    limit: int  # steps after which an episode is cut off
    at_once: int  # whether a world begins again in the step that ends its episode
    draws: wp.array2d[wp.float32]  # [W, D] the drawn numbers of the episode
    actions: wp.array2d[wp.float32]  # [W, A]
    observations: wp.array2d[wp.float32]  # [W, K] tools, points, time, notes
    notes: wp.array2d[wp.float32]  # [W, X] numbers of the task among the observations
    peak: wp.array[wp.float32]  # largest von Mises stress [Pa]
    reward: wp.array[wp.float32]
    terminated: wp.array[wp.bool]
    truncated: wp.array[wp.bool]
    success: wp.array[wp.bool]
    targets: wp.array2d[wp.transform]  # poses to which tools are sent
    pose: wp.array2d[wp.transform]  # of the parts of the body, [parts, W]
    young: wp.array[wp.float32]  # [Pa]
    lump: wp.array[wp.vec4]  # centre at rest and radius of a stiffer part [m]
    ratio: wp.array[wp.float32]  # its Young's modulus over that of the rest
    closed: wp.array[wp.int32]  # whether the gripper is closed


# --- the beginning -------------------------------------------------------------------------------------------------


@wp.func
def turned(draws: wp.array2d[wp.float32], w: int, first: int, centre: wp.vec3):
    """A pose: drawn shifts along x and y [m], and a drawn turn about the vertical through a centre [rad]."""
    q = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), draws[w, first + 2])
    shift = wp.vec3(draws[w, first], draws[w, first + 1], 0.0)
    return wp.transformation(centre + shift - wp.quat_rotate(q, centre), q)


@wp.kernel(enable_backward=False)
def draw_episodes(
    # In
    chosen: wp.array[wp.int32],
    low: wp.array[wp.float32],
    high: wp.array[wp.float32],
    centre: wp.vec3,
    # Out
    worlds: Worlds,
):
    """Draw the numbers of the episodes that begin in chosen worlds: Young's modulus, shifts and turn of the body about
    a centre [m], and those of the task.
    """
    w = wp.tid()
    if chosen[w] == 0:
        return
    state = wp.rand_init(worlds.seed[w], worlds.number[w])
    for d in range(low.shape[0]):
        worlds.draws[w, d] = low[d] + (high[d] - low[d]) * wp.randf(state)
    for k in range(worlds.notes.shape[1]):
        worlds.notes[w, k] = 0.0
    worlds.number[w] = worlds.number[w] + 1
    worlds.step[w] = 0
    worlds.streak[w] = 0
    worlds.over[w] = 0
    worlds.closed[w] = 0
    worlds.ratio[w] = 1.0
    worlds.young[w] = worlds.draws[w, 0]
    worlds.pose[0, w] = turned(worlds.draws, w, 1, centre)


@wp.kernel(enable_backward=False)
def place_nodes(
    # In
    chosen: wp.array[wp.int32],
    per_world: int,
    parts: wp.array[wp.int32],
    poses: wp.array2d[wp.transform],
    rest: wp.array[wp.vec4],
    # Out
    u: wp.array[wp.vec4],
    positions: wp.array[wp.vec4],
):
    """Move the bodies of chosen worlds, at rest, to their poses, each of their parts to its own."""
    i = wp.tid()
    w = i / per_world
    if chosen[w] != 0:
        x = load_node(rest, i)
        way = wp.transform_point(poses[parts[i % per_world], w], x) - x
        store_node(u, i, way)
        store_node(positions, i, x + way)


@wp.kernel(enable_backward=False)
def write_stiffness(
    # In
    chosen: wp.array[wp.int32],
    centroids: wp.array[wp.vec3],
    poisson: float,
    worlds: Worlds,
    # Out
    mu: wp.array[wp.float32],
    lam: wp.array[wp.float32],
    shown_mu: wp.array[wp.float32],
    shown_lam: wp.array[wp.float32],
):
    """Write Lamé's parameters of the bodies of chosen worlds, for forces and for stresses [Pa]."""
    e = wp.tid()
    count = centroids.shape[0]
    w = e / count
    if chosen[w] == 0:
        return
    lump = worlds.lump[w]
    young = worlds.young[w]
    if wp.length(centroids[e % count] - wp.vec3(lump[0], lump[1], lump[2])) < lump[3]:
        young = young * worlds.ratio[w]
    mu[e] = young / (2.0 * (1.0 + poisson))
    lam[e] = young * poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson))
    shown_mu[e] = mu[e]
    shown_lam[e] = lam[e]


@wp.kernel(enable_backward=False)
def place_tools(chosen: wp.array[wp.int32], targets: wp.array2d[wp.transform], motions: Motions):
    """Put the tools of chosen worlds to their targets."""
    o, w = wp.tid()
    if chosen[w] != 0:
        motions.now[w, o] = targets[o, w]
        motions.later[w, o] = targets[o, w]
        motions.target[w, o] = targets[o, w]


# --- what is done --------------------------------------------------------------------------------------------------


@wp.func
def action(worlds: Worlds, w: int, a: int):
    """An action within [-1, 1]; zero if it is not a number."""
    given = worlds.actions[w, a]
    return wp.where(given == given, wp.clamp(given, -1.0, 1.0), 0.0)


@wp.func
def within(x: wp.vec3, low: wp.vec3, high: wp.vec3):
    return wp.max(low, wp.min(high, x))


@wp.kernel(enable_backward=False)
def steer(far: float, low: wp.vec3, high: wp.vec3, worlds: Worlds):
    """Send the first tool by at most ``far`` [m] along each axis, within a box; a fourth action closes the gripper."""
    w = wp.tid()
    target = worlds.targets[0, w]
    way = far * wp.vec3(action(worlds, w, 0), action(worlds, w, 1), action(worlds, w, 2))
    x = within(wp.transform_get_translation(target) + way, low, high)
    worlds.targets[0, w] = wp.transformation(x, wp.transform_get_rotation(target))
    if worlds.actions.shape[1] > 3:
        worlds.closed[w] = wp.where(action(worlds, w, 3) > 0.0, 1, 0)


@wp.kernel(enable_backward=False)
def steer_fingers(far: float, low: wp.vec3, high: wp.vec3, narrow: float, wide: float, worlds: Worlds):
    """Send two fingers: their middle along each axis, and, with the fourth action, apart along x.

    Args:
        far: The largest motion in a step [m].
        low, high: The box of their middle.
        narrow, wide: The smallest and the largest distance between their centres [m].
    """
    w = wp.tid()
    a = wp.transform_get_translation(worlds.targets[0, w])
    b = wp.transform_get_translation(worlds.targets[1, w])
    way = far * wp.vec3(action(worlds, w, 0), action(worlds, w, 1), action(worlds, w, 2))
    middle = within(0.5 * (a + b) + way, low, high)
    apart = wp.vec3(0.5 * wp.clamp(b[0] - a[0] + 2.0 * far * action(worlds, w, 3), narrow, wide), 0.0, 0.0)
    worlds.targets[0, w] = wp.transformation(middle - apart, wp.quat_identity())
    worlds.targets[1, w] = wp.transformation(middle + apart, wp.quat_identity())


@wp.kernel(enable_backward=False)
def pace_tools(seconds: float, targets: wp.array2d[wp.transform], motions: Motions):
    """Let tools go to their targets at a speed with which they arrive after a time [s], so that they do not jerk."""
    o, w = wp.tid()
    motions.speed[w, o] = distance_between(motions.later[w, o], targets[o, w], motions.reach[o]) / seconds


# --- what is seen --------------------------------------------------------------------------------------------------


@wp.kernel(enable_backward=False)
def find_lost(per_world: int, far: float, u: wp.array[wp.vec4], worlds: Worlds):
    """Find worlds, in an episode, with a displacement that is not finite, or larger than ``far`` [m]."""
    i = wp.tid()
    w = i / per_world
    if worlds.over[w] == 0 and not wp.length(load_node(u, i)) < far:
        worlds.lost[w] = 1


@wp.kernel(enable_backward=False)
def find_peak(count: int, stress: wp.array[wp.float32], worlds: Worlds):
    """Find the largest of the stresses of ``count`` elements in each world [Pa]."""
    w = wp.tid()
    peak = float(0.0)
    for e in range(w * count, (w + 1) * count):
        peak = wp.max(peak, stress[e])
    worlds.peak[w] = peak


@wp.kernel(enable_backward=False)
def observe(
    # In
    tools: int,
    seconds: float,
    motions: Motions,
    contact: wp.array2d[wp.spatial_vector],
    grasp: wp.array[wp.spatial_vector],
    nodes: wp.array[wp.int32],
    per_world: int,
    rest: wp.array[wp.vec4],
    u: wp.array[wp.vec4],
    # Out
    worlds: Worlds,
):
    """Write observations: of each tool its position, velocity, force and torque; positions of points of the tissue; the
    share of the episode that is over; and the notes of the task.

    Args:
        tools: Number of tools; a grasp belongs to the first.
        seconds: Length of a time step [s].
        contact: Wrenches of contact, [O, W].
        grasp: Wrench of the grasp, [W], or empty.
        nodes: The points, among the nodes of a world.
    """
    w = wp.tid()
    for o in range(tools):
        first = OF_TOOL * o
        x = wp.transform_get_translation(motions.later[w, o])
        v = (x - wp.transform_get_translation(motions.now[w, o])) / seconds
        wrench = wp.spatial_vector()
        if worlds.step[w] > 0:
            wrench = contact[o, w]
            if o == 0 and grasp.shape[0] > 0:
                wrench += grasp[w]
        for axis in range(3):
            worlds.observations[w, first + POSITION + axis] = x[axis]
            worlds.observations[w, first + VELOCITY + axis] = v[axis]
        for axis in range(6):
            worlds.observations[w, first + FORCE + axis] = wrench[axis]
    place = OF_TOOL * tools
    for k in range(nodes.shape[0]):
        i = w * per_world + nodes[k]
        x = load_node(rest, i) + load_node(u, i)
        for axis in range(3):
            worlds.observations[w, place + axis] = x[axis]
        place += 3
    worlds.observations[w, place] = float(worlds.step[w]) / float(worlds.limit)
    for k in range(worlds.notes.shape[1]):
        worlds.observations[w, place + 1 + k] = worlds.notes[w, k]


@wp.func
def seen(worlds: Worlds, w: int, first: int):
    """Three numbers of an observation."""
    return wp.vec3(worlds.observations[w, first], worlds.observations[w, first + 1], worlds.observations[w, first + 2])


@wp.func
def note(worlds: Worlds, w: int, first: int, x: wp.vec3):
    """Write three notes."""
    for axis in range(3):
        worlds.notes[w, first + axis] = x[axis]


# --- the end -------------------------------------------------------------------------------------------------------


@wp.func
def conclude(worlds: Worlds, w: int, reward: float, reaches: bool, hold: int, bonus: float, fails: bool):
    """End a step of a world: its reward, and whether its episode is over.

    Args:
        reaches, hold: Whether the goal is reached, and for how many steps in a row it must be.
        bonus: Added to the reward of the step that succeeds.
        fails: Whether the episode ends without success.
    """
    worlds.again[w] = 0
    worlds.terminated[w] = False
    worlds.truncated[w] = False
    worlds.success[w] = False
    worlds.reward[w] = 0.0
    if worlds.over[w] != 0:
        worlds.again[w] = 1
        return
    worlds.step[w] = worlds.step[w] + 1
    if worlds.lost[w] != 0:
        worlds.terminated[w] = True
    else:
        worlds.streak[w] = wp.where(reaches and not fails, worlds.streak[w] + 1, 0)
        worlds.success[w] = worlds.streak[w] >= hold
        worlds.terminated[w] = worlds.success[w] or fails
        worlds.reward[w] = reward + wp.where(worlds.success[w], bonus, 0.0)
    worlds.truncated[w] = worlds.step[w] >= worlds.limit and not worlds.terminated[w]
    if worlds.terminated[w] or worlds.truncated[w]:
        worlds.over[w] = 1
        worlds.again[w] = worlds.at_once
