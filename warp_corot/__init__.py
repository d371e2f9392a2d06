"""Corotational finite elements for soft tissue at interactive rates, in NVIDIA Warp, on CPU and CUDA.

After Tagawa, Yamada and Tanaka, *A Rectangular Tetrahedral Adaptive Mesh Based Corotated Finite Element Model for
Interactive Soft Tissue Simulation* (IEEE EMBC 2013).
"""

from .activation import Activation
from .anisotropy import Orthotropic, TransverselyIsotropic
from .body import SoftBody
from .domain import Domain
from .elasticity import Corotated, EdgeStVK, Linear, MassSpring, NeoHookean, StVenantKirchhoff
from .errors import InputError, StabilityWarning, UnstableError
from .io.animate import record
from .materials import Isotropic
from .mesh import SurfaceMesh, TetForest, TetMesh
from .rotations import polar_rotation
from .simulation import Energy, Simulation
from .solvers import SymplecticEuler

__version__ = "0.1.0"

__all__ = [
    "Activation",
    "Corotated",
    "Domain",
    "EdgeStVK",
    "Energy",
    "InputError",
    "Isotropic",
    "Linear",
    "MassSpring",
    "NeoHookean",
    "Orthotropic",
    "Simulation",
    "SoftBody",
    "StVenantKirchhoff",
    "StabilityWarning",
    "SurfaceMesh",
    "SymplecticEuler",
    "TetForest",
    "TetMesh",
    "TransverselyIsotropic",
    "UnstableError",
    "polar_rotation",
    "record",
]
