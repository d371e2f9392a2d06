"""Small motions are not noise: an undamped beam keeps its energy, however little it moves.

The paper's beam, 64 x 64 x 192 mm, of soft tissue (5 kPa, nu = 0.49, 1000 kg/m^3), is held at z = 0 and set off
sideways with v = a (z / L)^2. Symplectic Euler keeps the energy of an undamped body but for an oscillation of the order
of the step; what rounding adds to that grows with the number of steps, and with the strain's rounding over the strain.
"""

import numpy as np
import pytest
from cases import CUBE, jittered
from fibres import MUSCLE

import warp_corot as wc

LENGTH = 3 * CUBE
TISSUE = {"young": 5e3, "poisson": 0.49, "density": 1000.0}

MODELS = {
    "linear": wc.Linear(),
    "stvk": wc.StVenantKirchhoff(),
    "neo-hookean": wc.NeoHookean(),
    "edge-stvk": wc.EdgeStVK(),
    "edge-stvk, quadratic": wc.EdgeStVK(springs="quadratic"),
    "mass-spring": wc.MassSpring(),
    "corotated": wc.Corotated(),
    "corotated, leaf by leaf": wc.Corotated(subtrees=False),
    "corotated, svd": wc.Corotated(rotation="svd"),
    "corotated, warm": wc.Corotated(rotation="warm"),
    "corotated, sparse": wc.Corotated(stiffness="sparse"),
    "corotated, 3 levels up": wc.Corotated(rotation_level=3),
    "corotated, 4 levels up": wc.Corotated(rotation_level=2),
    "corotated, 1 level up": wc.Corotated(rotation_level=5),
    "muscle": wc.Corotated(),
}
