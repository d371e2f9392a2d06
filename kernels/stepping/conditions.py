"""Changes that users make to nodes between steps: hold, release and load them. A launch has one thread for each node of
the patch.

If there are fewer values than nodes, they are repeated: one value for all nodes, or the values of one world for every
world.
"""

from typing import Any

import warp as wp

from warp_corot.kernels.elements.elements import store_node
from warp_corot.kernels.stepping.integrate import by_vectors, write_vector
from warp_corot.kernels.stepping.pace import Pace, key_before, time_after

wp.set_module_options({"enable_backward": False})


@wp.func
def inverse_of(mass: float):
    """The inverse mass of a free node, 1/m, or zero if it has no mass [1/kg]."""
    if mass > 0.0:
        return float(wp.float64(1.0) / wp.float64(mass))
    return float(0.0)


@wp.kernel(enable_backward=False)
def free_nodes(
    # In
    mass: wp.array[wp.float32],
    held: wp.array[wp.uint8],
    # Out
    inverse_mass: wp.array[wp.float32],
):
    """Give every free node its inverse mass, and held nodes zero."""
    i = wp.tid()
    inverse = float(0.0)
    if held[i] == wp.uint8(0):
        inverse = inverse_of(mass[i])
    inverse_mass[i] = inverse


@wp.kernel(enable_backward=False)
def hold_nodes(
    # In
    nodes: wp.array[wp.int32],
    velocities: wp.array[wp.vec3],
    # Out
    held: wp.array[wp.uint8],
    inverse_mass: wp.array[wp.float32],
    v: wp.array[wp.vec4],
):
    """Hold nodes; they move with the given velocities [m/s]. With zero they stay where they are."""
    k = wp.tid()
    i = nodes[k]
    held[i] = wp.uint8(1)
    inverse_mass[i] = 0.0
    store_node(v, i, velocities[k % velocities.shape[0]])


@wp.kernel(enable_backward=False)
def release_nodes(
    # In
    nodes: wp.array[wp.int32],
    mass: wp.array[wp.float32],
    # Out
    held: wp.array[wp.uint8],
    inverse_mass: wp.array[wp.float32],
    reactions: wp.array[wp.vec4],
):
    """Release nodes; they keep their present velocities."""
    i = nodes[wp.tid()]
    held[i] = wp.uint8(0)
    inverse_mass[i] = inverse_of(mass[i])
    store_node(reactions, i, wp.vec3())


@wp.kernel(enable_backward=False)
def load_nodes(
    # In
    nodes: wp.array[wp.int32],
    forces: wp.array[wp.vec3],
    # Out
    loads: wp.array[Any],
):
    """Set the loads of nodes [N]."""
    k = wp.tid()
    write_vector(loads, nodes[k], forces[k % forces.shape[0]])


LOAD_NODES = by_vectors(load_nodes, "loads")


# --- active stress that follows keyframes ----------------------------------------------------------------------------


@wp.kernel(enable_backward=False)
def follow_activation(
    # In
    elements: wp.array[wp.int32],
    times: wp.array[wp.float64],
    stress: wp.array2d[wp.float32],
    pace: Pace,
    world_starts: wp.array[wp.float64],
    world_element_count: int,
    offset: int,
    # Out
    activation: wp.array[wp.float32],
):
    """Set the active stress [Pa] to the keyframes' value at the beginning of a step, ``offset`` steps after the last
    counted one.
    """
    k = wp.tid()
    t = elements[k]
    start = world_starts[t // world_element_count]
    now = time_after(pace, offset) - start
    key, s = key_before(times, now)
    row = wp.min(k, stress.shape[1] - 1)
    a = stress[key, row]
    activation[t] = a + s * (stress[key + 1, row] - a)
