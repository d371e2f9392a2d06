"""Laws and shared dilatations in float64 with their differentials, on the CPU: the templates of ``native``, of which
the eight lanes of float32 are another instance."""

import functools

import warp as wp

from warp_corot.kernels.modules import unique_kernel

from .dilatation import Dilatation
from .simd8 import IsotropicLaw, bare, headers, on_cpu

wp.set_module_options({"enable_backward": False})


@functools.cache
def stresses(law: IsotropicLaw) -> wp.Kernel:
    """P of displacement gradients A and its differential in a direction dA; and whether the law holds there, which
    without a definite rotation the corotated one does not."""
    native = bare(law)
    call = f"corot::stress_of({native.code}, a.data[i], da.data[i], mu.data[i], lam.data[i], p.data[i], dp.data[i])"

    @wp.func_native(on_cpu(f"return {call};", otherwise="return false;\n"))
    def stress(
        i: int,
        a: wp.array[wp.mat33d],
        da: wp.array[wp.mat33d],
        mu: wp.array[wp.float64],
        lam: wp.array[wp.float64],
        p: wp.array[wp.mat33d],
        dp: wp.array[wp.mat33d],
    ) -> bool: ...

    @unique_kernel(native=headers("single"))
    def stresses(
        # In
        a: wp.array[wp.mat33d],
        da: wp.array[wp.mat33d],
        mu: wp.array[wp.float64],
        lam: wp.array[wp.float64],
        # Out
        p: wp.array[wp.mat33d],
        dp: wp.array[wp.mat33d],
        valid: wp.array[wp.bool],
    ):
        i = wp.tid()
        valid[i] = stress(i, a, da, mu, lam, p, dp)

    return stresses


@functools.cache
def dilatations(of: Dilatation) -> wp.Kernel:
    """theta, h' and h'' of displacement gradients A; d theta / dF and its differential in a direction dA."""
    given = "a.data[i], da.data[i], numbers.data[i], slope.data[i], turning.data[i]"

    @wp.func_native(on_cpu(f"corot::dilatation_of<corot::{of.lanes}>({given});"))
    def dilatation(
        i: int,
        a: wp.array[wp.mat33d],
        da: wp.array[wp.mat33d],
        numbers: wp.array[wp.vec3d],
        slope: wp.array[wp.mat33d],
        turning: wp.array[wp.mat33d],
    ): ...

    @unique_kernel(native=headers("single"))
    def dilatations(
        # In
        a: wp.array[wp.mat33d],
        da: wp.array[wp.mat33d],
        # Out
        numbers: wp.array[wp.vec3d],
        slope: wp.array[wp.mat33d],
        turning: wp.array[wp.mat33d],
    ):
        dilatation(wp.tid(), a, da, numbers, slope, turning)

    return dilatations


@functools.cache
def pressures(of: Dilatation) -> wp.Kernel:
    """w' and w'' of shared dilatations theta."""
    code = f"const corot::dual w = corot::{of.lanes}::pressure(corot::dual(theta, 1.0));\n"
    pair = "return wp::vec_t<2, wp::float64>"

    @wp.func_native(on_cpu(f"{code}{pair}(w.value, w.slope);", otherwise=f"{pair}();\n"))
    def pressure(theta: wp.float64) -> wp.vec2d: ...

    @unique_kernel(native=headers("single"))
    def pressures(theta: wp.array[wp.float64], found: wp.array[wp.vec2d]):
        i = wp.tid()
        found[i] = pressure(theta[i])

    return pressures
