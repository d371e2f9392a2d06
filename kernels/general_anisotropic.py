"""Corotated forces of orthotropic general tetrahedra on CUDA, one thread an element; see ``general_cuda``."""

import functools

import warp as wp

from .anisotropic import OrthotropicMaterial, axes_of, filled, material_strain, turned_stress
from .definite import definite_law, definite_strain, is_definite, load_axes
from .general_cuda import ROUNDS, PosedElements, add_stress, edge_differences, load_four, rest_inverse_of
from .rotation import ITERATIONS, byers_xu, column, identity3, newton_rotation

wp.set_module_options({"enable_backward": False})


@wp.func(inline=False)
def robust_stress(g: wp.mat33, material: OrthotropicMaterial, t: int):
    """P of an F = I + g that the unscaled iteration does not turn, or whose rotation is hardly definite."""
    m = axes_of(material, t)
    turned_gradient = g * m
    r = byers_xu(m + turned_gradient)
    stress, a = turned_stress(material_strain(turned_gradient, m, r), material, t)
    return (filled(material, t) * r) * (stress + wp.skew(a)) * wp.transpose(m)


@functools.cache
def scatter_general_anisotropic(transverse: bool) -> wp.Kernel:
    """Add the forces of elements, and of their active stress. Launch with block_dim ``general_cuda.BLOCK``."""
    add, law = add_stress(ROUNDS), definite_law(transverse)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def scatter_general_anisotropic(
        # In
        elements: PosedElements,
        material: OrthotropicMaterial,
        axes: wp.array[wp.quat],
        is_active: int,
        activation: wp.array[wp.float32],
        u: wp.array[wp.vec4],
        # Out
        f: wp.array[wp.vec4],
    ):
        t = wp.tid()
        nodes = load_four(elements.nodes, t)
        g = edge_differences(nodes, u) * rest_inverse_of(elements, t)
        n = wp.quat_to_matrix(load_axes(axes, t * material.axes_stride))
        gradient = identity3() + g
        f0 = column(gradient, 0)
        f1 = column(gradient, 1)
        f2 = column(gradient, 2)
        z0, z1, z2, trusted = newton_rotation(f0, f1, f2, 1.0)
        e = definite_strain(z0, z1, z2, f0, f1, f2, g, g)
        p = wp.mat33()
        if trusted and is_definite(e):
            scale = wp.static(0.5**ITERATIONS) * filled(material, t)
            p = wp.matrix_from_cols(z0, z1, z2) * law(e, n, material.stiffness[t * material.stride], scale)
        else:
            p = robust_stress(g, material, t)
        if is_active != 0:
            d = column(n, 0)
            p += wp.outer((filled(material, t) * activation[t]) * (gradient * d), d)
        add(elements, t, nodes, p, f)

    return scatter_general_anisotropic
