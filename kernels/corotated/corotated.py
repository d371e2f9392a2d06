"""The corotated force of the paper, f = -R K (R^T x - x0), with own rotations or rotations shared down the tree.

Own rotations are found and used in one kernel. Shared ones take two: ``extract_rotations`` finds the rotation of each
ancestor from its four vertices, the force kernels gather it. A rotation R maps rest space to world space; an element's
local frame Q turns it into the rotation R Q of its F Q.
"""

import functools
from typing import Any

import warp as wp

from warp_corot.kernels.elements.constitutive import corotated_strain, hooke, hooke_energy
from warp_corot.kernels.elements.elements import (
    ForestElements,
    add_force,
    edge_length,
    frame,
    load_node,
    local_gradient,
    mirror_sign,
    rest_volume,
    scatter_stress,
    shape_of,
)
from warp_corot.kernels.elements.forces import von_mises
from warp_corot.kernels.elements.stiffness import stiffness_product, vec12
from warp_corot.kernels.math.rotation import identity3, warm_rotation
from warp_corot.kernels.tables.shapes import REST

wp.set_module_options({"enable_backward": False})


@functools.cache
def scatter_own_rotation(Elements: Any, rotation: wp.Function) -> wp.Kernel:
    """Corotated forces, each element with the rotation of its own deformation gradient."""

    @wp.kernel(module="unique", enable_backward=False)
    def scatter_own_rotation(
        # In
        elements: Elements,
        mu: wp.array[wp.float32],
        lam: wp.array[wp.float32],
        stride: int,
        u: wp.array[wp.vec4],
        # Out
        f: wp.array[wp.vec4],
    ):
        t = wp.tid()
        g = local_gradient(elements, t, u)
        q = frame(elements, t)
        r = rotation(q + g)
        p = r * hooke(corotated_strain(g, q, r), mu[t * stride], lam[t * stride])
        scatter_stress(elements, t, p, f)

    return scatter_own_rotation


@functools.cache
def extract_rotations(Elements: Any, rotation: wp.Function) -> wp.Kernel:
    """The rotation R of each unit (an element or an ancestor) from rest space to world space."""

    @wp.kernel(module="unique", enable_backward=False)
    def extract_rotations(
        # In
        units: Elements,
        u: wp.array[wp.vec4],
        # Out
        rotations: wp.array[wp.mat33],
    ):
        t = wp.tid()
        q = frame(units, t)
        rotations[t] = rotation(q + local_gradient(units, t, u)) * wp.transpose(q)

    return extract_rotations


@functools.cache
def extract_warm_rotations(Elements: Any) -> wp.Kernel:
    """As ``extract_rotations``, from and into the unit's quaternion of the step before."""

    @wp.kernel(module="unique", enable_backward=False)
    def extract_warm_rotations(
        # In
        units: Elements,
        u: wp.array[wp.vec4],
        # Out
        quaternions: wp.array[wp.quat],
        rotations: wp.array[wp.mat33],
    ):
        t = wp.tid()
        q = frame(units, t)
        f = (q + local_gradient(units, t, u)) * wp.transpose(q)
        quaternion = warm_rotation(f, quaternions[t])
        quaternions[t] = quaternion
        rotations[t] = wp.quat_to_matrix(quaternion)

    return extract_warm_rotations


