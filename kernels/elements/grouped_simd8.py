"""A dilatation that groups of elements share, on the CPU, eight elements to the lanes of vector registers.

Elements stand group after group, and one launch computes the law and the shared dilatation: a thread takes a few
groups.
"""

import functools

import warp as wp

from warp_corot.kernels.modules import unique_kernel

from .constitutive import IsotropicMaterial
from .dilatation import MOST, Dilatation
from .elements import GeneralElements, frame, rest_volume
from .general_cpu import rest_inverse_of
from .native_laws import IsotropicLaw, elastic
from .simd8 import headers, scatter_simd8

wp.set_module_options({"enable_backward": False})


#: Groups of a thread.
GROUPS = 4


@wp.struct
class GroupedMaterial:
    """Elements group after group, and their material, whose lambda the groups share: ``isotropic`` has none."""

    isotropic: IsotropicMaterial
    lam: wp.array[wp.float32]
    starts: wp.array[wp.int32]  # [groups + 1] the first element of each group
    live: wp.array[wp.int32]  # [1] how many groups there are; empty: all


@functools.cache
def scatter_grouped_elements(law: IsotropicLaw, of: Dilatation) -> wp.Kernel:
    """Forces of a law of ``native_laws`` with a shared dilatation; a thread is ``GROUPS`` groups.

    The corotated law lists what it leaves out.
    """
    of_law, kind = elastic(law, "material.isotropic"), f"corot::{of.lanes}, {GROUPS}, {MOST}"
    call = f"corot::scatter_groups<{kind}>({of_law.code}, units, block, count, material, u, f, missed)"
    return scatter_simd8(call, GeneralElements, GroupedMaterial, wp.int32, headers("groups8", of_law.header))


@functools.cache
def order_elements(Elements: type) -> wp.Kernel:
    """Puts elements in the order of their groups."""

    @unique_kernel()
    def order_elements(
        # In
        elements: Elements,
        material: IsotropicMaterial,
        lam: wp.array[wp.float32],
        members: wp.array[wp.int32],
        live: wp.array[wp.int32],
        # In and out
        general: GeneralElements,
        grouped: GroupedMaterial,
    ):
        k = wp.tid()
        last = members.shape[0]
        if live.shape[0] > 0:
            last = grouped.starts[live[0]]
        if k >= last:
            return
        t = members[k]
        general.nodes[k] = elements.nodes[t]
        general.rest_inverse[k] = rest_inverse_of(elements, t, wp.transpose(frame(elements, t)))
        general.volume[k] = rest_volume(elements, t)
        if material.stride > 0:
            grouped.isotropic.mu[k] = material.mu[t]
            grouped.lam[k] = lam[t]

    return order_elements
