"""The work of forces other than elastic ones, for the balance of energy.

``integrate.add_support_work`` counts the work of a support against all forces on its nodes. The part against forces
that are not elastic is subtracted here, because the balance has no energy for them.
"""

import warp as wp

from warp_corot.kernels.elements.elements import load_node, store_node

from .integrate import Dynamics, force_at, symplectic_euler_velocity
from .pace import DT, Pace, length_before

wp.set_module_options({"enable_backward": False})


@wp.func
def add_work(account: wp.array2d[wp.float64], i: int, work: float):
    account[0, i] = account[0, i] + wp.float64(work)
    account[1, i] = account[1, i] + wp.abs(wp.float64(work))


@wp.kernel(enable_backward=False)
def separate_forces(elastic: wp.array[wp.vec4], f: wp.array[wp.vec4], others: wp.array[wp.vec4]):
    """Find the forces that were added after the elastic ones."""
    i = wp.tid()
    store_node(others, i, load_node(f, i) - load_node(elastic, i))


@wp.kernel(enable_backward=False)
def count_work(
    # In
    body: Dynamics,
    pace: Pace,
    offset: int,
    elastic: wp.array[wp.vec4],
    # In and out
    others: wp.array[wp.vec4],
    account: wp.array2d[wp.float64],
):
    """Count the work of the other forces, each along half of the motion before it and half of the motion after it.

    That is how symplectic Euler conserves energy. Afterwards ``others`` has all forces besides elasticity, constraints
    included.
    """
    i = wp.tid()
    force = load_node(others, i)
    store_node(others, i, load_node(body.f, i) - load_node(elastic, i))
    if wp.dot(force, force) == 0.0:
        return
    dt = float(pace.seconds[DT])
    before = dt
    if offset == 0:
        before = float(length_before(pace))
    w, velocity = body.inverse_mass[i], load_node(body.v, i)
    later = velocity
    if w > 0.0:
        kick, damped = 0.5 * (before + dt), 1.0 / (1.0 + dt * body.damping)
        later = symplectic_euler_velocity(velocity, force_at(i, body), w, body.gravity, kick, damped)
    add_work(account, i, 0.5 * wp.dot(force, before * velocity + dt * later))


@wp.func
def count_constraint(
    i: int,
    force: wp.vec3,
    all_forces: wp.vec3,
    velocity: wp.vec3,
    damping: float,
    gravity: wp.vec3,
    w: float,
    pace: Pace,
    offset: int,
    account: wp.array2d[wp.float64],
):
    """Count the work of the force C of constraints on a node, which is part of all its forces but gravity.

    Let b and d be the lengths of the last step and of this one, and v and w the velocities before and after the kick.
    Let F be all other forces: elastic ones, gravity and loads. All forces act for (b + d) / 2, so they add the kinetic
    energy (b + d) / 2 (F + C) . (v + w) / 2. The work of F is counted elsewhere, along half of the motion before and
    half of the motion after: F . (b v + d w) / 2. Constraints decide where a node goes, so the rest is their work:
    (b + d) / 2 C . (v + w) / 2 + (b - d) / 4 F . (w - v).
    """
    dt = float(pace.seconds[DT])
    before = dt
    if offset == 0:
        before = float(length_before(pace))
    kick = 0.5 * (before + dt)
    if w == 0.0:
        add_work(account, i, kick * wp.dot(force, velocity))
        return
    later = symplectic_euler_velocity(velocity, all_forces, w, gravity, kick, 1.0 / (1.0 + dt * damping))
    others = all_forces - force + gravity / w
    work = 0.5 * kick * wp.dot(force, velocity + later)
    add_work(account, i, work + 0.25 * (before - dt) * wp.dot(others, later - velocity))


@wp.kernel(enable_backward=False)
def count_constraints(
    # In
    body: Dynamics,
    pace: Pace,
    offset: int,
    constrained: wp.array[wp.vec4],
    # In and out
    account: wp.array2d[wp.float64],
):
    """Count the work of the forces of constraints, which are part of f."""
    i = wp.tid()
    force = load_node(constrained, i)
    if wp.dot(force, force) == 0.0:
        return
    velocity, w = load_node(body.v, i), body.inverse_mass[i]
    count_constraint(i, force, force_at(i, body), velocity, body.damping, body.gravity, w, pace, offset, account)
