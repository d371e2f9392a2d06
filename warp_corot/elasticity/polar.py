"""Rotations of many matrices at once, by the solver's methods."""

from __future__ import annotations

import functools

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_choice, checked_count, checked_device, checked_numbers
from warp_corot.kernels.math.rotation import byers_xu, byers_xu_fixed, mcadams_svd, rotate_all

METHODS = ("byers-xu", "svd")
MAX_ITERATIONS = 12


@functools.cache
def rotation_function(method: str, iterations: int | None = None) -> wp.Function:
    """The device function of a method.

    Raises:
        InputError: Unknown method, or a number of iterations that it does not take.
    """
    if iterations is not None:
        if method != "byers-xu":
            raise InputError(f"iterations is {iterations}; it must be None for the method {method!r}")
        if checked_count(iterations, "iterations", 2) > MAX_ITERATIONS:
            raise InputError(f"iterations is {iterations}; it must be None or an integer from 2 to {MAX_ITERATIONS}")
        return byers_xu_fixed(int(iterations))
    functions = {"byers-xu": byers_xu, "svd": mcadams_svd}
    return functions[method]


def polar_rotation(
    F: npt.ArrayLike,
    method: str = "byers-xu",
    *,
    iterations: int | None = None,
    device: str | wp.Device | None = None,
) -> npt.NDArray[np.float32]:
    """The proper rotation R nearest to each matrix, the maximiser of tr(R^T F) with det R = +1.

    For det F > 0 this is the rotation of the polar decomposition. Inverted, singular, huge and tiny matrices have one
    too; a zero or non-finite matrix gives the identity. Computed in float32.

    Args:
        F: Matrices [n, 3, 3] (or one, [3, 3]).
        method: "byers-xu": Newton's iteration with the scaling of Byers and Xu (2008), to the paper's tolerance;
            "svd": U V^T of Warp's 3x3 SVD (McAdams et al. 2011), the baseline, off by up to 0.07 if singular values of
            an inverted F nearly coincide.
        iterations: For "byers-xu": this many iterations (2 to 12) in place of the tolerance.
        device: The device of the computation; None for Warp's default.

    Returns:
        Rotations, float32, of the same shape.

    Raises:
        InputError: Wrong shape, unknown method, options of another method, or no such device.
    """
    checked_choice(method, "rotation method", METHODS)
    if iterations is not None:
        iterations = checked_count(iterations, "iterations", 2)
    matrices = checked_numbers(F, "F", "[n, 3, 3]")
    if matrices.shape[-2:] != (3, 3) or matrices.ndim not in (2, 3):
        raise InputError(f"F has shape {matrices.shape}; it must be [n, 3, 3]")
    where = checked_device(device)
    with np.errstate(over="ignore"):
        flat = np.ascontiguousarray(matrices.reshape(-1, 3, 3), dtype=np.float32)
    rotations = wp.empty(len(flat), dtype=wp.mat33, device=where)
    inputs = [wp.array(flat, dtype=wp.mat33, device=where)]
    kernel = rotate_all(rotation_function(method, iterations))
    wp.launch(kernel, dim=len(flat), inputs=inputs, outputs=[rotations], device=where)
    return rotations.numpy().reshape(matrices.shape)
