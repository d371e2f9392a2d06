"""Viscoelastic stresses of a Prony series: Maxwell elements beside the elastic law, in rest space.

Element i has the shear modulus g_i mu and the relaxation time tau_i. Its overstrain s_i, symmetric and without trace,
follows ds_i/dt = dE/dt - s_i / tau_i with E the deviator of Green's strain, and its second Piola-Kirchhoff stress is 2
g_i mu s_i. None of this depends on how the body has turned. If E grows evenly over a time t, then exactly
    s_i(t) = exp(-t / tau_i) s_i(0) + phi (E(t) - E(0)),  phi = (1 - exp(-t / tau_i)) tau_i / t.
So forces t after a known state are those of an elastic law with the energy density
    sum_i g_i mu (phi |E - E(0)|^2 + 2 exp(-t / tau_i) s_i(0) : (E - E(0)) + exp(-t / tau_i) |s_i(0)|^2),
which at t = 0 is the energy that the Maxwell elements hold.
"""

import functools
from typing import Any

import warp as wp

from warp_corot.kernels.elements.constitutive import IsotropicMaterial
from warp_corot.kernels.elements.elements import ForestElements, frame, local_gradient
from warp_corot.kernels.elements.simd8 import headers, law_kernel, on_cpu
from warp_corot.kernels.math.rotation import byers_xu
from warp_corot.kernels.modules import unique_kernel
from warp_corot.kernels.plan.plan import Plan, extent, leaf_row
from warp_corot.kernels.stepping.pace import DT, Pace

wp.set_module_options({"enable_backward": False})


@wp.struct
class PronyMaterial:
    """The elastic material, the series, and the known state of each element.

    ``known`` has blocks of six numbers a tensor, each of ``count`` elements: E(0), and the overstrains in their order.
    """

    isotropic: IsotropicMaterial
    g: wp.array[wp.float32]  # [terms]
    tau: wp.array[wp.float32]  # [terms] [s]
    elapsed: wp.array[wp.float32]  # [1] t [s]
    known: wp.array[wp.float32]  # [6 (terms + 1) count]
    count: int


@wp.func_native("corot::relax_at(material, t, g, q, time);")
def relax_element(t: int, g: wp.mat33, q: wp.mat33, time: float, material: PronyMaterial): ...


@functools.cache
def relax(Elements: type) -> wp.Kernel:
    """Make the state at displacements u, after a step of the clock's length, the known one."""

    @law_kernel()
    def relax(
        # In
        elements: Elements,
        u: wp.array[wp.vec4],
        pace: Pace,
        # In and out
        material: PronyMaterial,
    ):
        t = wp.tid()
        relax_element(t, local_gradient(elements, t, u), frame(elements, t), float(pace.seconds[DT]), material)
        if t == 0:
            material.elapsed[0] = 0.0

    return relax


@wp.kernel(enable_backward=False)
def set_elapsed(
    # In
    begins: wp.array[wp.int32],
    shares: wp.array3d[wp.float32],
    row: int,
    dt: float,
    # Out
    elapsed: wp.array[wp.float32],
):
    """The time of the stage of an implicit step after its beginning [s]; see ``implicit.steps``."""
    elapsed[0] = shares[begins[0], row, 0] * dt


@wp.kernel(enable_backward=False)
def carry_values(
    # In
    leaves: wp.array[wp.int32],
    known: wp.array[wp.float32],
    first: int,
    blocks: int,
    count: int,
    # Out
    columns: wp.array2d[wp.float32],
):
    """Let the elements of a mesh that changes carry their known state, from column ``first`` on."""
    i = wp.tid()
    for k in range(blocks):
        columns[leaves[i], first + k] = known[k * count + i]


@wp.kernel(enable_backward=False)
def adopt_values(
    # In
    threads: int,
    plan: Plan,
    first: int,
    blocks: int,
    count: int,
    # Out
    known: wp.array[wp.float32],
):
    """Take the known state that the leaves of a changed mesh carry from row ``first`` on, if the plan was just derived;
    padding gets zeros.
    """
    for i in range(wp.tid(), extent(leaf_row(plan), plan), threads):
        for k in range(blocks):
            known[k * count + i] = plan.values[first + k, i]


