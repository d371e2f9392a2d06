"""Materials, from which every elastic model takes its constants."""

from .anisotropic import FibreReinforced, Orthotropic, TransverselyIsotropic
from .isotropic import Isotropic

__all__ = ["FibreReinforced", "Isotropic", "Orthotropic", "TransverselyIsotropic"]
