"""Sums of energies, world by world, in float64 and in a settled order."""

from typing import Any

import warp as wp

from .elements import load_node
from .integrate import by_vectors, vector_at
from .pace import DT, Pace

wp.set_module_options({"enable_backward": False})

#: Columns of ``sums``.
KINETIC, AHEAD, GRAVITATIONAL, LOADS, SUPPORTS, REACH, ELASTIC, UNTIMELY = (wp.constant(k) for k in range(8))
COLUMNS = 8


@wp.func
def dot64(a: wp.vec3, b: wp.vec3):
    return (
        wp.float64(a[0]) * wp.float64(b[0]) + wp.float64(a[1]) * wp.float64(b[1]) + wp.float64(a[2]) * wp.float64(b[2])
    )


@wp.kernel(enable_backward=False)
def sum_nodes(
    # In
    pace: Pace,
    gravity: wp.vec3,
    count: int,
    mass: wp.array[wp.float32],
    inverse_mass: wp.array[wp.float32],
    has_load: int,
    load: wp.array[Any],
    f: wp.array[wp.vec4],
    u: wp.array[wp.vec4],
    u_before: wp.array[wp.vec4],
    v: wp.array[wp.vec4],
    # In and out
    sums: wp.array3d[wp.float64],
):
    """Add what free nodes have: kinetic and gravitational energy, the work of loads since ``u_before``, the farthest.

    Velocities are half a step behind displacements. With the elastic forces f of these displacements, velocities half a
    step ahead are known too, and v_behind . M v_ahead / 2, kinetic energy and ``AHEAD``, is what symplectic Euler keeps
    exactly with the elastic energy where forces are linear: also beyond the stable step, where it need not be positive.
    The work of supports that ``add_support_work`` has added up counts half of f's share too early; that half is
    ``SUPPORTS``. Velocities at the time of the displacements, halfway, have ``UNTIMELY`` more than that product.
    """
    world, part = wp.tid()
    kinetic = wp.float64(0.0)
    ahead = wp.float64(0.0)
    gravitational = wp.float64(0.0)
    work = wp.float64(0.0)
    supports = wp.float64(0.0)
    untimely = wp.float64(0.0)
    reach = wp.float64(0.0)
    k = part
    while k < count:
        i = world * count + k
        x = load_node(u, i)
        reach = wp.max(reach, wp.sqrt(dot64(x, x)))
        velocity = load_node(v, i)
        force = load_node(f, i)
        if inverse_mass[i] == 0.0:
            supports -= wp.float64(0.5) * pace.seconds[DT] * dot64(force, velocity)
        else:
            m = wp.float64(mass[i])
            pull = wp.vec3d(force) + m * wp.vec3d(gravity)
            power = dot64(force, velocity) + m * dot64(gravity, velocity)
            if has_load != 0:
                external = vector_at(load, i)
                pull += wp.vec3d(external)
                power += dot64(external, velocity)
                work += dot64(external, x) - dot64(external, load_node(u_before, i))
            ahead += wp.float64(0.5) * pace.seconds[DT] * power
            untimely += wp.dot(pull, pull) / m
            kinetic += wp.float64(0.5) * m * dot64(velocity, velocity)
            gravitational -= m * dot64(gravity, x)
        k += sums.shape[1]
    sums[world, part, KINETIC] = sums[world, part, KINETIC] + kinetic
    sums[world, part, AHEAD] = sums[world, part, AHEAD] + ahead
    sums[world, part, GRAVITATIONAL] = sums[world, part, GRAVITATIONAL] + gravitational
    sums[world, part, LOADS] = sums[world, part, LOADS] + work
    sums[world, part, SUPPORTS] = sums[world, part, SUPPORTS] + supports
    untimely *= wp.float64(0.125) * pace.seconds[DT] * pace.seconds[DT]
    sums[world, part, UNTIMELY] = sums[world, part, UNTIMELY] + untimely
    sums[world, part, REACH] = wp.max(sums[world, part, REACH], reach)


@wp.kernel(enable_backward=False)
def sum_elements(energies: wp.array[wp.float64], count: int, sums: wp.array3d[wp.float64]):
    """Add strain energies, ``count`` of each world."""
    world, part = wp.tid()
    total = wp.float64(0.0)
    k = part
    while k < count:
        total += energies[world * count + k]
        k += sums.shape[1]
    sums[world, part, ELASTIC] = sums[world, part, ELASTIC] + total


@wp.kernel(enable_backward=False)
def find_changes(
    inverse_mass: wp.array[wp.float32],
    inverse_mass_kept: wp.array[wp.float32],
    u: wp.array[wp.vec4],
    u_kept: wp.array[wp.vec4],
    v: wp.array[wp.vec4],
    v_kept: wp.array[wp.vec4],
    changed: wp.array[wp.int32],
):
    """Whether a state differs from the one that was kept."""
    i = wp.tid()
    du = load_node(u, i) - load_node(u_kept, i)
    dv = load_node(v, i) - load_node(v_kept, i)
    if wp.dot(du, du) + wp.dot(dv, dv) != 0.0 or inverse_mass[i] != inverse_mass_kept[i]:
        changed[0] = 1


SUM_NODES = by_vectors(sum_nodes, "load")
