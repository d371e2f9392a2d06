"""Explicit steps that can be run backwards, and adjoints of steps.

A step of symplectic Euler is v' = c (v + dt (f(u) / m + g)), u' = u + dt v' at free nodes, c = 1 / (1 + dt damping).
Held nodes keep their velocity. From the adjoints u_, v_ of the state after a step, the state before gets
    q = v_ + dt u_,  p = c dt q / m,  v_ <- c q,  u_ <- u_ - K(u) p,
at held nodes p = 0 and v_ <- q. Changes of forces in the step change J by p times them.

Contact: vectors without the normals of contacts. A row is a contact: its normal times the share of each node that
carries it. N has the rows as columns.
"""

import warp as wp

from warp_corot.kernels.elements.elements import add_force, load_node, store_node
from warp_corot.kernels.stepping.integrate import symplectic_euler_velocity
from warp_corot.kernels.stepping.sums import dot64

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def take_explicit_step(
    # In
    dt: float,
    damped: float,
    gravity: wp.vec3,
    inverse_mass: wp.array[wp.float32],
    loads: wp.array[wp.vec4],
    # In and out
    f: wp.array[wp.vec4],
    u: wp.array[wp.vec4],
    v: wp.array[wp.vec4],
):
    i = wp.tid()
    w = inverse_mass[i]
    velocity = load_node(v, i)
    if w > 0.0:
        force = load_node(f, i) + load_node(loads, i)
        velocity = symplectic_euler_velocity(velocity, force, w, gravity, dt, damped)
        store_node(v, i, velocity)
    store_node(u, i, load_node(u, i) + dt * velocity)
    store_node(f, i, wp.vec3())


@wp.kernel(enable_backward=False)
def begin_explicit_adjoint(
    # In
    dt: float,
    damped: float,
    inverse_mass: wp.array[wp.float32],
    of_u: wp.array[wp.vec4],
    # In and out
    of_v: wp.array[wp.vec4],
    of_loads: wp.array[wp.vec4],
    # Out
    p: wp.array[wp.vec4],
):
    i = wp.tid()
    w = inverse_mass[i]
    q = load_node(of_v, i) + dt * load_node(of_u, i)
    motion = wp.vec3()
    if w > 0.0:
        q = damped * q
        motion = (dt * w) * q
    store_node(of_v, i, q)
    store_node(p, i, motion)
    store_node(of_loads, i, load_node(of_loads, i) + motion)


@wp.kernel(enable_backward=False)
def add_of_mass(
    # In
    inverse_mass: wp.array[wp.float32],
    f: wp.array[wp.vec4],
    loads: wp.array[wp.vec4],
    p: wp.array[wp.vec4],
    # In and out
    of_mass: wp.array[wp.float64],
):
    """Add the derivative with respect to mass, by which a step divides forces."""
    i = wp.tid()
    force = load_node(f, i) + load_node(loads, i)
    of_mass[i] = of_mass[i] - wp.float64(inverse_mass[i] * wp.dot(force, load_node(p, i)))


# --- contact ---------------------------------------------------------------------------------------------------------


@wp.struct
class Rows:
    """Entries of N at free nodes.

    Attributes:
        row, node, part: The row and the node of each entry, and the normal times the node's share.
        inverse: The inverse of N^T N, float64 [m, m].
    """

    row: wp.array[wp.int32]
    node: wp.array[wp.int32]
    part: wp.array[wp.vec3]
    inverse: wp.array2d[wp.float64]


@wp.kernel(enable_backward=False)
def measure_rows(rows: Rows, x: wp.array[wp.vec4], along: wp.array[wp.float64]):
    """Add N^T x."""
    k = wp.tid()
    wp.atomic_add(along, rows.row[k], dot64(rows.part[k], load_node(x, rows.node[k])))


@wp.kernel(enable_backward=False)
def share_rows(rows: Rows, along: wp.array[wp.float64], shared: wp.array[wp.float64]):
    """(N^T N)^-1 times what rows measured."""
    i = wp.tid()
    total = wp.float64(0.0)
    for j in range(along.shape[0]):
        total += rows.inverse[i, j] * along[j]
    shared[i] = total


@wp.kernel(enable_backward=False)
def remove_rows(rows: Rows, shared: wp.array[wp.float64], x: wp.array[wp.vec4]):
    """x - N times the rows' shares."""
    k = wp.tid()
    add_force(x, rows.node[k], -float(shared[rows.row[k]]) * rows.part[k])