@wp.kernel(enable_backward=False)
def forget(
    # In
    chosen: wp.array[wp.int32],
    world_count: int,
    count: int,
    # Out
    known: wp.array[wp.float32],
):
    """Forget the past of the chosen worlds: they are relaxed and at rest."""
    i = wp.tid()
    if chosen[(i % count) // world_count] != 0:
        known[i] = 0.0


# --- relaxation on the CPU, eight elements at a time; see ``simd8`` --------------------------------------------------


@functools.cache
def relax_simd8(Elements: type) -> wp.Kernel:
    """Make the state at displacements u, after a step of the clock's length, the known one; a thread is eight
    elements."""

    traversal = "ForestEight" if Elements is ForestElements else "GeneralEight"

    @wp.func_native(on_cpu(f"corot::relax_eight<corot::{traversal}>(material, units, block, count, u, time);"))
    def eight_elements(
        units: Elements, block: int, count: int, u: wp.array[wp.vec4], time: float, material: PronyMaterial
    ): ...

    @unique_kernel(native=headers("elements8", "added"))
    def relax_simd8(
        # In
        elements: Elements,
        count: int,
        u: wp.array[wp.vec4],
        pace: Pace,
        # In and out
        material: PronyMaterial,
    ):
        block = wp.tid()
        eight_elements(elements, block, count, u, float(pace.seconds[DT]), material)
        if block == 0:
            material.elapsed[0] = 0.0

    return relax_simd8


# --- prestress -------------------------------------------------------------------------------------------------------
#
# Stress that a body has at rest: a constant second Piola-Kirchhoff stress S of each element.
#
# P = F S is the derivative of the energy density S : E with Green's strain E; it turns with the body.


@wp.struct
class Prestress:
    """S in the axes of rest space, one entry (stride 0) or one per element (stride 1)."""

    stress: wp.array[wp.mat33]
    stride: int


# --- viscosity -------------------------------------------------------------------------------------------------------
#
# Viscous forces: a stress proportional to the rate at which an element's stretch changes, however it turns.
#
# With F = R U, Fdot = (du/dt) grad N and A = R^T Fdot, A = W U + Udot, where W = R^T Rdot is skew and Udot symmetric.
# The skew part of A says W: (tr(U) I - U) w is the axial vector of A - A^T. Udot vanishes where a body turns as a
# whole, at any strain. The stress s = eta (2 mu Udot + lambda tr(Udot) I) works against Udot; the force that does the
# same work at the nodes is that of P = R (s + [a]x), with (tr(U) I - U) a the axial vector of U s - s U: it takes out
# s : Udot >= 0 of power and has no torque.
#
# Below a determinant of 0.05 of tr(U) I - U, which is 8 at rest, the turning of a crushed or inverted element is hardly
# determined. With stretches a > 0 > b it is (a - b) / (a + b) times Udot and so faster than the nodes, which no
# explicit step survives. Below, the symmetric part of A stands for Udot, which still takes power out.


@wp.struct
class ViscousMaterial:
    """Lamé's parameters [Pa], viscosities over these [s], and the velocities of nodes [m/s]."""

    isotropic: IsotropicMaterial
    seconds: float
    velocities: wp.array[wp.vec4]


@wp.func_native("return corot::viscous_at(f, r, rate, mu, lam);")
def viscous_stress(f: wp.mat33, r: wp.mat33, rate: wp.mat33, mu: float, lam: float) -> wp.mat33:
    """P Q of F Q, its rotation, its rate and viscosities [Pa s]."""
    ...


@wp.func
def viscosity_stress(elements: Any, t: int, material: ViscousMaterial, u: wp.array[wp.vec4]):
    """The viscous stress of element t for the kernels of ``forces``; forces are the stiffness times seconds times
    velocities, for small motions."""
    f = frame(elements, t) + local_gradient(elements, t, u)
    rate = local_gradient(elements, t, material.velocities)
    i = t * material.isotropic.stride
    m = material.seconds * material.isotropic.mu[i]
    return viscous_stress(f, byers_xu(f), rate, m, material.seconds * material.isotropic.lam[i])
