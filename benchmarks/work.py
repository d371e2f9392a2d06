"""Minimum memory traffic and operations of each stage, per tetrahedron.

Bytes: every array that the stage reads or writes counts once, as if each value came from memory exactly once; an array
that is added to is both read and written. Nodal arrays count by nodes per tetrahedron (one sixth in a large forest),
with 16 bytes for a node (vec4). The connectivity of a forest counts as the 35-node lists of complete six-level
subtrees, 2.2 bytes a tetrahedron, whatever path a stage takes; in stages of single elements it counts as four indices
and the shape code, 20 bytes.

Operations: additions, multiplications, divisions and roots of the formulas, one each, counted by hand below (a fused
multiply-add is two), without addressing, selection by type, or tests that fail.
"""

from __future__ import annotations

from warp_corot.kernels.elements.shapes import STIFFNESS_LAMBDA, STIFFNESS_MU, Coefficients

NODE = 16.0  # vec4
INDICES = 16.0
CODE = 4.0
ROTATION = 36.0
CONNECTIVITY = 35 * 4 / 64
ELEMENT = INDICES + CODE
GENERAL_ELEMENT = INDICES + 36.0 + 4.0  # rest matrix and volume
EDGE = 8.0 + 12.0 + 4.0  # ends, rest vector, stiffness

READ = NODE
ADD_TO = 2 * NODE

#: velocities, displacements and forces read and written, and the inverse mass
INTEGRATION_BYTES = 3 * ADD_TO + 4.0
#: force times inverse mass and gravity, times dt, added, damped (12 + 3), displacement (6)
INTEGRATION_FLOPS = 21.0


# --- operations -------------------------------------------------------------------------------------------------------

MATRIX_PRODUCT = 45.0
#: six inner products of columns and three ones taken off
SYMMETRIC_PRODUCT = 6 * 5 + 3.0
#: trace, lambda tr, two mu times six, three added
HOOKE = 2 + 1 + 6 + 3.0
COFACTOR = 27.0
DETERMINANT = 5.0  # with the cofactors there
FROBENIUS = 18.0
SCATTER = 12.0

#: zeta_0 and zeta_1 from two Frobenius norms, a determinant and roots
ROTATION_START = 2 * FROBENIUS + COFACTOR + DETERMINANT + 10
#: cofactors, determinant, two factors, nine times a x + b c, and the next zeta
ROTATION_STEP = COFACTOR + DETERMINANT + 3 + 27 + 4
#: the step's norm, where it is tested
ROTATION_TEST = 9 + FROBENIUS

ITERATIONS = 4


def rotation_flops(tested: bool) -> float:
    """Byers and Xu's iteration: four steps, as many as the tolerance needs at this jitter."""
    return ROTATION_START + ITERATIONS * ROTATION_STEP + (ITERATIONS - 1) * ROTATION_TEST * tested


def gradient_flops(shape: int) -> float:
    """G: nine differences, the third column's second difference of type 1, the roots of two of type 2, over h."""
    return 9 + (0, 3, 6)[shape] + 9.0


def force_flops(shape: int) -> float:
    """Nodal forces from the stress: nine products with V/h, then differences."""
    return 9 + (6, 9, 18)[shape]


#: nine differences and a product with the rest matrix; V times the stress and the last node's force
GENERAL_GRADIENT, GENERAL_FORCE = 9 + MATRIX_PRODUCT, 9 + MATRIX_PRODUCT + 6

TO_FRAME = MATRIX_PRODUCT
FRAME_ADDED = 9.0


def rotated_stress_flops() -> float:
    """sym(R^T F) - I, Hooke, R times that."""
    return SYMMETRIC_PRODUCT + HOOKE + MATRIX_PRODUCT


def matrix_flops(shape: int, skip_zeros: bool) -> float:
    """Turn three relative nodes in, multiply with K_T, turn the forces of three nodes out (the fourth is their sum)."""
    table = Coefficients(STIFFNESS_LAMBDA[shape], STIFFNESS_MU[shape]).table
    entries = sum(not skip_zeros or k >= 0 for row in table for k in row)
    return 3 * 15 + (2 * entries - 12) + 3 * 15 + 9


def model_flops(model: str, shape: int, rotation: float = 0.0) -> float | None:
    """Whole force of one element of the forest by a model of the oracle, scatter included."""
    outer = gradient_flops(shape) + force_flops(shape) + SCATTER
    inner = {
        "linear": TO_FRAME + 9 + HOOKE + MATRIX_PRODUCT,
        "corotated": FRAME_ADDED + rotation + rotated_stress_flops(),
        "stvk": FRAME_ADDED + SYMMETRIC_PRODUCT + 6 + HOOKE + MATRIX_PRODUCT,
        "neo_hookean": FRAME_ADDED + COFACTOR + DETERMINANT + 6 + 27,
    }
    return outer + inner[model] if model in inner else None


#: of one spring: difference, lengths, elongation, force, added at both ends
SPRING_FLOPS = 3 + 12 + 3 + 6 + 2 + 3 + 3 + 6.0
