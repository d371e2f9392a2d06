"""Materials, from which every elastic model takes its constants."""

from .anisotropic import Orthotropic, TransverselyIsotropic
from .isotropic import Isotropic
from .reinforced import FibreReinforced

__all__ = ["FibreReinforced", "Isotropic", "Orthotropic", "TransverselyIsotropic"]
