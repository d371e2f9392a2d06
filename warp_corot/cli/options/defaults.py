"""Values of options that are not given, and the forms of values, which the help and the run share."""

from __future__ import annotations

FPS = 24.0
#: Default number of tetrahedra, approximately.
TETS = 20_000
BOX_LEVEL = 6
#: Young's modulus over the weight of a column as high as the body: such bodies sag by roughly a tenth of their height.
STIFFNESS_PER_WEIGHT = 20.0
#: With a level: the number of root cubes along the body's longest side.
CUBES_OF_LEVEL = 16
#: Maximum number of bisections of cubes with a surface error.
MAX_LEVEL_FOR_ERROR = 12
#: The step of implicit integrators if none is given [s].
IMPLICIT_DT = 0.01
#: The height of the ground that lies just below the bodies.
AUTO = "auto"
#: The form of a label or region and its material.
LABEL = "NAME[@NUMBER[+NUMBER...]]=YOUNG[:POISSON[:DENSITY]]"
#: Loads: number of values after PATCH.
LOADS = {"pull": 3, "twist": 1, "press": 1}
#: Views by name: azimuth and elevation [°].
VIEWS = {
    "corner": (35.0, 14.0),
    "front": (0.0, 0.0),
    "right": (90.0, 0.0),
    "back": (180.0, 0.0),
    "left": (-90.0, 0.0),
    "top": (0.0, 89.9),
    "bottom": (0.0, -89.9),
}
SIDES = ", ".join(VIEWS)
