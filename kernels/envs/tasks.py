"""Tasks: how their episodes begin, and how steps are judged.

The first four numbers that an episode draws are used by all tasks: ``episodes.draw_episodes``. Others follow in the
order in which a task names them.
"""

import warp as wp

from .episodes import FORCE, OF_TOOL, POSITION, Worlds, conclude, note, seen, turned

wp.set_module_options({"enable_backward": False})


@wp.func
def drawn(draws: wp.array2d[wp.float32], w: int, first: int):
    return wp.vec3(draws[w, first], draws[w, first + 1], draws[w, first + 2])


@wp.func
def upright(x: wp.vec3):
    return wp.transformation(x, wp.quat_identity())


# --- retraction: start x, y, z, goal x, y, z -------------------------------------------------------------------------


@wp.kernel(enable_backward=False)
def begin_retraction(chosen: wp.array[wp.int32], site: wp.vec3, worlds: Worlds):
    """Place the gripper above the rim, and the goal of the rim's middle, ``site`` at rest [m]."""
    w = wp.tid()
    if chosen[w] == 0:
        return
    pose = worlds.pose[0, w]
    here = wp.transform_point(pose, site)
    worlds.targets[0, w] = upright(here + drawn(worlds.draws, w, 4))
    note(worlds, w, 0, wp.transform_point(pose, site + drawn(worlds.draws, w, 7)))


@wp.kernel(enable_backward=False)
def judge_retraction(near: float, reach: float, hold: int, bonus: float, worlds: Worlds):
    """Judge by the distances of the gripper from the rim, and of the rim from its goal, and by whether the gripper is
    closed within its ``reach`` of the rim [m].
    """
    w = wp.tid()
    site = seen(worlds, w, OF_TOOL)
    to_site = wp.length(seen(worlds, w, POSITION) - site)
    to_goal = wp.length(site - wp.vec3(worlds.notes[w, 0], worlds.notes[w, 1], worlds.notes[w, 2]))
    worlds.notes[w, 3] = float(worlds.closed[w])
    held = worlds.closed[w] != 0 and to_site < reach
    reward = -0.1 * (to_site + 2.0 * to_goal) / 0.05 - wp.where(held, 0.0, 0.1)
    conclude(worlds, w, reward, to_goal < near, hold, bonus, False)


# --- palpation: lump x, y, z, its radius, its ratio ------------------------------------------------------------------


@wp.kernel(enable_backward=False)
def begin_palpation(chosen: wp.array[wp.int32], start: wp.vec3, worlds: Worlds):
    """Place a lump in the tissue, and the probe above."""
    w = wp.tid()
    if chosen[w] == 0:
        return
    lump = drawn(worlds.draws, w, 4)
    worlds.lump[w] = wp.vec4(lump[0], lump[1], lump[2], worlds.draws[w, 7])
    worlds.ratio[w] = worlds.draws[w, 8]
    worlds.targets[0, w] = upright(start)


@wp.kernel(enable_backward=False)
def judge_palpation(near: float, least: float, hold: int, bonus: float, worlds: Worlds):
    """Judge by the probe's distance from the lump, seen from above, while it feels at least a force [N]; and note the
    largest force of the episode, and where it was.
    """
    w = wp.tid()
    probe = seen(worlds, w, POSITION)
    force = worlds.observations[w, FORCE + 2]
    if force > worlds.notes[w, 0]:
        worlds.notes[w, 0] = force
        worlds.notes[w, 1] = probe[0]
        worlds.notes[w, 2] = probe[1]
    lump = worlds.lump[w]
    off = wp.transform_point(worlds.pose[0, w], wp.vec3(lump[0], lump[1], lump[2])) - probe
    away = wp.length(wp.vec2(off[0], off[1]))
    reward = -0.1 * away / 0.02 - wp.where(force < least, 0.1, 0.0)
    conclude(worlds, w, reward, away < near and force >= least, hold, bonus, False)


# --- reach: start x, y, z, goal y, z ---------------------------------------------------------------------------------


@wp.kernel(enable_backward=False)
def begin_reach(chosen: wp.array[wp.int32], centre: wp.vec3, start: wp.vec3, half: float, worlds: Worlds):
    """Place the tool above the tissue, and the goal of its tip in the channel below ``centre`` [m]; ``half`` is
    the distance from the tool's origin to its tip [m].
    """
    w = wp.tid()
    if chosen[w] == 0:
        return
    pose = worlds.pose[0, w]
    worlds.targets[0, w] = upright(start + drawn(worlds.draws, w, 4))
    goal = wp.transform_point(pose, centre + wp.vec3(0.0, worlds.draws[w, 7], worlds.draws[w, 8]))
    note(worlds, w, 0, goal + wp.vec3(0.0, 0.0, half))


@wp.kernel(enable_backward=False)
def judge_reach(near: float, bound: float, hold: int, bonus: float, worlds: Worlds):
    """Judge by the tool's distance from its goal; a stress beyond the bound [Pa] ends the episode as a bruise."""
    w = wp.tid()
    goal = wp.vec3(worlds.notes[w, 0], worlds.notes[w, 1], worlds.notes[w, 2])
    away = wp.length(seen(worlds, w, POSITION) - goal)
    stress = worlds.peak[w] / bound
    worlds.notes[w, 3] = stress
    bruised = stress > 1.0
    reward = -0.1 * (away / 0.02 + stress) - wp.where(bruised, bonus, 0.0)
    conclude(worlds, w, reward, away < near, hold, bonus, bruised)


