"""Names and defaults that the Python interface and the command's help share; help imports neither Warp nor NumPy."""

from __future__ import annotations

#: Elastic models, and their classes in ``warp_corot.elasticity``.
MODELS = {
    "linear": "Linear",
    "corotated": "Corotated",
    "stvk": "StVenantKirchhoff",
    "neo-hookean": "NeoHookean",
    "ogden": "Ogden",
    "holzapfel-gasser-ogden": "HolzapfelGasserOgden",
    "prony": "Prony",
    "prestressed": "Prestressed",
    "edge-stvk": "EdgeStVK",
    "mass-spring": "MassSpring",
}
#: Time integrators, and their classes in ``warp_corot.solvers``.
INTEGRATORS = {
    "symplectic-euler": "SymplecticEuler",
    "backward-euler": "BackwardEuler",
    "newmark": "Newmark",
    "bdf2": "BDF2",
    "generalized-alpha": "GeneralizedAlpha",
    "quasi-static": "QuasiStatic",
}
#: Whether elements share their dilatation.
AUTO, ELEMENT, SHARED = "auto", "element", "shared"
#: Online remeshing: thresholds of the elongation of an element's longest edge, and steps between passes.
REFINE_ABOVE, SIMPLIFY_BELOW, REMESH_EVERY = 1.25, 1.08, 10
