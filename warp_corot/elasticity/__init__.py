"""Elastic models, one file each, all from the same Young's modulus and Poisson's ratio. List new ones here."""

from warp_corot.elasticity.corotated.model import Corotated

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

MODELS: dict[str, type[Model]] = {
    "linear": Linear,
    "corotated": Corotated,
    "stvk": StVenantKirchhoff,
    "neo-hookean": NeoHookean,
    "ogden": Ogden,
    "holzapfel-gasser-ogden": HolzapfelGasserOgden,
    "prony": Prony,
    "prestressed": Prestressed,
    "edge-stvk": EdgeStVK,
    "mass-spring": MassSpring,
}

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
