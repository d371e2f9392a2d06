"""Materials, from which every elastic model takes its constants."""

from .anisotropic import Orthotropic, TransverselyIsotropic
from .isotropic import Isotropic

__all__ = ["Isotropic", "Orthotropic", "TransverselyIsotropic"]
