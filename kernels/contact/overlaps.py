"""Distances of points from obstacles at the start."""

import warp as wp

from .motion import Motions
from .shapes import Shapes, distance_to

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def find_gaps(
    # In
    shapes: Shapes,
    motions: Motions,
    world: int,
    points: wp.array[wp.vec3],
    most: float,
    # Out
    gaps: wp.array2d[wp.float32],
):
    """Find distances [O, n] of points from the obstacles of a world [m], negative inside. Distances beyond
    ``most`` are only known to be larger than it.
    """
    o, i = wp.tid()
    gap, _normal = distance_to(shapes, o, motions.later[world, o], points[i], most)
    gaps[o, i] = gap
