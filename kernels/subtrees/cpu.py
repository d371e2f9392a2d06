"""Forces of complete subtrees on the CPU: eight subtrees side by side in the lanes of vector registers.

A CPU core is fast only with vector instructions. So the ten nodes of eight subtrees of one type are gathered into
arrays of lanes, a loop computes the eight leaves, and forces are scattered once at the end. The laws are those of
``elements.law_lanes``. A bit flags each leaf or subtree that the corotated law leaves out.

``elements.lanes`` says why this is native code; ``lanes`` generates a part of it.
"""

import functools

import warp as wp

from warp_corot.kernels.corotated.tangent import RotatedMaterial
from warp_corot.kernels.elements.constitutive import IsotropicMaterial
from warp_corot.kernels.elements.dilatation import Dilatation
from warp_corot.kernels.elements.dilatation_lanes import law_of
from warp_corot.kernels.elements.elements import Subtrees
from warp_corot.kernels.elements.lanes import ISOTROPIC, ISOTROPIC_PART, native, scatter_lanes
from warp_corot.kernels.elements.law_lanes import LAWS, ROTATION, LawInLanes, code_of, has_log

from .lanes import begin, near_test, product

wp.set_module_options({"enable_backward": False})


@wp.struct
class NearMaterial:
    """Lamé's parameters [Pa], and the tolerance within which leaves use the root's rotation [rad]."""

    isotropic: IsotropicMaterial
    tolerance: float


@wp.struct
class DilatingMaterial:
    """A material whose leaves share their dilatation; the tolerance is as in ``NearMaterial``.

    ``lam`` [Pa] belongs to the shared dilatation; lambda is zero in ``isotropic``.
    """

    isotropic: IsotropicMaterial
    tolerance: float
    lam: wp.array[wp.float32]


def joining(law: LawInLanes, shared: Dilatation | None) -> str:
    """Native code that adds the shared dilatation to a law, or the law alone if there is none."""
    if shared is None:
        return native("own_leaves")
    return law_of(shared, has_log=has_log(law)) + "const auto& dilating = material.lam;\n" + native("shared_dilatation")


@functools.cache
def scatter_law_subtrees(shape: int, law: LawInLanes = "corotated", shared: Dilatation | None = None) -> wp.Kernel:
    """Forces of subtrees under a law of ``elements.law_lanes``, each leaf on its own; a thread is eight subtrees.

    With a shared dilatation the material is a ``DilatingMaterial``.
    """
    flags = ["left_out_leaves"] if law == "corotated" else []
    leaves = joining(law, shared) + "const masks8 done = {};\n" + native("leaves", "subtree_forces", *flags)
    if shared is None:
        return scatter_lanes(code_of(law) + ISOTROPIC + begin(shape) + leaves, Subtrees, IsotropicMaterial, wp.uint8)
    return scatter_lanes(code_of(law) + ISOTROPIC_PART + begin(shape) + leaves, Subtrees, DilatingMaterial, wp.uint8)


@functools.cache
def scatter_subtrees_shared(shape: int, given: bool) -> wp.Kernel:
    """Corotated forces of subtrees with their root's rotation or a given one; a thread is eight subtrees."""
    rotation = "given_rotation" if given else "root_rotation"
    forces = native("shared_rotation", rotation, "shared_leaves", "subtree_forces", "left_out_leaves")
    code = ROTATION + ISOTROPIC_PART + begin(shape) + product(shape) + forces
    return scatter_lanes(code, Subtrees, RotatedMaterial, wp.uint8)


@functools.cache
def scatter_subtrees_near(shape: int, shared: Dilatation | None = None) -> wp.Kernel:
    """Corotated forces of subtrees, with the root's rotation where it is near those of the leaves; a thread is eight
    subtrees.

    It is near if the displacement gradient E that it leaves in each leaf has |skew E| <= tolerance [rad] and
    |sym E| <= 1/2, and the subtree as one element is strained by no more than 1/2. Then F = I + E = exp(w) U with
    |w| <= 2 tolerance, and the error of the stress is at most (2 mu + 3 lambda) (3 |w| |U - I| + |w|^2 |U|).
    Otherwise every leaf has its own rotation, and the forces are bit for bit those of ``scatter_law_subtrees``. With a
    shared dilatation the material is a ``DilatingMaterial``.
    """
    code = LAWS["corotated"] + native("rotation") + ISOTROPIC_PART + begin(shape) + product(shape) + near_test(shape)
    code += (
        joining("corotated", shared)
        + native("shared_rotation", "near_leaves")
        + f"if (any(~done)) {{\n{native('leaves')}}}"
    )
    code += "\n" if shared is None else f" else {{\n{native('dilatation')}}}\n"
    material = NearMaterial if shared is None else DilatingMaterial
    return scatter_lanes(code + native("subtree_forces", "left_out_leaves"), Subtrees, material, wp.uint8)
