"""Shared dilatations on the CPU, eight elements to the lanes of vector registers.

Where nodes share it, this file has the passes of ``shared_dilatation`` that loop over elements. Where groups share it,
elements stand group after group, and one launch computes the law and the shared dilatation: a thread takes a few
groups.
"""

import functools

import warp as wp

from warp_corot.kernels.modules import unique_kernel

from .constitutive import IsotropicMaterial
from .dilatation import MOST, Dilatation
from .elements import GeneralElements, frame, rest_volume
from .general_cpu import rest_inverse_of
from .lanes import headers, on_cpu, scatter_lanes
from .law_lanes import LawInLanes, elastic

wp.set_module_options({"enable_backward": False})


@functools.cache
def measure_in_lanes(of: Dilatation) -> wp.Kernel:
    """``measure_elements`` without a direction; a thread is eight elements."""
    call = f"corot::measure_eight<corot::{of.lanes}>(units, block, count, places, live, u, shared);"

    @wp.func_native(on_cpu(call))
    def measure_eight(
        units: GeneralElements,
        block: int,
        count: int,
        places: wp.array[wp.int32],
        live: wp.array[wp.int32],
        u: wp.array[wp.vec4],
        shared: wp.array[wp.vec4],
    ): ...

    @unique_kernel(native=headers("elements8"))
    def measure_in_lanes(
        # In
        units: GeneralElements,
        count: int,
        places: wp.array[wp.int32],
        live: wp.array[wp.int32],
        u: wp.array[wp.vec4],
        # Out
        shared: wp.array[wp.vec4],
    ):
        measure_eight(units, wp.tid(), count, places, live, u, shared)

    return measure_in_lanes


@functools.cache
def scatter_in_lanes(of: Dilatation) -> wp.Kernel:
    """``scatter_pressures``; a thread is eight elements."""
    call = f"""corot::scatter_pressures<corot::{of.lanes}>(
        units, block, count, places, live, material.lam, material.stride, u, shared, f);"""

    @wp.func_native(on_cpu(call))
    def scatter_eight(
        units: GeneralElements,
        block: int,
        count: int,
        places: wp.array[wp.int32],
        live: wp.array[wp.int32],
        material: IsotropicMaterial,
        u: wp.array[wp.vec4],
        shared: wp.array[wp.vec4],
        f: wp.array[wp.vec4],
    ): ...

    @unique_kernel(native=headers("elements8"))
    def scatter_in_lanes(
        # In
        units: GeneralElements,
        count: int,
        places: wp.array[wp.int32],
        live: wp.array[wp.int32],
        material: IsotropicMaterial,
        u: wp.array[wp.vec4],
        shared: wp.array[wp.vec4],
        # Out
        f: wp.array[wp.vec4],
    ):
        scatter_eight(units, wp.tid(), count, places, live, material, u, shared, f)

    return scatter_in_lanes


# --- groups -----------------------------------------------------------------------------------------------------------

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
def scatter_grouped_elements(law: LawInLanes, of: Dilatation) -> wp.Kernel:
    """Forces of a law of ``law_lanes`` with a shared dilatation; a thread is ``GROUPS`` groups.

    The corotated law lists what it leaves out.
    """
    of_law, kind = elastic(law, "material.isotropic"), f"corot::{of.lanes}, {GROUPS}, {MOST}"
    call = f"corot::scatter_groups<{kind}>({of_law.code}, units, block, count, material, u, f, missed)"
    return scatter_lanes(call, GeneralElements, GroupedMaterial, wp.int32, headers("groups8", of_law.header))


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
