"""The former place of ``ElementState`` and ``elongation``, now in ``warp_corot.remesh``; kept for one version."""

import warnings

from warp_corot.kernels.remesh.mark import ElementState, elongation

__all__ = ["ElementState", "elongation"]

warnings.warn("warp_corot.kernels.remesh_mark has moved: use warp_corot.remesh", DeprecationWarning, stacklevel=2)
