"""The names that ``import warp_corot`` gives."""

from warp_corot.body.keyframes import Activation
from warp_corot.body.soft_body import SoftBody
from warp_corot.contact.grasp import Grasp
from warp_corot.contact.options import Contact
from warp_corot.contact.shapes import Box, Capsule, Cylinder, Ground, SignedDistance, Sphere, TriangleMesh
from warp_corot.contact.tool import Tool
from warp_corot.cutting.blade import Blade, Plane
from warp_corot.elasticity.polar import polar_rotation
from warp_corot.gradients.run import RunGradient, run_gradient
from warp_corot.gradients.static import StaticGradient, static_gradient
from warp_corot.io.write.animate import record
from warp_corot.materials.anisotropic import FibreReinforced, Orthotropic, TransverselyIsotropic
from warp_corot.materials.isotropic import Isotropic
from warp_corot.remesh.remeshing import OnlineRemesh
from warp_corot.simulation.energy import Energy, WorldEnergies
from warp_corot.simulation.progress import show_progress
from warp_corot.simulation.simulation import Simulation
from warp_corot.simulation.static import StaticReport, solve_static
from warp_corot.viewing.view import view

from . import haptics, remesh
from .domain import Domain
from .elasticity import (
    Corotated,
    EdgeStVK,
    HolzapfelGasserOgden,
    Linear,
    MassSpring,
    NeoHookean,
    Ogden,
    Prestressed,
    Prony,
    StVenantKirchhoff,
)
from .errors import CapacityWarning, ConvergenceError, InputError, StabilityWarning, StaleViewError, UnstableError
from .frameworks import jax, torch
from .mesh import SurfaceMesh, TetForest, TetMesh
from .solvers import BDF2, BackwardEuler, GeneralizedAlpha, Newmark, QuasiStatic, SymplecticEuler

__all__ = [
    "BDF2",
    "Activation",
    "BackwardEuler",
    "Blade",
    "Box",
    "CapacityWarning",
    "Capsule",
    "Contact",
    "ConvergenceError",
    "Corotated",
    "Cylinder",
    "Domain",
    "EdgeStVK",
    "Energy",
    "FibreReinforced",
    "GeneralizedAlpha",
    "Grasp",
    "Ground",
    "HolzapfelGasserOgden",
    "InputError",
    "Isotropic",
    "Linear",
    "MassSpring",
    "NeoHookean",
    "Newmark",
    "Ogden",
    "OnlineRemesh",
    "Orthotropic",
    "Plane",
    "Prestressed",
    "Prony",
    "QuasiStatic",
    "RunGradient",
    "SignedDistance",
    "Simulation",
    "SoftBody",
    "Sphere",
    "StVenantKirchhoff",
    "StabilityWarning",
    "StaleViewError",
    "StaticGradient",
    "StaticReport",
    "SurfaceMesh",
    "SymplecticEuler",
    "TetForest",
    "TetMesh",
    "Tool",
    "TransverselyIsotropic",
    "TriangleMesh",
    "UnstableError",
    "WorldEnergies",
    "haptics",
    "jax",
    "polar_rotation",
    "record",
    "remesh",
    "run_gradient",
    "show_progress",
    "solve_static",
    "static_gradient",
    "torch",
    "view",
]
