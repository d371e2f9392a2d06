"""Stresses of the constitutive laws for eight elements in the lanes of vector registers; see ``lanes``.

Each is a native function ``stress`` of the columns f of F, of E = C - I in the frame of these columns, of the frame's
handedness and of mu and lambda, which are already multiplied by the weight of P. It writes the columns p of P and says
in which lanes these may be trusted. ``find_strain`` and ``find_strain_there`` before it find E and f. E keeps its
digits however small it is, and everything is computed from E, so P keeps them, too.

The corotated law needs no rotation for that. With t = tr S - 3, j = J - 1 and the invariants a, b, c of E, t is the
largest root of the quartic (Cayley-Hamilton for S; x = t + 3 is the largest eigenvalue of Horn's 4x4 matrix)
    t^4 + 12 t^3 + (48 - 2a) t^2 + (64 - 12a - 8j) t + a^2 - 20a - 24j - 4b = 0
whose slope is 4q, q = 2 (s1 + s2)(s1 + s3)(s2 + s3) of the principal stretches: no root is better defined. From it come
R = ((x^2 + tr C) F + 2 x cof F - 2 F C) / q, for every F of which q is not small, flattened and turned over
too; and where E is small, with its digits,
    I - S^-1 = (n0 I + (8 + y) E - (6 + y) adj E) / q,  y = (2t - 6j) / J,
    n0 = t (18 + t (8 + t)) - a (10 + t) - 2j - y (1 + a),  and  P = F (2 mu (I - S^-1) + lambda t S^-1).
"""

import functools

from warp_corot.kernels.math.eigen import SWEEPS

from .constitutive import CONTINUED_BELOW
from .lanes import constants, native
from .ogden import part_of_volume, stretch_limits

#: q, 16 at rest, below which R is not trusted: the root has lost digits, or is about to meet another.
INDEFINITE = 1.0

#: E, polynomials of S, and the rotation of F.
ROTATION = constants(INDEFINITE=INDEFINITE) + native("strain", "invariants", "stretch", "rotation")

#: The neo-Hookean law behind code that finds E.
NEO_HOOKEAN = constants(CONTINUED_BELOW=CONTINUED_BELOW) + native("invariants", "log", "neo_hookean")

#: Native code of the laws by their names.
LAWS = {
    "corotated": constants(INDEFINITE=INDEFINITE) + native("strain", "invariants", "stretch", "corotated"),
    "linear": native("small_strain", "linear"),
    "stvk": native("strain", "stvk"),
    "neo-hookean": native("strain") + NEO_HOOKEAN,
}

#: A law in lanes: a name, or the terms (share, alpha) of Ogden's.
LawInLanes = str | tuple[tuple[float, float], ...]


def code_of(law: LawInLanes) -> str:
    """Native code of a law: a key of ``LAWS``, or Ogden's with these terms."""
    return LAWS[law] if isinstance(law, str) else _ogden(law)


def has_log(law: LawInLanes) -> bool:
    """Whether the code of a law has ``log_of``."""
    return law == "neo-hookean" or not isinstance(law, str)


@functools.cache
def _ogden(terms: tuple[tuple[float, float], ...]) -> str:
    slope = ""
    for share, alpha in terms:
        low, high = ((stretch**2 - 1.0) / 2.0 for stretch in stretch_limits(alpha))
        m = 2.0 * share / alpha
        rest = m - part_of_volume(share, alpha)
        numbers = constants(M=m, REST=rest, POWER=0.5 * alpha - 1.0, LOW=low, HIGH=high)
        slope += f"{{\n{numbers}{native('ogden_term')}}}\n"
    return (
        LAWS["neo-hookean"].replace("const auto stress", "const auto neo_hookean")
        + constants(SWEEPS=int(SWEEPS), VOLUME_PART=sum(part_of_volume(*term) for term in terms))
        + native("eigen", "exp")
        + "const auto slope_of = [&](const lanes8& e) {\nlanes8 slope = spread(0.0f);\n"
        + f"{slope}return slope;\n}};\n"
        + native("ogden")
    )