@wp.kernel(enable_backward=False)
def reset_quaternions(chosen: wp.array[wp.int32], world_unit_count: int, quaternions: wp.array[wp.quat]):
    """Start the warm rotations of chosen worlds from the identity again."""
    t = wp.tid()
    if chosen[t // world_unit_count] != 0:
        quaternions[t] = wp.quat_identity()


@functools.cache
def scatter_with_rotations(Elements: Any) -> wp.Kernel:
    """Corotated forces with given rotations, stiffness factored into sums and differences."""

    @wp.kernel(module="unique", enable_backward=False)
    def scatter_with_rotations(
        # In
        elements: Elements,
        mu: wp.array[wp.float32],
        lam: wp.array[wp.float32],
        stride: int,
        u: wp.array[wp.vec4],
        rotations: wp.array[wp.mat33],
        unit: wp.array[wp.int32],
        # Out
        f: wp.array[wp.vec4],
    ):
        t = wp.tid()
        g = local_gradient(elements, t, u)
        q = frame(elements, t)
        r = rotations[unit[t]] * q
        p = r * hooke(corotated_strain(g, q, r), mu[t * stride], lam[t * stride])
        scatter_stress(elements, t, p, f)

    return scatter_with_rotations


@functools.cache
def corotated_energies(Elements: Any) -> wp.Kernel:
    """Strain energy of each element [J] with given rotations."""

    @wp.kernel(module="unique", enable_backward=False)
    def corotated_energies(
        # In
        elements: Elements,
        mu: wp.array[wp.float32],
        lam: wp.array[wp.float32],
        stride: int,
        u: wp.array[wp.vec4],
        rotations: wp.array[wp.mat33],
        unit: wp.array[wp.int32],
        # Out
        energies: wp.array[wp.float64],
    ):
        t = wp.tid()
        g = local_gradient(elements, t, u)
        q = frame(elements, t)
        strain = corotated_strain(g, q, rotations[unit[t]] * q)
        density = hooke_energy(strain, mu[t * stride], lam[t * stride])
        energies[t] = wp.float64(density) * wp.float64(rest_volume(elements, t))

    return corotated_energies


@functools.cache
def corotated_von_mises(Elements: Any) -> wp.Kernel:
    """Von Mises stress of each element [Pa] with given rotations."""

    @wp.kernel(module="unique", enable_backward=False)
    def corotated_von_mises(
        # In
        elements: Elements,
        mu: wp.array[wp.float32],
        lam: wp.array[wp.float32],
        stride: int,
        u: wp.array[wp.vec4],
        rotations: wp.array[wp.mat33],
        unit: wp.array[wp.int32],
        # Out
        stress: wp.array[wp.float32],
    ):
        t = wp.tid()
        g = local_gradient(elements, t, u)
        q = frame(elements, t)
        strain = corotated_strain(g, q, rotations[unit[t]] * q)
        stress[t] = von_mises(hooke(strain, mu[t * stride], lam[t * stride]))

    return corotated_von_mises


# --- the explicit 12x12 product ------------------------------------------------------------------------------------


mat43 = wp.types.matrix(shape=(4, 3), dtype=wp.float32)


@wp.func
def rest_shape(shape: int):
    """Node positions of a shape of edge length one in its own frame, a row a node."""
    x0 = wp.static(mat43(*(x for node in REST[0] for x in node)))
    if shape == 1:
        x0 = wp.static(mat43(*(x for node in REST[1] for x in node)))
    elif shape == 2:
        x0 = wp.static(mat43(*(x for node in REST[2] for x in node)))
    return x0


@functools.cache
def scatter_matrix_product(skip_zeros: bool) -> wp.Kernel:
    """Corotated forces with given rotations by the explicit K_T of each type, zeros skipped or not."""
    product0 = stiffness_product(0, skip_zeros)
    product1 = stiffness_product(1, skip_zeros)
    product2 = stiffness_product(2, skip_zeros)

    @wp.kernel(module="unique", enable_backward=False)
    def scatter_matrix_product(
        # In
        elements: ForestElements,
        mu: wp.array[wp.float32],
        lam: wp.array[wp.float32],
        stride: int,
        u: wp.array[wp.vec4],
        rotations: wp.array[wp.mat33],
        unit: wp.array[wp.int32],
        # Out
        f: wp.array[wp.vec4],
    ):
        t = wp.tid()
        nodes = elements.nodes[t]
        targets = elements.targets[t]
        code = elements.code[t]
        shape = shape_of(code)
        h = edge_length(elements, t)
        s = mirror_sign(code)
        mirror = wp.mat33(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, s)
        q = frame(elements, t) * mirror
        r = rotations[unit[t]] * q
        origin = load_node(u, nodes[0])
        turned = wp.transpose(r) * q - identity3()
        x0 = rest_shape(shape)
        z = vec12()
        for n in range(4):
            # R^T x - x0 with x = Q x0 + u, from displacements so that nothing large cancels.
            d = turned * (x0[n] * h) + wp.transpose(r) * (load_node(u, nodes[n]) - origin)
            z[3 * n] = d[0]
            z[3 * n + 1] = d[1]
            z[3 * n + 2] = d[2]
        y = vec12()
        m = mu[t * stride] * h
        k = lam[t * stride] * h
        if shape == 0:
            y = product0(z, m, k)
        elif shape == 1:
            y = product1(z, m, k)
        else:
            y = product2(z, m, k)
        for n in range(4):
            add_force(f, targets[n], -(r * wp.vec3(y[3 * n], y[3 * n + 1], y[3 * n + 2])))

    return scatter_matrix_product
