"""Nodal vectors on the device: four floats for each node, the last one unused."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import warp as wp


def padded(vectors: np.ndarray) -> npt.NDArray[np.float32]:
    """[N, 3] as float32 [N, 4], the form of nodal arrays."""
    padded = np.zeros((len(vectors), 4), np.float32)
    padded[:, :3] = vectors
    return padded


def vec3_view(a: wp.array) -> wp.array:
    """The first three lanes of a vec4 array as a live (strided) vec3 array; a vec3 array as it is."""
    return a if a.dtype == wp.vec3 else a.view(wp.float32)[:, :3].view(wp.vec3)


def same_array(a: wp.array, b: wp.array) -> bool:
    """Whether two arrays are the same memory for launches."""
    return (a.ptr, a.dtype, a.strides) == (b.ptr, b.dtype, b.strides)
