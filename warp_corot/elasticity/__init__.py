"""Elastic models, all from the same Young's modulus and Poisson's ratio. List new ones here."""

from warp_corot.inputs import choices

from .added_stress import Prestressed, Prony
from .anisotropic import HolzapfelGasserOgden
from .corotated.model import Corotated
from .laws import Linear, NeoHookean, Ogden, StVenantKirchhoff
from .model import ForceField, Model
from .springs import EdgeStVK, MassSpring

MODELS: dict[str, type[Model]] = {name: globals()[kind] for name, kind in choices.MODELS.items()}

__all__ = [
    "MODELS",
    "Corotated",
    "EdgeStVK",
    "ForceField",
    "HolzapfelGasserOgden",
    "Linear",
    "MassSpring",
    "Model",
    "NeoHookean",
    "Ogden",
    "Prestressed",
    "Prony",
    "StVenantKirchhoff",
]
