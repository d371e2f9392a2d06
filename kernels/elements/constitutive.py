"""Constitutive laws, one set of functions each: first Piola-Kirchhoff stress, its differential, and energy density.

A law takes the displacement gradient A of an element in an orthonormal frame of its own, so that F = I + A there, and
returns P in the same frame. Materials are isotropic, so any frame is right, also a left-handed one. ``elements`` gives
G = (du/dX) Q, and A = Q^T G. ``differential`` functions return dP, the exact directional derivative of P at A in the
direction dA, which has the digits of dA. Stresses in Pa, energy densities in J/m^3.

No law subtracts numbers near one: each is written in A, so that its stress has float32's digits at any strain.
"""

import functools
from typing import NamedTuple

import warp as wp

from .simd8 import IsotropicLaw, bare

wp.set_module_options({"enable_backward": False})


@wp.struct
class IsotropicMaterial:
    """Lamé's parameters, arrays of one entry (stride 0) or one per element (stride 1)."""

    mu: wp.array[wp.float32]
    lam: wp.array[wp.float32]
    stride: int


@wp.struct
class RotatedMaterial:
    """Lamé's parameters, and rotations with the one that each element uses."""

    isotropic: IsotropicMaterial
    rotations: wp.array[wp.mat33]  # [units] from rest space to world space
    unit: wp.array[wp.int32]  # [T]


@wp.func
def hooke(strain: wp.mat33, mu: float, lam: float):
    pressure = lam * wp.trace(strain)
    stress = (2.0 * mu) * strain
    stress[0, 0] += pressure
    stress[1, 1] += pressure
    stress[2, 2] += pressure
    return stress


@wp.func
def hooke_energy(strain: wp.mat33, mu: float, lam: float):
    trace = wp.trace(strain)
    return mu * wp.ddot(strain, strain) + 0.5 * lam * trace * trace


@wp.func
def symmetric(a: wp.mat33):
    return 0.5 * (a + wp.transpose(a))


@wp.func
def push_forward(f: wp.mat33, piola: wp.mat33):
    """The Cauchy stress P F^T / J, with |J| kept away from zero; both may be times a frame."""
    return (piola * wp.transpose(f)) / wp.max(wp.abs(wp.determinant(f)), 1.0e-3)


@wp.func
def green_strain(a: wp.mat33):
    """E = (F^T F - I) / 2 without cancellation at small strains."""
    return symmetric(a) + 0.5 * (wp.transpose(a) * a)


# --- laws of ``native/laws.h`` ---------------------------------------------------------------------------------------


class LawFunctions(NamedTuple):
    """P of (A, mu, lambda), dP of (A, dA, mu, lambda), and the energy density of (A, mu, lambda)."""

    stress: wp.Function
    differential: wp.Function
    energy: wp.Function


@functools.cache
def law_functions(law: IsotropicLaw) -> LawFunctions:
    """The device functions of a law. The modules of kernels that call them need ``simd8.LAW_HEADERS``."""
    code = bare(law).code

    @wp.func_native(f"wp::mat33 p;\ncorot::stress_of({code}, a, mu, lam, p);\nreturn p;")
    def stress(a: wp.mat33, mu: float, lam: float) -> wp.mat33: ...

    @wp.func_native(f"wp::mat33 p, dp;\ncorot::stress_of({code}, a, da, mu, lam, p, dp);\nreturn dp;")
    def differential(a: wp.mat33, da: wp.mat33, mu: float, lam: float) -> wp.mat33: ...

    @wp.func_native(f"return corot::energy_of({code}, a, mu, lam);")
    def energy(a: wp.mat33, mu: float, lam: float) -> float: ...

    return LawFunctions(stress, differential, energy)


@wp.func_native("float excess;\nconst float log = corot::log_of(d, excess);\nreturn wp::vec2(log, excess);")
def log_and_excess(d: float) -> wp.vec2: ...


@wp.func
def log_of_dilation(d: float):
    """ln(1 + d) and d - ln(1 + d), both to all their digits."""
    both = log_and_excess(d)
    return both[0], both[1]


# --- corotated: R is the rotation of F Q ---------------------------------------------------------------------------


@wp.func
def corotated_strain(g: wp.mat33, q: wp.mat33, r: wp.mat33):
    """sym(R^T F) - I without cancellation where G is small, also for a shared rotation.

    With D = R Q - Q, sym((R Q)^T Q) - I = -D^T D / 2: that holds for rotations alone, and drops what rounding adds.
    """
    d = r - q
    return symmetric(wp.transpose(r) * g) - 0.5 * (wp.transpose(d) * d)


@wp.func
def rotated_stress(g: wp.mat33, q: wp.mat33, r: wp.mat33, mu: float, lam: float):
    """The corotated stress times Q, of G, the frame Q and the rotation of F Q."""
    return r * hooke(corotated_strain(g, q, r), mu, lam)
