"""Hands: springs between places that a person moves and points of a shown surface, which is bound to a body's nodes.

One thread a hand loops over its patch. So the cost depends on the patch only, sums have one order, and force, place and
work are known in the same launch. Patches are small, and there are few hands.
"""

import warp as wp

from warp_corot.kernels.elements.elements import load_node
from warp_corot.kernels.stepping.pace import DT, Pace, length_before

wp.set_module_options({"enable_backward": False})


@wp.struct
class Spring:
    """The spring of a hand.

    Attributes:
        motion: How far the hand has moved since it took hold [m].
        stiffness: Of the whole patch [N/m].
        damping: The same [N s/m].
        limit: The largest force [N].
        rigid: Whether the hand holds every point at its place relative to the hand; otherwise it holds only their mean.
        count: Points of the patch; 0 while the hand holds nothing.
    """

    motion: wp.vec3
    stiffness: float
    damping: float
    limit: float
    rigid: int
    count: int


@wp.func
def at_point(values: wp.array[wp.vec4], nodes: wp.vec4i, weights: wp.vec4):
    """Nodal vectors at a point that is bound to four nodes."""
    return (
        weights[0] * load_node(values, nodes[0])
        + weights[1] * load_node(values, nodes[1])
        + weights[2] * load_node(values, nodes[2])
        + weights[3] * load_node(values, nodes[3])
    )


@wp.func
def spring_force(spring: Spring, stretch: wp.vec3, velocity: wp.vec3):
    """k stretch - c velocity, no larger than the limit [N]."""
    force = spring.stiffness * stretch - spring.damping * velocity
    size = wp.length(force)
    if size > spring.limit:
        force *= spring.limit / size
    return force


@wp.func
def add_force(forces: wp.array[wp.vec4], nodes: wp.vec4i, weights: wp.vec4, force: wp.vec3):
    for n in range(4):
        wp.atomic_add(forces, nodes[n], weights[n] * wp.vec4(force[0], force[1], force[2], 0.0))


@wp.func
def squared_force(
    forces: wp.array[wp.vec4],
    nodes: wp.vec4i,
    parts: wp.vec4,
    inverse_mass: wp.array[wp.float32],
    gravity: wp.vec3,
):
    """Squares of the forces on nodes over their masses [N^2/kg], weighted by each node's part; loads are left out."""
    total = float(0.0)
    for n in range(4):
        w = inverse_mass[nodes[n]]
        if w > 0.0:
            force = load_node(forces, nodes[n]) + gravity / w
            total += parts[n] * w * wp.dot(force, force)
    return total


@wp.func
def change_of_step(before: float, dt: float):
    """What the square of a force on a mass adds to kinetic energy where steps change [s^2]: that is of half of the next
    step behind displacements times half of it ahead, as ``stepping.balance`` has it."""
    return 0.125 * (before * before - dt * dt)


@wp.kernel(enable_backward=False)
def take_hold(
    # In
    patch: wp.array[wp.int32],
    nodes: wp.array[wp.vec4i],
    weights: wp.array[wp.vec4],
    u: wp.array[wp.vec4],
    # Out
    start: wp.array[wp.vec3],
):
    """Remember the displacements of the points of a patch [m]."""
    i = wp.tid()
    start[i] = at_point(u, nodes[patch[i]], weights[patch[i]])


@wp.kernel(enable_backward=False)
def pull(
    # In
    springs: wp.array[Spring],
    patches: wp.array2d[wp.int32],
    shares: wp.array2d[wp.float32],
    starts: wp.array2d[wp.vec3],
    parts: wp.array2d[wp.vec4],
    nodes: wp.array[wp.vec4i],
    weights: wp.array[wp.vec4],
    pace: Pace,
    offset: int,
    gravity: wp.vec3,
    inverse_mass: wp.array[wp.float32],
    u: wp.array[wp.vec4],
    v: wp.array[wp.vec4],
    # In and out
    last: wp.array2d[wp.vec3],
    counted: wp.array[wp.float32],
    f: wp.array[wp.vec4],
    # Out
    found: wp.array2d[wp.vec3],
    work: wp.array[wp.float64],
):
    """Add the forces of all hands to the nodes.

    ``found`` is each hand's force on the body [N] and the mean displacement of its patch [m]. ``last`` keeps the force
    of each point in the step before: its work is that of the trapezoidal rule, half with the motion before it and
    half, found a step later, with the motion after it. ``offset`` is this step's place in a run of recorded ones.

    Where the length of steps changes, the forces on the nodes change the kinetic energy by definition. That is work,
    too, less the amount ``counted`` at the last check of energies, without this hand's force. ``parts`` are one over
    the number of times that the patch names each node.
    """
    hand = wp.tid()
    spring = springs[hand]
    mean = wp.vec3(0.0)
    velocity = wp.vec3(0.0)
    start = wp.vec3(0.0)
    for k in range(spring.count):
        point = patches[hand, k]
        mean += shares[hand, k] * at_point(u, nodes[point], weights[point])
        velocity += shares[hand, k] * at_point(v, nodes[point], weights[point])
        start += shares[hand, k] * starts[hand, k]
    common = spring_force(spring, start + spring.motion - mean, velocity)
    total = wp.vec3(0.0)
    dt = float(pace.seconds[DT])
    before = dt
    if offset == 0:
        before = float(length_before(pace))
    change = change_of_step(before, dt)
    known = counted[hand]
    counted[hand] = 0.0
    done = wp.float64(0.0)
    for k in range(spring.count):
        point = patches[hand, k]
        if known != 0.0:
            done -= wp.float64(known * squared_force(f, nodes[point], parts[hand, k], inverse_mass, gravity))
    for k in range(spring.count):
        point = patches[hand, k]
        moving = at_point(v, nodes[point], weights[point])
        force = common
        if spring.rigid != 0:
            stretch = starts[hand, k] + spring.motion - at_point(u, nodes[point], weights[point])
            force = spring_force(spring, stretch, moving)
        force *= shares[hand, k]
        done += wp.float64(0.5 * before * wp.dot(last[hand, k] + force, moving))
        last[hand, k] = force
        total += force
        add_force(f, nodes[point], weights[point], force)
    for k in range(spring.count):
        point = patches[hand, k]
        if change != 0.0:
            done += wp.float64(change * squared_force(f, nodes[point], parts[hand, k], inverse_mass, gravity))
    found[hand, 0] = total
    found[hand, 1] = mean
    if done != wp.float64(0.0):
        wp.atomic_add(work, 0, done)
        wp.atomic_add(work, 1, wp.abs(done))


@wp.kernel(enable_backward=False)
def complete_work(
    # In
    springs: wp.array[Spring],
    patches: wp.array2d[wp.int32],
    nodes: wp.array[wp.vec4i],
    weights: wp.array[wp.vec4],
    pace: Pace,
    v: wp.array[wp.vec4],
    # In and out
    last: wp.array2d[wp.vec3],
    # Out
    counted: wp.array[wp.float32],
    work: wp.array[wp.float64],
):
    """Count the second half of the last forces' work, which goes with the motion after them."""
    hand = wp.tid()
    done = wp.float64(0.0)
    after = 0.5 * float(length_before(pace))
    for k in range(springs[hand].count):
        point = patches[hand, k]
        done += wp.float64(after * wp.dot(last[hand, k], at_point(v, nodes[point], weights[point])))
        last[hand, k] = wp.vec3(0.0)
    counted[hand] = change_of_step(float(length_before(pace)), float(pace.seconds[DT]))
    if done != wp.float64(0.0):
        wp.atomic_add(work, 0, done)
        wp.atomic_add(work, 1, wp.abs(done))
