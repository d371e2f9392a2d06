"""Places of contact between nodes, such as points of an organ's own surface: the nodes around a place bear it.

A place moves as the weighted mean of its bearers, and they divide its force in the same proportion, so that forces,
torques and work are those of the place. Places that share a bearer move together: each force moves all of them.
"""

from typing import Any

import warp as wp

from .motion import Surface

wp.set_module_options({"enable_backward": False})


@wp.func
def is_borne(s: int, surface: Surface):
    # Without borne places nothing more is loaded than without this module.
    if surface.bearing.bearers.shape[0] == 0:
        return False
    return surface.bearing.bearers[s][0] >= 0


@wp.func
def loose_share(s: int, surface: Surface):
    """The share of a place's weights that free nodes have."""
    if is_borne(s, surface):
        return surface.bearing.loose[s]
    return 1.0


@wp.func
def forget_forces(s: int, surface: Surface):
    """Nothing has been gathered at a place."""
    if is_borne(s, surface):
        surface.bearing.gathered[s] = wp.vec3()


@wp.func
def share_bearers(s: int, r: int, surface: Surface):
    """Whether a node bears both of two places, which are then as near each other as two nodes of an element."""
    if not is_borne(s, surface) or not is_borne(r, surface):
        return False
    b = surface.bearing.bearers[s]
    c = surface.bearing.bearers[r]
    v = surface.bearing.weights[s]
    w = surface.bearing.weights[r]
    for k in range(4):
        for m in range(4):
            if b[k] == c[m] and v[k] != 0.0 and w[m] != 0.0:
                return True
    return False


@wp.func
def ease(s: int, crowd: wp.array[Any], yielding: wp.array[wp.float32], surface: Surface):
    """How far a place moves for each unit of force if all places around it are pushed in proportion to ``crowd``
    [m/N].

    Args:
        crowd: The sum of the weights of contacts that push at each place.
        yielding: As in ``Surface``, also for nodes that another process moves.
    """
    if not is_borne(s, surface):
        return float(crowd[s]) * yielding[s]
    b = surface.bearing.bearers[s]
    w = surface.bearing.weights[s]
    total = float(0.0)
    for k in range(4):
        if w[k] != 0.0:
            pushed = float(0.0)
            for m in range(surface.bearing.starts[b[k]], surface.bearing.starts[b[k] + 1]):
                pushed += wp.abs(surface.bearing.shares[m]) * float(crowd[surface.bearing.places[m]])
            total += wp.abs(w[k]) * surface.bearing.yielding[b[k]] * pushed
    return total


@wp.func
def give_way(s: int, surface: Surface):
    """Move a borne place by the forces at all places that were gathered since the last time."""
    b = surface.bearing.bearers[s]
    w = surface.bearing.weights[s]
    d = wp.vec3()
    for k in range(4):
        if w[k] != 0.0:
            force = wp.vec3()
            for m in range(surface.bearing.starts[b[k]], surface.bearing.starts[b[k] + 1]):
                force += surface.bearing.shares[m] * surface.bearing.gathered[surface.bearing.places[m]]
            d += (w[k] * surface.bearing.yielding[b[k]]) * force
    surface.d[s] = surface.d[s] + d


@wp.kernel(enable_backward=False)
def place_borne(start: int, bearers: Surface, surface: Surface):
    """Find the positions of borne places of a body, and their motion in this step without contact."""
    s = start + wp.tid()
    surface.f[s] = wp.vec3()
    surface.yielding[s] = 0.0
    if surface.node[s] < 0:
        return
    b = surface.bearing.bearers[s]
    w = surface.bearing.weights[s]
    rest = wp.vec3()
    x = wp.vec3()
    d = wp.vec3()
    yielding = float(0.0)
    loose = float(0.0)
    for k in range(4):
        if w[k] != 0.0:
            rest += w[k] * bearers.rest[b[k]]
            x += w[k] * bearers.x[b[k]]
            d += w[k] * bearers.d[b[k]]
            yielding += w[k] * w[k] * bearers.yielding[b[k]]
            if bearers.yielding[b[k]] > 0.0:
                loose += w[k]
    surface.rest[s] = rest
    surface.x[s] = x
    surface.d[s] = d
    surface.yielding[s] = yielding
    surface.bearing.loose[s] = wp.clamp(loose, 0.0, 1.0)


@wp.kernel(enable_backward=False)
def divide_forces(start: int, surface: Surface, bearers: Surface):
    """Sum the forces that a body's bearers get from the places that they bear, in a fixed order."""
    b = start + wp.tid()
    force = wp.vec3()
    for m in range(surface.bearing.starts[b], surface.bearing.starts[b + 1]):
        force += surface.bearing.shares[m] * surface.f[surface.bearing.places[m]]
    bearers.f[b] = force
