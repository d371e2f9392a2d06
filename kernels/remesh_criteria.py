"""The former place of remeshing criteria, which are now in ``warp_corot.remesh``; kept for one version.

Checkpoints name criteria by this former place.
"""

import warnings

from warp_corot.kernels.remesh.criteria import (
    displacement_gradient,
    green_strain,
    longest_edge,
    nearness,
    strain,
    von_mises_stress,
)

__all__ = ["displacement_gradient", "green_strain", "longest_edge", "nearness", "strain", "von_mises_stress"]

warnings.warn("warp_corot.kernels.remesh_criteria has moved: use warp_corot.remesh", DeprecationWarning, stacklevel=2)
