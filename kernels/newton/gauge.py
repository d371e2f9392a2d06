"""Current stiffness of the tetrahedra of a Newton model: ``stepping.gauge`` for positions and rest matrices."""

import warp as wp

from warp_corot.kernels.elements.elements import GeneralElements
from warp_corot.kernels.math.rotation import identity3
from warp_corot.kernels.stepping.gauge import TURNS, keep_largest
from warp_corot.kernels.stepping.pace import GROWTH, LEAST, SAFE, STABLE, STRAIN, safe_step

from .elements import difference_gradient

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def find_posed_strains(
    # In
    elements: GeneralElements,
    q: wp.array[wp.vec3],
    qd: wp.array[wp.vec3],
    ahead: float,
    count: int,
    turn: wp.array[wp.int32],
    # Out
    found: wp.array2d[wp.float32],
):
    """The largest entry of F^T F - I among one in ``TURNS`` elements, now and after ``ahead`` [s] at the current rate;
    the next measurement checks others."""
    t = wp.tid() * TURNS + turn[0] % TURNS
    if t >= count:
        return
    f = difference_gradient(elements, t, q)
    strain = wp.transpose(f) * f - identity3()
    rate = wp.transpose(f) * difference_gradient(elements, t, qd)
    later = strain + ahead * (rate + wp.transpose(rate))
    most = float(0.0)
    for i in range(3):
        for j in range(3):
            most = wp.max(most, wp.max(wp.abs(strain[i, j]), wp.abs(later[i, j])))
    keep_largest(most, STRAIN, found[0])


@wp.kernel(enable_backward=False)
def take_safe_substep(
    # In
    at_rest: wp.array2d[wp.float64],
    recorded: wp.float64,
    # In and out
    found: wp.array2d[wp.float32],
    allowed: wp.array[wp.float64],
    turn: wp.array[wp.int32],
    excess: wp.array[wp.float32],
    # Out
    seen: wp.array[wp.float64],
):
    """Find the substep that is safe until the next measurement [s]: it shrinks at once and grows slowly.

    Args:
        recorded: Length of the substep of a recorded step [s]; zero if the host chooses the next one.
        excess: Largest factor by which a recorded one was too long.
        seen: The safe substep, in the host's memory.
    """
    longest = at_rest[0, SAFE] * at_rest[0, STABLE]
    safe = wp.min(longest, safe_step(at_rest, found, 0))
    safe = wp.min(wp.max(safe, LEAST * longest), GROWTH * allowed[0])
    allowed[0] = safe
    seen[0] = safe
    excess[0] = wp.max(excess[0], float(recorded / safe))
    for k in range(found.shape[1]):
        found[0, k] = 0.0
    turn[0] = (turn[0] + 1) % TURNS