# --- lift: fingers' middle x, y, z, their distance -------------------------------------------------------------------

#: Force of each finger that counts as a grip [N].
GRIP = wp.constant(0.5)


@wp.func
def place_fingers(worlds: Worlds, w: int):
    middle = drawn(worlds.draws, w, 4)
    apart = wp.vec3(0.5 * worlds.draws[w, 7], 0.0, 0.0)
    worlds.targets[0, w] = upright(middle - apart)
    worlds.targets[1, w] = upright(middle + apart)


@wp.func
def middle_of(worlds: Worlds, w: int, points: int, block: int):
    """The middle of the observed points of a block [m]."""
    x = wp.vec3()
    for k in range(points * block, points * (block + 1)):
        x += seen(worlds, w, 2 * OF_TOOL + 3 * k) / float(points)
    return x


@wp.func
def approach(worlds: Worlds, w: int, block: wp.vec3):
    """A reward from -0.2 to 0: how near the fingers are to a block, and how firmly they hold it."""
    fingers = 0.5 * (seen(worlds, w, POSITION) + seen(worlds, w, OF_TOOL + POSITION))
    force = wp.min(-worlds.observations[w, FORCE], worlds.observations[w, OF_TOOL + FORCE])
    near = wp.min(wp.length(fingers - block) / 0.05, 1.0)
    return 0.1 * (wp.clamp(force / GRIP, 0.0, 1.0) - 1.0 - near)


@wp.kernel(enable_backward=False)
def begin_lift(chosen: wp.array[wp.int32], worlds: Worlds):
    """Place the fingers above the block."""
    w = wp.tid()
    if chosen[w] != 0:
        place_fingers(worlds, w)


@wp.kernel(enable_backward=False)
def judge_lift(points: int, low: float, high: float, hold: int, bonus: float, worlds: Worlds):
    """Judge by the height of the block's middle, between ``low`` at rest and ``high`` [m], and by how the fingers hold
    it.
    """
    w = wp.tid()
    block = middle_of(worlds, w, points, 0)
    height = wp.clamp((block[2] - low) / (high - low), 0.0, 1.0)
    worlds.notes[w, 0] = height
    reward = 0.2 * (height - 1.0) + approach(worlds, w, block)
    conclude(worlds, w, reward, block[2] > high, hold, bonus, False)


# --- stacking: as lift, and shift x, y and turn of the lower block ----------------------------------------------------


@wp.kernel(enable_backward=False)
def begin_stacking(chosen: wp.array[wp.int32], centre: wp.vec3, worlds: Worlds):
    """Place the fingers above the upper block, and the lower one about its ``centre`` [m]."""
    w = wp.tid()
    if chosen[w] != 0:
        place_fingers(worlds, w)
        worlds.pose[1, w] = turned(worlds.draws, w, 8, centre)


@wp.kernel(enable_backward=False)
def judge_stacking(points: int, rise: float, near: float, hold: int, bonus: float, worlds: Worlds):
    """Judge by the distance of the upper block's middle from its goal, ``rise`` [m] above that of the lower one, and by
    how the fingers hold it; or, at its goal, whether they have let go.
    """
    w = wp.tid()
    block = middle_of(worlds, w, points, 0)
    goal = middle_of(worlds, w, points, 1) + wp.vec3(0.0, 0.0, rise)
    note(worlds, w, 0, goal)
    away = wp.length(block - goal)
    touch = wp.max(wp.length(seen(worlds, w, FORCE)), wp.length(seen(worlds, w, OF_TOOL + FORCE)))
    held = approach(worlds, w, block)
    if away < near:
        held = 0.1 * (1.0 - wp.min(touch / GRIP, 1.0))
    conclude(worlds, w, held - 0.2 * away / 0.05, away < near and touch == 0.0, hold, bonus, False)


# --- threading: hold z, peg x, y -------------------------------------------------------------------------------------


@wp.kernel(enable_backward=False)
def begin_threading(chosen: wp.array[wp.int32], centre: wp.vec3, above: float, worlds: Worlds):
    """Place the tube in a closed gripper ``above`` its centre [m]; the peg is the last tool, which no action moves."""
    w = wp.tid()
    if chosen[w] == 0:
        return
    pose = upright(wp.vec3(0.0, 0.0, worlds.draws[w, 4])) * worlds.pose[0, w]
    worlds.pose[0, w] = pose
    worlds.targets[0, w] = upright(wp.transform_point(pose, centre + wp.vec3(0.0, 0.0, above)))
    peg = wp.vec3(worlds.draws[w, 5], worlds.draws[w, 6], wp.transform_get_translation(worlds.targets[1, w])[2])
    worlds.targets[1, w] = upright(peg)
    worlds.closed[w] = 1


@wp.kernel(enable_backward=False)
def judge_threading(points: int, near: float, low: float, top: float, hold: int, bonus: float, worlds: Worlds):
    """Judge by where the tube's lower rim is: around the peg, whose top is at a height, and below ``low`` [m]."""
    w = wp.tid()
    worlds.closed[w] = 1
    rim = wp.vec3()
    for k in range(points):
        rim += seen(worlds, w, 2 * OF_TOOL + 3 * k) / float(points)
    off = rim - seen(worlds, w, OF_TOOL + POSITION)
    away = wp.length(wp.vec2(off[0], off[1]))
    reward = -0.1 * (away / 0.01 + wp.max(rim[2] - low, 0.0) / (top - low))
    conclude(worlds, w, reward, away < near and rim[2] < low, hold, bonus, False)
