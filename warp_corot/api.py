"""The names that ``import warp_corot`` gives."""

from .activation import Activation
from .anisotropy import Orthotropic, TransverselyIsotropic
from .body import SoftBody
from .domain import Domain
from .elasticity import Corotated, EdgeStVK, Linear, MassSpring, NeoHookean, StVenantKirchhoff
from .energy import Energy, WorldEnergies
from .errors import CapacityWarning, InputError, StabilityWarning, StaleViewError, UnstableError
from .io.animate import record
from .materials import Isotropic
from .mesh import SurfaceMesh, TetForest, TetMesh
from .remesh.online import OnlineRemesh
from .rotations import polar_rotation
from .simulation import Simulation
from .solvers import SymplecticEuler

__all__ = [
    "Activation",
    "CapacityWarning",
    "Corotated",
    "Domain",
    "EdgeStVK",
    "Energy",
    "InputError",
    "Isotropic",
    "Linear",
    "MassSpring",
    "NeoHookean",
    "OnlineRemesh",
    "Orthotropic",
    "Simulation",
    "SoftBody",
    "StVenantKirchhoff",
    "StabilityWarning",
    "StaleViewError",
    "SurfaceMesh",
    "SymplecticEuler",
    "TetForest",
    "TetMesh",
    "TransverselyIsotropic",
    "UnstableError",
    "WorldEnergies",
    "polar_rotation",
    "record",
]
