"""The law of Holzapfel, Gasser and Ogden: a neo-Hookean matrix with one or two families of fibres that bear tension.

In the material's axes a family has the direction a = (cos angle, +-sin angle, 0), a dispersion kappa and the strain
    e = kappa (tr C - 3) + (1 - 3 kappa) (a . C a - 1) = 2 B : E,  B = kappa I + (1 - 3 kappa) a a^T,
with C = F^T F and Green's strain E. Its energy density is phi(e) = k1 / (2 k2) (exp(k2 e^2) - 1) where e > 0, and zero
elsewhere: P = F S with S = 2 phi'(e) B. Beyond e = sqrt(ln(100) / k2), where phi'' is a thousand times k1, phi is its
own Taylor polynomial of second order, so that the stiffness stays bounded. The law is in ``native/law_fibres.h``.
"""

from typing import Any

import warp as wp

from warp_corot.kernels.corotated.anisotropic import OrthotropicMaterial

from .constitutive import IsotropicMaterial, push_forward
from .elements import frame, local_gradient
from .forces import element_law
from .simd8 import FIBRES

wp.set_module_options({"enable_backward": False})


@wp.struct
class ReinforcedMaterial:
    """Lamé's parameters of the matrix, the fibres, and their active stress [Pa].

    The nine numbers of ``fibres.stiffness`` are k1 [Pa], k2, kappa and the angle [rad] of each element; others are not
    read. An angle of zero means one family.
    """

    matrix: IsotropicMaterial
    fibres: OrthotropicMaterial
    is_active: int
    activation: wp.array[wp.float32]


#: Matrix, fibres and active stress together.
REINFORCED = element_law(FIBRES.code, ReinforcedMaterial)
_IN_TISSUE = element_law("corot::fibres<false>(material)", ReinforcedMaterial)
_stress_in_tissue = _IN_TISSUE.stress


@wp.func
def reinforced_cauchy(elements: Any, t: int, material: ReinforcedMaterial, u: wp.array[wp.vec4]):
    """Elastic and active stress together, in the tissue itself, also where an element is only partly filled."""
    f = frame(elements, t) + local_gradient(elements, t, u)
    return push_forward(f, _stress_in_tissue(elements, t, material, u))
