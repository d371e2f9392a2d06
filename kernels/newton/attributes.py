"""Conversion between Newton's arrays and tetrahedra: materials are read, rotations and stresses written."""

import functools

import warp as wp

from warp_corot.kernels.elements.constitutive import corotated_strain, hooke
from warp_corot.kernels.elements.elements import GeneralElements
from warp_corot.kernels.elements.forces import von_mises
from warp_corot.kernels.math.rotation import byers_xu, identity3
from warp_corot.kernels.modules import unique_kernel

from .elements import difference_gradient, place_in_model

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def split_materials(
    # In
    materials: wp.array2d[wp.float32],
    ids: wp.array[wp.int32],
    mu_from_mu: float,
    lam_from_mu: float,
    # Out
    mu: wp.array[wp.float32],
    lam: wp.array[wp.float32],
    k_lambda: wp.array[wp.float32],
    k_damp: wp.array[wp.float32],
):
    """Lamé's parameters of chosen elements, mu = a k_mu, lambda = k_lambda + b k_mu, and the other values in Newton's
    rows, in separate arrays."""
    t = wp.tid()
    row = place_in_model(ids, 0, t)
    k_mu = materials[row, 0]
    mu[t] = mu_from_mu * k_mu
    lam[t] = materials[row, 1] + lam_from_mu * k_mu
    k_lambda[t] = materials[row, 1]
    k_damp[t] = materials[row, 2]


@functools.cache
def write_attributes(has_rotation: bool, has_stress: bool, has_von_mises: bool) -> wp.Kernel:
    """Write rotation and Cauchy stress of every element, as far as the state has attributes for them."""

    @unique_kernel()
    def write_attributes(
        # In
        elements: GeneralElements,
        mu: wp.array[wp.float32],
        lam: wp.array[wp.float32],
        fill: wp.array[wp.float32],
        fill_stride: int,
        q: wp.array[wp.vec3],
        # Out
        rotations: wp.array[wp.quat],
        stresses: wp.array[wp.mat33],
        equivalent: wp.array[wp.float32],
    ):
        t = wp.tid()
        gradient = difference_gradient(elements, t, q)
        r = byers_xu(gradient)
        if wp.static(has_rotation):
            rotations[t] = wp.normalize(wp.quat_from_matrix(r))
        share = 1.0 / fill[t * fill_stride]
        stress = share * hooke(corotated_strain(gradient - identity3(), identity3(), r), mu[t], lam[t])
        if wp.static(has_stress):
            stresses[t] = r * stress * wp.transpose(r)
        if wp.static(has_von_mises):
            equivalent[t] = von_mises(stress)

    return write_attributes
