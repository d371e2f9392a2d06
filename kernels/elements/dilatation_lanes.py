"""Shared dilatations on the CPU, eight elements to the lanes of vector registers.

Where nodes share it, this file has the passes of ``shared_dilatation`` that loop over elements. Where groups share it,
elements stand group after group, and one launch computes the law and the shared dilatation: a thread takes a few
groups.
"""

import functools

import warp as wp

from warp_corot.kernels.modules import unique_kernel

from .constitutive import CONTINUED_BELOW, IsotropicMaterial
from .dilatation import FREE, MOST, RAMP, Dilatation
from .elements import GeneralElements, frame, rest_volume
from .general_cpu import rest_inverse_of
from .lanes import ELEMENTS, ISOTROPIC, ISOTROPIC_PART, constants, native, on_cpu, scatter_lanes
from .law_lanes import LawInLanes, code_of, has_log

wp.set_module_options({"enable_backward": False})


def law_of(of: Dilatation, has_log: bool = False) -> str:
    """The native code of a law's dilatation; ``has_log``: it follows the code of neo-Hookean, which has the logarithm
    already.
    """
    free = constants(FREE=float(FREE), RAMP=float(RAMP))
    if has_log:
        return free + native(*(name for name in of.lanes if name != "log"))
    return free + constants(CONTINUED_BELOW=CONTINUED_BELOW) + native(*of.lanes)


@functools.cache
def measure_in_lanes(of: Dilatation) -> wp.Kernel:
    """``measure_elements`` without a direction; a thread is eight elements."""
    code = on_cpu(law_of(of) + native(*ELEMENTS, "element_dilatation", "store_dilatation"))

    @wp.func_native(code)
    def measure_eight(
        units: GeneralElements,
        block: int,
        count: int,
        places: wp.array[wp.int32],
        live: wp.array[wp.int32],
        u: wp.array[wp.vec4],
        shared: wp.array[wp.vec4],
    ): ...

    @unique_kernel()
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
    passes = native(*ELEMENTS, "element_dilatation", "dilatation_stresses", "element_forces")

    @wp.func_native(on_cpu(law_of(of) + ISOTROPIC + passes))
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

    @unique_kernel()
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
    leaves_out = ["left_out_elements"] if law == "corotated" else []
    code = code_of(law) + law_of(of, has_log=has_log(law)) + ISOTROPIC_PART
    rest = native("side_by_side", "rest_elements")
    code += constants(GROUPS=GROUPS, MOST=MOST) + native("group_dilatations") + rest + native("elements")
    code += native("group_pressures") + rest + native("grouped_elements", "element_forces", *leaves_out) + "}\n"
    return scatter_lanes(code, GeneralElements, GroupedMaterial, wp.int32)


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
