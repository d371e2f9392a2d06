"""A Franka arm with two fingers: joint angles for a place of its gripper, and what it gives to and takes from tools.

The arm keeps its gripper upright and its third and fifth joints at zero; then the others are found in closed form: the
second, the fourth and the sixth are a chain in a vertical plane, which the first one turns.
"""

import warp as wp

from .episodes import Worlds, action, within

wp.set_module_options({"enable_backward": False})

#: Lengths of the Panda [m]: height of the shoulder; shoulder to elbow and elbow to wrist along the arm; how far the
#: elbow is beside them; wrist to flange, across; and flange to finger tips.
SHOULDER, UPPER, FORE, BESIDE, WRIST, TIPS = (wp.constant(x) for x in (0.333, 0.316, 0.384, 0.0825, 0.088, 0.2104))
#: Joints of the arm, and with the two fingers.
JOINTS, ALL = wp.constant(7), wp.constant(9)

Angles = wp.types.vector(length=7, dtype=wp.float32)


@wp.func
def angle_between(a: float, b: float, across: float):
    """The angle between two sides of a triangle [rad]."""
    return wp.acos(wp.clamp((a * a + b * b - across * across) / (2.0 * a * b), -1.0, 1.0))


@wp.func
def joint_angles(x: wp.vec3):
    """Joint angles [rad] with which the finger tips are at a place in the frame of the base [m], pointing down, and the
    fingers open along the base's y axis."""
    q = Angles()
    out = wp.length(wp.vec2(x[0], x[1])) - WRIST
    up = x[2] + TIPS - SHOULDER
    upper = wp.length(wp.vec2(UPPER, BESIDE))
    fore = wp.length(wp.vec2(FORE, BESIDE))
    lean_upper = wp.atan2(BESIDE, UPPER)
    lean_fore = wp.atan2(BESIDE, FORE)
    far = wp.length(wp.vec2(out, up))
    q[0] = wp.atan2(x[1], x[0])
    q[1] = wp.atan2(out, up) - angle_between(upper, far, fore) - lean_upper
    q[3] = angle_between(upper, fore, far) - (wp.PI + lean_upper + lean_fore)
    q[5] = q[1] - q[3]
    q[6] = 0.25 * wp.PI + q[0]
    return q


@wp.struct
class Arms:
    """The arms of all worlds, [W], with nine joints each."""

    base: wp.transform  # pose of each base
    thickness: float  # of a finger [m]
    aims: wp.array[wp.vec4]  # wanted middle of the fingers, and distance of their centres [m]
    wanted: wp.array[wp.float32]  # what controllers want of joints [rad], and of fingers [m]
    q: wp.array[wp.float32]  # how joints are
    qd: wp.array[wp.float32]  # and their rates [1/s]


@wp.func
def aim_joints(w: int, arms: Arms, joints: wp.array[wp.float32]):
    """Write joint angles for the aim of an arm."""
    aim = arms.aims[w]
    q = joint_angles(wp.transform_point(wp.transform_inverse(arms.base), wp.vec3(aim[0], aim[1], aim[2])))
    for k in range(JOINTS):
        joints[ALL * w + k] = q[k]
    for k in range(JOINTS, ALL):
        joints[ALL * w + k] = 0.5 * (aim[3] - arms.thickness)


@wp.kernel(enable_backward=False)
def begin_arms(chosen: wp.array[wp.int32], arms: Arms, worlds: Worlds):
    """Put the arms of chosen worlds at rest where their episodes place the fingers."""
    w = wp.tid()
    if chosen[w] == 0:
        return
    a = wp.transform_get_translation(worlds.targets[0, w])
    b = wp.transform_get_translation(worlds.targets[1, w])
    middle = 0.5 * (a + b)
    arms.aims[w] = wp.vec4(middle[0], middle[1], middle[2], b[0] - a[0])
    aim_joints(w, arms, arms.wanted)
    aim_joints(w, arms, arms.q)
    for k in range(ALL):
        arms.qd[ALL * w + k] = 0.0


@wp.kernel(enable_backward=False)
def steer_arms(far: float, low: wp.vec3, high: wp.vec3, narrow: float, wide: float, arms: Arms, worlds: Worlds):
    """Change what controllers want by actions, as ``episodes.steer_fingers`` moves free fingers."""
    w = wp.tid()
    aim = arms.aims[w]
    way = far * wp.vec3(action(worlds, w, 0), action(worlds, w, 1), action(worlds, w, 2))
    x = within(wp.vec3(aim[0], aim[1], aim[2]) + way, low, high)
    arms.aims[w] = wp.vec4(x[0], x[1], x[2], wp.clamp(aim[3] + 2.0 * far * action(worlds, w, 3), narrow, wide))
    aim_joints(w, arms, arms.wanted)


@wp.kernel(enable_backward=False)
def give_wrenches(
    fingers: wp.vec2i, bodies: int, wrenches: wp.array2d[wp.spatial_vector], forces: wp.array[wp.spatial_vector]
):
    """Give the wrenches of contact on tools to the fingers, whose origins are their centres of mass."""
    o, w = wp.tid()
    forces[bodies * w + fingers[o]] = wrenches[o, w]


@wp.kernel(enable_backward=False)
def take_poses(fingers: wp.vec2i, bodies: int, poses: wp.array[wp.transform], targets: wp.array2d[wp.transform]):
    """Take the poses of tools from the fingers."""
    o, w = wp.tid()
    targets[o, w] = poses[bodies * w + fingers[o]]
