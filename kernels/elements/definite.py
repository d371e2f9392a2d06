"""Differentials of isotropic laws without their negative parts, for ``elements.forces``.

In the principal axes of F = U diag(l) V^T the differential of an isotropic law's stress falls into blocks: a 3x3 matrix
of stretches, and for each pair of axes a number for the shear and one for the turn in their plane. Nine directions give
them all. A block's negative eigenvalues are set to zero, so that the stiffness of each element is positive
semidefinite, and is the exact one where that is (Teran et al. 2005; Smith, de Goes and Kim 2019).
"""

import functools
from typing import Any

import warp as wp

from warp_corot.kernels.elements.dilatation import DilatedMaterial
from warp_corot.kernels.elements.elements import frame, local_gradient
from warp_corot.kernels.elements.simd8 import law_kernel
from warp_corot.kernels.math.matrices import identity3, semidefinite
from warp_corot.kernels.math.rotation import quick_rotation

wp.set_module_options({"enable_backward": False})


@wp.struct
class DefiniteMaterial:
    """Blocks of each element, which ``keep_definite`` finds.

    Attributes:
        left, right: U in world axes and V in those of the element's frame, mat33 [T].
        stretches: The block of stretches [Pa], mat33 [T].
        shears, turns: Those of the planes across each axis [Pa], vec3 [T].
    """

    left: wp.array[wp.mat33]
    right: wp.array[wp.mat33]
    stretches: wp.array[wp.mat33]
    shears: wp.array[wp.vec3]
    turns: wp.array[wp.vec3]


@wp.func
def definite_differential(elements: Any, t: int, material: DefiniteMaterial, u: wp.array[wp.vec4], dg: wp.mat33):
    """With the kept blocks."""
    d = wp.transpose(material.left[t]) * dg * material.right[t]
    p = wp.diag(material.stretches[t] * wp.get_diag(d))
    for k in range(3):
        i = (k + 1) % 3
        j = (k + 2) % 3
        shear = 0.5 * material.shears[t][k] * (d[i, j] + d[j, i])
        turn = 0.5 * material.turns[t][k] * (d[i, j] - d[j, i])
        p[i, j] = shear + turn
        p[j, i] = shear - turn
    return material.left[t] * p * wp.transpose(material.right[t])


@functools.cache
def keep_definite(Elements: type, Material: type, differential: wp.Function) -> wp.Kernel:
    """Find the blocks; a thread an element."""

    @law_kernel()
    def keep_definite(
        # In
        elements: Elements,
        material: Material,
        u: wp.array[wp.vec4],
        # Out
        left: wp.array[wp.mat33],
        right: wp.array[wp.mat33],
        stretches: wp.array[wp.mat33],
        shears: wp.array[wp.vec3],
        turns: wp.array[wp.vec3],
    ):
        t = wp.tid()
        f = frame(elements, t) + local_gradient(elements, t, u)
        r = quick_rotation(f)
        s = wp.transpose(r) * f
        v, _ = wp.eig3(0.5 * (s + wp.transpose(s)) - identity3())
        w = r * v
        block = wp.mat33()
        shear = wp.vec3()
        turn = wp.vec3()
        n = int(0)
        # Not unrolled: the differential is compiled once.
        while n < 9:
            k = n % 3
            i = (k + 1) % 3
            j = (k + 2) % 3
            d = wp.mat33()
            if n < 3:
                d[k, k] = 1.0
            else:
                d[i, j] = 1.0
                d[j, i] = wp.where(n < 6, 1.0, -1.0)
            p = wp.transpose(w) * differential(elements, t, material, u, w * d * wp.transpose(v)) * v
            if n < 3:
                block[0, k] = p[0, 0]
                block[1, k] = p[1, 1]
                block[2, k] = p[2, 2]
            elif n < 6:
                shear[k] = wp.max(0.5 * (p[i, j] + p[j, i]), 0.0)
            else:
                turn[k] = wp.max(0.5 * (p[i, j] - p[j, i]), 0.0)
            n += 1
        left[t] = w
        right[t] = v
        stretches[t] = semidefinite(block)
        shears[t] = shear
        turns[t] = turn

    return keep_definite


@functools.cache
def with_dilatation(Material: type, law: wp.Function, own: wp.Function) -> tuple[type, wp.Function]:
    """The struct and the differential of a law and of the dilatation that an element shares, which is held fixed."""

    @wp.struct
    class BothMaterials:
        law: Material
        dilated: DilatedMaterial

    @wp.func
    def both_differentials(elements: Any, t: int, material: BothMaterials, u: wp.array[wp.vec4], dg: wp.mat33):
        return law(elements, t, material.law, u, dg) + own(elements, t, material.dilated, u, dg)

    return BothMaterials, both_differentials
