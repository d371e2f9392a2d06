"""Elements in clusters that share their dilatation in groups (CUDA): a group's pressure, and laws that add it.

A launch finds the pressures of all groups, eight threads a group. The launch of clusters then adds them to the stress
of the law, so that each element's forces are added up once. See ``kernels.elements.dilatation``.
"""

import functools

import warp as wp

from warp_corot.kernels.elements.constitutive import IsotropicMaterial
from warp_corot.kernels.elements.dilatation import Dilatation, mean_of, pressure_stress_of
from warp_corot.kernels.elements.elements import rest_volume
from warp_corot.kernels.elements.forces import own_gradient
from warp_corot.kernels.modules import unique_kernel

from .elements import number_of

wp.set_module_options({"enable_backward": False})

#: Threads of a group, a divisor of a warp.
LANES = 8


@wp.struct
class SharingMaterial:
    """The material of a law without lambda's part, and what that part needs."""

    isotropic: IsotropicMaterial  # its lambda is zero
    lam: wp.array[wp.float32]  # as the elements have it
    groups: wp.array[wp.int32]  # the group of each element that clusters list
    pressures: wp.array[wp.float32]  # w' of each group's dilatation


@functools.cache
def sharing_law(law: wp.Function, of: Dilatation) -> wp.Function:
    """A law of ``laws`` with the stress of the dilatation that the i-th element of a list shares."""
    pressure_stress = pressure_stress_of(of)

    @wp.func
    def sharing_law(material: SharingMaterial, listed: wp.array[wp.int32], i: int, scale: float, w: wp.mat33):
        t = int(0)
        if material.isotropic.stride != 0:
            t = number_of(listed, i)
        pressure = material.pressures[number_of(material.groups, i)]
        return law(material.isotropic, listed, i, scale, w) + pressure_stress(w, pressure, scale * material.lam[t])

    return sharing_law


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    for (int step = {LANES // 2}; step > 0; step /= 2) part += __shfl_xor_sync(0xffffffffu, part, step);
#endif
    return part;
""")
def sum_of_group(part: float) -> float:
    """The sum over the threads of a group; all threads of a warp call."""
    ...


@functools.cache
def find_pressures(Elements: type, of: Dilatation) -> wp.Kernel:
    """Find w' of each group's dilatation; launch with ``LANES`` threads a group, in whole warps."""
    measure, slope_of = of.measure, of.slope

    @unique_kernel(grid_stride=False)
    def find_pressures(
        # In
        starts: wp.array[wp.int32],
        members: wp.array[wp.int32],
        elements: Elements,
        stride: int,
        lam: wp.array[wp.float32],
        u: wp.array[wp.vec4],
        # Out
        pressures: wp.array[wp.float32],
    ):
        i = wp.tid()
        g = i // wp.static(LANES)
        k = int(0)
        end = int(0)
        if g < pressures.shape[0]:
            k = starts[g] + i % wp.static(LANES)
            end = starts[g + 1]
        theta = float(0.0)
        total = float(0.0)
        while k < end:
            t = members[k]
            weight = lam[t * stride] * rest_volume(elements, t)
            own, _slope = measure(own_gradient(elements, t, u))
            theta += weight * own
            total += weight
            k += wp.static(LANES)
        theta = sum_of_group(theta)
        total = sum_of_group(total)
        if g < pressures.shape[0] and i % wp.static(LANES) == 0:
            pressures[g] = slope_of(mean_of(theta, total))

    return find_pressures
