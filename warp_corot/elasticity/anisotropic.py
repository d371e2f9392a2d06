"""Materials with directions: corotated elasticity of anisotropic ones, the law of Holzapfel, Gasser and Ogden, and
active stress along fibres."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import warp as wp

from warp_corot.discretization.discretization import Discretization, discretization_of
from warp_corot.discretization.plan import Plan
from warp_corot.elasticity.cpu import SimdForces
from warp_corot.elasticity.cuda import CudaForces, CudaLaw, no_subtrees
from warp_corot.elasticity.dilatation import AUTO, bind_law, check_dilatation
from warp_corot.elasticity.model import ElementField, ForceField, Kept, Model
from warp_corot.errors import InputError
from warp_corot.kernels.clusters.laws import ActiveMaterial, anisotropic_law, reinforced_law
from warp_corot.kernels.corotated.anisotropic import (
    REINFORCED,
    FibreMaterial,
    ReinforcedMaterial,
    active_density,
    fibre_cauchy,
    fibre_density,
    fibre_differential,
    fibre_stress,
    reinforced_cauchy,
)
from warp_corot.kernels.corotated.well_conditioned import quaternions_of
from warp_corot.kernels.elements.dilatation import LOG_VOLUME
from warp_corot.kernels.elements.forces import element_energies
from warp_corot.kernels.elements.simd8 import FIBRES, ORTHOTROPIC
from warp_corot.kernels.math.rotation import byers_xu, quick_rotation
from warp_corot.kernels.subtrees.anisotropic import repair_leaves, scatter_anisotropic_subtrees
from warp_corot.kernels.tables.cluster_layout import ANISOTROPIC
from warp_corot.materials.anisotropic import FibreReinforced, TransverselyIsotropic

if TYPE_CHECKING:
    from warp_corot.discretization.discretization import Discretized


class FibreField(ElementField):
    """Force field of a material with directions, along the first of which there may be an active stress.

    Args:
        discretization, functions: As for ``ElementField``.

    Attributes:
        passive: The material without the active stress.
    """

    takes_anisotropic: ClassVar[bool] = True

    def __init__(self, discretization: Discretization, **functions: Any):
        super().__init__(discretization, **functions)
        self.passive = discretization.anisotropic_material()
        self._fibres = Kept(FibreMaterial, "passive", "is_active", "activation")

    @property
    def fibres(self) -> FibreMaterial:
        """The material with directions, with the present active stress."""
        return self._fibres(self.passive, *self._activation)

    @property
    def _activation(self) -> list:
        return [int(self.discretization.has_activation), self.discretization.activation]

    def write_energies(self, u: wp.array, energies: wp.array) -> None:
        # In one part: ``part_of`` does not cut materials with directions.
        self.launch(self._energies, self.element_count, [self.elements, self.material, u], [energies])

    def write_potentials(self, u: wp.array, energies: wp.array) -> None:
        self.write_energies(u, energies)
        if self.discretization.has_activation:
            kernel = element_energies(self.discretization.element_kind, FibreMaterial, active_density, adds=True)
            self.launch(kernel, self.element_count, [self.elements, self.fibres, u], [energies])


#: Members of ``ActiveMaterial`` as the launches give them.
ACTIVE = "passive", "axes", "is_active", "activation"


class AnisotropicField(FibreField):
    """W = V/2 e : C : e with e = sym(R^T F) - I, R the element's own rotation, C fixed in rest space.

    The force is the gradient of W, with the derivative of R, which isotropic materials do not need, and conserves
    linear and angular momentum. If the rotation of F is ill-defined (F is inverted, or flattened to a sixth in two
    directions, as by fibres that stretch 3.4 times; see ``kernels.corotated.anisotropic``), C blends into that of the
    nearest isotropic material, and the force is the gradient of that energy.

    The active stress of ``SoftBody.activation`` is added: P = s (F d) d^T along the fibres' direction d. It conserves
    both momenta. It does work, and has no energy.

    The stiffness is exact, with the derivative of R, at the present active stress; it is bounded if the rotation of F
    is ill-defined (``kernels.corotated.tangent``). On the CPU eight subtrees or elements are computed at a time, on
    CUDA subtrees and clusters if sums may have any order, unless the model asks for other rotations.

    Args:
        discretization: A discretization with an ``Anisotropic`` material.
        rotation: The device function that finds rotations.
        deterministic: As for every field.
    """

    def __init__(self, discretization: Discretization, rotation: wp.Function, deterministic: bool):
        self._quick = rotation is quick_rotation and not (deterministic and discretization.device.is_cuda)
        super().__init__(
            discretization,
            stress=fibre_stress(rotation),
            differential=fibre_differential(rotation),
            density=fibre_density(rotation),
            cauchy=fibre_cauchy(rotation),
            Material=FibreMaterial,
            deterministic=deterministic,
        )
        if self._quick:
            stress, robust = self._functions[0], fibre_stress(byers_xu)
            if self.device.is_cpu:
                given = discretization, self.plan, ORTHOTROPIC, lambda: self.fibres
                self._fast = SimdForces(*given, FibreMaterial, robust)
            else:
                self._fast = CudaForces(self, self._cuda_law(stress))
                self.derive()

    def _cuda_law(self, stress: wp.Function) -> CudaLaw:
        """The law of subtrees and clusters, which read the axes as quaternions."""
        transverse = isinstance(self.discretization.material, TransverselyIsotropic)
        one_axes, one_stiffness = self.passive.axes_stride == 0, self.passive.stride == 0
        active = Kept(ActiveMaterial, *ACTIVE)
        self._quaternions = wp.empty(len(self.passive.axes), dtype=wp.quat, device=self.device)
        return CudaLaw(
            stress,
            lambda: self.fibres,
            FibreMaterial,
            lambda shape, grouped, _: scatter_anisotropic_subtrees(shape, grouped, transverse, one_axes, one_stiffness),
            anisotropic_law(transverse),
            lambda _: active(self.passive, self._quaternions, *self._activation),
            ActiveMaterial,
            ANISOTROPIC,
            repair_leaves,
        )

    def derive(self) -> None:
        super().derive()
        if self._quick and self.device.is_cuda:
            self.launch(quaternions_of, len(self._quaternions), [self.passive.axes], [self._quaternions])

    def plan_of(self, discretization: Discretization) -> Plan:
        subtrees = self._quick and (self.device.is_cpu or discretization.prefers_subtrees)
        return discretization.plan(subtrees=subtrees, deterministic=self.deterministic)

    @property
    def material(self) -> FibreMaterial:
        return self.fibres

    @property
    def material_shown(self) -> FibreMaterial:
        return self.fibres


# --- the law of Holzapfel, Gasser and Ogden, for tissue with families of fibres --------------------------------------


@dataclass(frozen=True)
class HolzapfelGasserOgden(Model):
    """W = V (W_neo-Hookean + sum over families of k1 / (2 k2) (exp(k2 e^2) - 1)) for tissue with fibres.

    The body's material must be ``FibreReinforced``: it has Young's modulus and Poisson's ratio of the matrix, and k1,
    k2, the dispersion kappa and the directions a of the fibres. e = kappa (tr C - 3) + (1 - 3 kappa) (a . C a - 1), C =
    F^T F; families with e < 0 carry no stress (Gasser, Ogden and Holzapfel 2006; with the whole C, so that fibres
    respond to changes of volume, as Nolan et al. 2014 recommend). The matrix is ``NeoHookean``, which bounds the
    stiffness of crushed and inverted elements; the stiffness of fibres is bounded at a thousand times k1 by a parabola
    beyond e = sqrt(4.6 / k2).

    Attributes:
        dilatation: Dilatation of the matrix: "element", "shared" or "auto", as for ``NeoHookean``.
    """

    dilatation: str = AUTO

    def __post_init__(self) -> None:
        check_dilatation(self.dilatation)

    def bind(self, body: Discretized | Discretization, *, deterministic: bool = False) -> ForceField:
        discretization = discretization_of(body)
        if not isinstance(discretization.material, FibreReinforced):
            name = type(discretization.material).__name__
            raise InputError(f"the material is {name}; for HolzapfelGasserOgden it must be FibreReinforced")
        return bind_law(ReinforcedField, LOG_VOLUME, self.dilatation, discretization, deterministic)


class ReinforcedField(FibreField):
    """The forces of ``HolzapfelGasserOgden``; on the CPU of eight subtrees or elements at a time."""

    def __init__(self, discretization: Discretization, deterministic: bool):
        super().__init__(
            discretization,
            stress=REINFORCED.stress,
            differential=REINFORCED.differential,
            density=REINFORCED.density,
            cauchy=reinforced_cauchy,
            Material=ReinforcedMaterial,
            deterministic=deterministic,
        )
        self._made, self._shown = (
            Kept(ReinforcedMaterial, "matrix", "fibres", "is_active", "activation") for _ in range(2)
        )
        if self.device.is_cpu:
            given = discretization, self.plan, FIBRES, lambda: self.material
            self._fast = SimdForces(*given, ReinforcedMaterial)
        else:
            leaves = REINFORCED.stress, lambda: self.material, ReinforcedMaterial
            law = CudaLaw(*leaves, no_subtrees, reinforced_law, FastMaterial=ReinforcedMaterial)
            self._fast = CudaForces(self, law)

    def plan_of(self, discretization: Discretization) -> Plan:
        return discretization.plan(subtrees=self.device.is_cpu, deterministic=self.deterministic)

    @property
    def material(self) -> ReinforcedMaterial:
        """The material with the present active stress."""
        return self._made(self.isotropic, self.passive, *self._activation)

    @property
    def material_shown(self) -> ReinforcedMaterial:
        return self._shown(self.isotropic_shown, self.passive, *self._activation)
