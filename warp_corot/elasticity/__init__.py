"""Elastic models, one file each, all from the same Young's modulus and Poisson's ratio. List new ones here."""

from warp_corot.elasticity.corotated.model import Corotated
from warp_corot.inputs import choices

from .edge_stvk import EdgeStVK
from .fibres import HolzapfelGasserOgden
from .linear import Linear
from .mass_spring import MassSpring
from .model import ForceField, Model
from .neo_hookean import NeoHookean
from .ogden import Ogden
from .prestress import Prestressed
from .prony import Prony
from .stvk import StVenantKirchhoff

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
