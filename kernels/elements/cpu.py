"""Forces of tetrahedra one by one on the CPU, eight to the lanes of vector registers; see ``simd8``.

For tetrahedra of a forest that are in no complete subtree, a rest matrix is worked out once. An element of which a law
finds no rotation adds nothing and is put on a list, which ``forces.repair_forces`` goes through.
"""

import functools
from typing import Any

import warp as wp

from warp_corot.kernels.elements.constitutive import IsotropicMaterial
from warp_corot.kernels.elements.dilatation import MOST, Dilatation
from warp_corot.kernels.elements.elements import ForestElements, GeneralElements, frame, gradient_of, rest_volume
from warp_corot.kernels.elements.simd8 import IsotropicLaw, NativeLaw, elastic, headers, scatter_simd8
from warp_corot.kernels.modules import unique_kernel

wp.set_module_options({"enable_backward": False})


@functools.cache
def scatter_elements(law: NativeLaw, Material: type) -> wp.Kernel:
    """Forces of general elements under a law; a thread is eight of them. Elements left out are listed by their numbers
    in the mesh."""
    call = f"corot::scatter_general({law.code}, units, block, count, u, f, missed)"
    return scatter_simd8(call, GeneralElements, Material, wp.int32, headers("elements8", law.header))


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


# --- groups that share a dilatation ----------------------------------------------------------------------------------
#
# A dilatation that groups of elements share, on the CPU, eight elements to the lanes of vector registers.
#
# Elements stand group after group, and one launch computes the law and the shared dilatation: a thread takes a few
# groups.


#: Groups of a thread.
GROUPS = 4


@wp.struct
class GroupedMaterial:
    """A material whose lambda groups of elements share, and the groups: ``isotropic`` has no lambda."""

    isotropic: IsotropicMaterial
    lam: wp.array[wp.float32]
    starts: wp.array[wp.int32]  # [groups + 1] the first element of each group
    live: wp.array[wp.int32]  # [1] how many groups there are; empty: all


@functools.cache
def scatter_grouped_elements(law: IsotropicLaw, of: Dilatation) -> wp.Kernel:
    """Forces of a law of ``simd8`` with a shared dilatation; a thread is ``GROUPS`` groups.

    The corotated law lists what it leaves out.
    """
    of_law, kind = elastic(law, "material.isotropic"), f"corot::{of.lanes}, {GROUPS}, {MOST}"
    call = f"corot::scatter_groups<{kind}>({of_law.code}, units, block, count, material, u, f, missed)"
    return scatter_simd8(call, GeneralElements, GroupedMaterial, wp.int32, headers("groups8", of_law.header))


@functools.cache
def order_elements(Elements: type) -> wp.Kernel:
    """Puts elements in the order of their groups, which is that of their numbers."""

    @unique_kernel()
    def order_elements(
        # In
        elements: Elements,
        starts: wp.array[wp.int32],
        live: wp.array[wp.int32],
        # In and out
        general: GeneralElements,
    ):
        k = wp.tid()
        if live.shape[0] > 0 and k >= starts[live[0]]:
            return
        t = general.numbers[k]
        general.nodes[k] = elements.nodes[t]
        general.rest_inverse[k] = rest_inverse_of(elements, t, wp.transpose(frame(elements, t)))
        general.volume[k] = rest_volume(elements, t)

    return order_elements
