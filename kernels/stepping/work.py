"""The work of forces besides elasticity, so that the balance of energy knows what they put in or take out."""

from typing import Any

import warp as wp

from warp_corot.kernels.elements.elements import load_node, store_node

from .integrate import by_vectors, symplectic_euler_velocity, vector_at
from .pace import DT, Pace, length_before

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def separate_forces(elastic: wp.array[wp.vec4], f: wp.array[wp.vec4], others: wp.array[wp.vec4]):
    """What has been added since the elastic forces."""
    i = wp.tid()
    store_node(others, i, load_node(f, i) - load_node(elastic, i))


@wp.kernel(enable_backward=False)
def count_work(
    # In
    damping: float,
    gravity: wp.vec3,
    inverse_mass: wp.array[wp.float32],
    has_load: int,
    load: wp.array[Any],
    pace: Pace,
    offset: int,
    elastic: wp.array[wp.vec4],
    f: wp.array[wp.vec4],
    v: wp.array[wp.vec4],
    # In and out
    others: wp.array[wp.vec4],
    account: wp.array2d[wp.float64],
):
    """Each force works along half of the motion before and half of the motion after it, as symplectic Euler keeps
    energy. What is left in ``others`` is all that acted besides elasticity, constraints among it."""
    i = wp.tid()
    force = load_node(others, i)
    total = load_node(f, i)
    store_node(others, i, total - load_node(elastic, i))
    w = inverse_mass[i]
    if w == 0.0 or wp.dot(force, force) == 0.0:
        return
    dt = float(pace.seconds[DT])
    before = dt
    if offset == 0:
        before = float(length_before(pace))
    if has_load != 0:
        total += vector_at(load, i)
    velocity = load_node(v, i)
    later = symplectic_euler_velocity(velocity, total, w, gravity, 0.5 * (before + dt), 1.0 / (1.0 + dt * damping))
    work = wp.float64(0.5 * wp.dot(force, before * velocity + dt * later))
    account[0, i] = account[0, i] + work
    account[1, i] = account[1, i] + wp.abs(work)


COUNT_WORK = by_vectors(count_work, "load")
