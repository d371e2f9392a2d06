"""The choice of kernels for a constitutive law."""

from __future__ import annotations

from typing import TYPE_CHECKING

from warp_corot.elasticity.model import Law, LawField

from .law_cuda import LawCudaField
from .law_simd8 import LawSimd8Field

if TYPE_CHECKING:
    from warp_corot.discretization.discretization import Discretization


def law_field(law: Law, discretization: Discretization, deterministic: bool = False) -> LawField:
    """The fastest force field of a law of the package on a discretization.

    Args:
        law: The law.
        discretization: The mesh and the material.
        deterministic: As for every field.
    """
    kind = LawSimd8Field if discretization.device.is_cpu else LawCudaField
    return kind(discretization, law, deterministic=deterministic)
