"""Forces of tetrahedra one by one on the CPU, eight to the lanes of vector registers; see ``lanes``.

General tetrahedra, and those of a forest that are in no complete subtree, for which a rest matrix is worked out once.

An element of which the corotated law finds no rotation adds nothing and is put on a list, which ``repair_elements``
goes through.
"""

import functools
from typing import Any

import warp as wp

from warp_corot.kernels.math.rotation import byers_xu

from .constitutive import corotated_strain, hooke
from .elements import ForestElements, GeneralElements, frame, gradient_of, local_gradient, rest_volume, scatter_stress
from .lanes import COMPILER_FLAGS, native, on_cpu
from .law_lanes import LAWS

wp.set_module_options({"enable_backward": False})


def _forces(law: str) -> str:
    leaves_out = ["left_out_elements"] if law == "corotated" else []
    return on_cpu(LAWS[law], native("elements", "isotropic_elements", "element_forces", *leaves_out))


@wp.func_native(_forces("corotated"))
def eight_elements(
    elements: GeneralElements,
    block: int,
    count: int,
    mu: wp.array[wp.float32],
    lam: wp.array[wp.float32],
    stride: int,
    u: wp.array[wp.vec4],
    f: wp.array[wp.vec4],
    left_out: wp.array[wp.int32],
): ...


@wp.kernel(module="unique", enable_backward=False, module_options={"cpu_compiler_flags": COMPILER_FLAGS})
def scatter_elements(
    # In
    elements: GeneralElements,
    mu: wp.array[wp.float32],
    lam: wp.array[wp.float32],
    stride: int,
    count: int,
    u: wp.array[wp.vec4],
    # Out
    f: wp.array[wp.vec4],
    left_out: wp.array[wp.int32],
):
    """Corotated forces, each element with its own rotation; a thread is eight elements."""
    eight_elements(elements, wp.tid(), count, mu, lam, stride, u, f, left_out)


@functools.cache
def scatter_law_elements(law: str) -> wp.Kernel:
    """Forces of a law of ``law_lanes`` that needs no rotation; a thread is eight elements."""

    @wp.func_native(_forces(law))
    def eight_elements(
        elements: GeneralElements,
        block: int,
        count: int,
        mu: wp.array[wp.float32],
        lam: wp.array[wp.float32],
        stride: int,
        u: wp.array[wp.vec4],
        f: wp.array[wp.vec4],
    ): ...

    @wp.kernel(module="unique", enable_backward=False, module_options={"cpu_compiler_flags": COMPILER_FLAGS})
    def scatter_law_elements(
        # In
        elements: GeneralElements,
        mu: wp.array[wp.float32],
        lam: wp.array[wp.float32],
        stride: int,
        count: int,
        u: wp.array[wp.vec4],
        # Out
        f: wp.array[wp.vec4],
    ):
        eight_elements(elements, wp.tid(), count, mu, lam, stride, u, f)

    return scatter_law_elements


@wp.kernel(module="unique", enable_backward=False)
def repair_elements(
    # In
    elements: GeneralElements,
    mu: wp.array[wp.float32],
    lam: wp.array[wp.float32],
    stride: int,
    u: wp.array[wp.vec4],
    # In and out
    left_out: wp.array[wp.int32],
    # Out
    f: wp.array[wp.vec4],
):
    """Forces of the elements on the list, with the rotation that is right for every F, by one thread; empties it."""
    for i in range(left_out[0]):
        t = left_out[i + 1]
        g = local_gradient(elements, t, u)
        q = frame(elements, t)
        r = byers_xu(q + g)
        scatter_stress(elements, t, r * hooke(corotated_strain(g, q, r), mu[t * stride], lam[t * stride]), f)
    left_out[0] = 0


@wp.func
def rest_inverse_of(elements: Any, t: int, turn: wp.mat33):
    """B [3, 3] with G turn = (d1 d2 d3) B, where d are the displacements of the last three nodes from the first."""
    # Linear in them: they enter by their rows, one at a time.
    o = wp.vec3(0.0, 0.0, 0.0)
    x = wp.vec3(1.0, 0.0, 0.0)
    rows = wp.mat33()
    rows[0] = (gradient_of(elements, t, o, x, o, o) * turn)[0]
    rows[1] = (gradient_of(elements, t, o, o, x, o) * turn)[0]
    rows[2] = (gradient_of(elements, t, o, o, o, x) * turn)[0]
    return rows


@wp.kernel(enable_backward=False)
def rest_matrices(
    # In
    elements: ForestElements,
    # Out
    rest_inverse: wp.array[wp.mat33],
    volume: wp.array[wp.float32],
):
    """What general elements keep, of elements of a forest."""
    t = wp.tid()
    rest_inverse[t] = rest_inverse_of(elements, t, wp.transpose(frame(elements, t)))
    volume[t] = rest_volume(elements, t)
