"""Inverted elements: signs of loads that a body cannot carry."""

import functools
from typing import Any

import warp as wp

from warp_corot.kernels.elements.elements import frame, local_gradient
from warp_corot.kernels.modules import unique_kernel

from .motion import Surface
from .watch import CRUSHED, Near, Watch

wp.set_module_options({"enable_backward": False})

#: The surface of elements below this volume ratio ignores contact with its own body.
FLAT = wp.constant(0.25)


@wp.func
def volume_ratio(elements: Any, t: int, u: wp.array[wp.vec4]):
    """det F."""
    q = frame(elements, t)
    return wp.determinant(q + local_gradient(elements, t, u)) * wp.determinant(q)


@functools.cache
def count_crushed(Elements: type) -> wp.Kernel:
    """Count elements with det F < 0 among all elements, or among those that are nonzero in ``counted``."""

    @unique_kernel()
    def count_crushed(elements: Elements, u: wp.array[wp.vec4], counted: wp.array[wp.int32], count: wp.array[wp.int32]):
        t = wp.tid()
        if counted.shape[0] > 0 and counted[t] == 0:
            return
        if volume_ratio(elements, t, u) < 0.0:
            wp.atomic_add(count, 0, 1)

    return count_crushed


@functools.cache
def mark_crushed(Elements: type) -> wp.Kernel:
    """Mark the surface at elements that are inverted or nearly so; ``places`` maps nodes to places, or to places among
    bearers, [nodes]."""

    @unique_kernel()
    def mark_crushed(
        watch: Watch,
        elements: Elements,
        u: wp.array[wp.vec4],
        places: wp.array[wp.int32],
        are_borne: int,
        surface: Surface,
        near: Near,
    ):
        t = wp.tid()
        if watch.due[0] == 0:
            return
        if volume_ratio(elements, t, u) < FLAT:
            nodes = elements.nodes[t]
            for k in range(4):
                place = places[nodes[k]]
                if place >= 0 and are_borne == 0:
                    wp.atomic_or(near.flags, place, CRUSHED)
                elif place >= 0:
                    for m in range(surface.bearing.starts[place], surface.bearing.starts[place + 1]):
                        wp.atomic_or(near.flags, surface.bearing.places[m], CRUSHED)

    return mark_crushed
