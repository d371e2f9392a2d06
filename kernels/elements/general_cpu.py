"""Forces of tetrahedra one by one on the CPU, eight to the lanes of vector registers; see ``simd8``.

For tetrahedra of a forest that are in no complete subtree, a rest matrix is worked out once. An element of which a law
finds no rotation adds nothing and is put on a list, which ``forces.repair_forces`` goes through.
"""

import functools
from typing import Any

import warp as wp

from warp_corot.kernels.modules import unique_kernel

from .constitutive import IsotropicMaterial
from .elements import ForestElements, GeneralElements, frame, gradient_of, rest_volume
from .native_laws import IsotropicLaw, NativeLaw, elastic
from .simd8 import headers, on_cpu, scatter_simd8

wp.set_module_options({"enable_backward": False})


@functools.cache
def scatter_law_elements(law: IsotropicLaw) -> wp.Kernel:
    """Forces of general elements under an isotropic law; a thread is eight of them. Elements left out are listed."""
    of_law = elastic(law)
    call = f"corot::scatter_general({of_law.code}, units, block, count, u, f, missed)"
    return scatter_simd8(call, GeneralElements, IsotropicMaterial, wp.int32, headers("elements8", of_law.header))


@functools.cache
def scatter_listed_elements(Elements: type, Material: type, law: NativeLaw) -> wp.Kernel:
    """The same of elements of either kind under any law, or of those on a list if it is not empty."""
    traversal = "ForestEight" if Elements is ForestElements else "ListableGeneralEight"
    arguments = f"{law.code}, elements, block, count, listed, u, f, missed"

    @wp.func_native(on_cpu(f"corot::scatter_listed<corot::{traversal}>({arguments});"))
    def eight_elements(
        elements: Elements,
        block: int,
        count: int,
        listed: wp.array[wp.int32],
        material: Material,
        u: wp.array[wp.vec4],
        f: wp.array[wp.vec4],
        missed: wp.array[wp.int32],
    ): ...

    @unique_kernel(native=headers("elements8", law.header))
    def scatter_listed_elements(
        # In
        elements: Elements,
        count: int,
        listed: wp.array[wp.int32],
        material: Material,
        u: wp.array[wp.vec4],
        # Out
        f: wp.array[wp.vec4],
        missed: wp.array[wp.int32],
    ):
        eight_elements(elements, wp.tid(), count, listed, material, u, f, missed)

    return scatter_listed_elements


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
