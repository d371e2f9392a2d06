"""Elastic models: a small description of each, and the force field of a model on a discretization."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Generic, Protocol, TypeAlias, TypeVar, cast

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.discretization import Discretization, Discretized, discretization_of
from warp_corot.discretization.groups import Members
from warp_corot.discretization.plan import Batch, Plan
from warp_corot.elasticity.divided import DividedForces, Piece
from warp_corot.elasticity.tangents import ElementTangent, Tangent
from warp_corot.errors import InputError
from warp_corot.inputs.cpu_threads import Regions, Team, launch
from warp_corot.inputs.loading import LoadedKernel, load
from warp_corot.kernels.corotated.anisotropic import FibreMaterial, ReinforcedMaterial
from warp_corot.kernels.corotated.tangent import KeptStrains
from warp_corot.kernels.elements.added import Prestress, PronyMaterial
from warp_corot.kernels.elements.constitutive import IsotropicMaterial, RotatedMaterial
from warp_corot.kernels.elements.dilatation import DilatedMaterial
from warp_corot.kernels.elements.forces import (
    element_energies,
    element_von_mises,
    scatter_forces,
)

if TYPE_CHECKING:
    from warp_corot.elasticity.clusters import ClusterScatter
    from warp_corot.elasticity.cpu import Dilating
    from warp_corot.kernels.stepping.pace import Pace


S = TypeVar("S")


class Kept(Generic[S]):
    """A Warp struct of some values, made again if one of these is another object.

    Args:
        Struct: Its type.
        fields: The names of the values in it, in the order in which they are given.
    """

    def __init__(self, Struct: type[S], *fields: str):
        self._Struct, self._fields = Struct, fields
        self._values: tuple = ()
        self._made: S | None = None

    def __call__(self, *values: object) -> S:
        if self._made is None or any(a is not b for a, b in zip(values, self._values, strict=True)):
            self._values, self._made = values, self.made(*values)
        return self._made

    def made(self, *values: object) -> S:
        """A new one."""
        made = self._Struct()
        for name, value in zip(self._fields, values, strict=True):
            setattr(made, name, value)
        return made


#: The fields of materials.
ISOTROPIC, ROTATED = ("mu", "lam", "stride"), ("isotropic", "rotations", "unit")


def isotropic_material(given: list) -> IsotropicMaterial:
    """``kernels.elements.constitutive.IsotropicMaterial`` of mu, lambda and their stride."""
    return Kept(IsotropicMaterial, *ISOTROPIC)(*given)


# --- laws for derivatives --------------------------------------------------------------------------------------------


#: Structs of materials.
ElementMaterial: TypeAlias = (
    "IsotropicMaterial | RotatedMaterial | KeptStrains | FibreMaterial | ReinforcedMaterial | PronyMaterial "
    "| Prestress | DilatedMaterial"
)


@dataclass(frozen=True)
class StressLaw:
    """First Piola-Kirchhoff stress of a law in each element.

    Attributes:
        stress: Device function (elements, t, material, u) -> P, see ``kernels.elements.forces``.
        differential: Its exact derivative (elements, t, material, u, dg) -> dP, as
            ``kernels.elements.forces`` takes it.
        material: The struct that both read.
        Material: Its type; for ``IsotropicMaterial`` the stress is linear in Lamé's parameters.
        sees_shape: Whether the stress depends on an element's rest shape besides its deformation gradient.
    """

    stress: wp.Function
    differential: wp.Function
    material: ElementMaterial
    Material: type = IsotropicMaterial
    sees_shape: bool = False


# --- force fields and models -----------------------------------------------------------------------------------------


class SmallForces(Protocol):
    """Forces of small displacements from any source."""

    def add_forces(self, u: wp.array, f: wp.array) -> None:
        """Add the forces [N] of displacements u to f; both vec4, one entry for each node."""
        ...

    def state_kept(self) -> AbstractContextManager[None]:
        """Inside, launches do not change the state from which steps continue."""
        ...


class FastForces(ABC):
    """The launches of a law's forces, many elements at a time; see ``ForceField`` for what the methods do.

    Attributes:
        in_clusters: As of ``ForceField``.
    """

    in_clusters: tuple[ClusterScatter, Sequence[Batch]] | None = None

    @property
    @abstractmethod
    def kernels(self) -> list[LoadedKernel]:
        """The kernels that launches take."""

    @property
    def later_kernels(self) -> list[LoadedKernel]:
        """Those that they may take if the mesh changes."""
        return self.kernels

    @abstractmethod
    def scatter_forces(self, u: wp.array, f: wp.array) -> None:
        """Launch the forces [N] of displacements u, added to f; both vec4 [N]."""

    @abstractmethod
    def follow(self) -> None: ...

    def derive(self) -> None:  # noqa: B027 (most keep nothing)
        ...

    def pieces(self, team: Team) -> Sequence[Piece]:
        return []

    def share_dilatation(self, dilating: Dilating) -> bool:
        return False


class ForceField(ABC):
    """An elastic model on one body: launches that read displacements and add forces.

    Methods only launch; they do not wait for the device, except those that return energies or stresses on the host.

    Args:
        body: A body, or its discretization.
        deterministic: Whether forces must be reproducible bit by bit even on CUDA, where threads run in any order;
            kernels then first write them to ``slots``.

    Attributes:
        plan: The units of work of launches.
        elements: All elements of the plan.
        is_linear: Whether forces are linear in displacements.
        shares_dilatation: Whether elements share their dilatation.

    Raises:
        InputError: The body's material is anisotropic, and the field supports only isotropic ones.
    """

    takes_anisotropic: ClassVar[bool] = False
    is_linear: bool = False
    shares_dilatation: ClassVar[bool] = False
    #: The launches of many elements at a time; None: element by element. Threads can divide those on the CPU.
    _fast: FastForces | None = None
    _divided: DividedForces | None = None

    def __init__(self, body: Discretized | Discretization, deterministic: bool = False):
        discretization = discretization_of(body)
        if discretization.is_anisotropic and not self.takes_anisotropic:
            name = type(discretization.material).__name__
            only = "HolzapfelGasserOgden" if name == "FibreReinforced" else "Corotated"
            raise InputError(f"the material is {name}; only the model {only} supports this material")
        self.discretization = discretization
        self.device = discretization.device
        #: On the CPU there is one thread, and the order is always the same.
        self.deterministic = deterministic and discretization.device.is_cuda
        self._isotropic = Kept(IsotropicMaterial, *ISOTROPIC)
        self._regions = Regions(discretization.team, self.device)
        self.plan = self.plan_of(discretization)
        self.elements, self.slots = self.plan.elements, self.plan.slots

    @property
    def find_members(self) -> Callable[[int], Members] | None:
        """A function that returns the groups of elements below a number that share their dilatation; None without
        groups.
        """
        return None

    def divide(self) -> None:
        """Let the threads of the discretization's team add the forces from now on, if the field can divide them; not
        while launches are recorded."""
        team = self.discretization.team
        pieces = self.pieces(team) if team.parts > 1 else []
        count = self.discretization.sizes.launch_nodes
        self._divided = DividedForces(team, pieces, count) if pieces else None

    def pieces(self, team: Team) -> Sequence[Piece]:
        """Parts of the field whose forces add up to this one's; none if it cannot be divided."""
        return [] if self._fast is None else self._fast.pieces(team)

    def add_forces(self, u: wp.array, f: wp.array) -> None:
        """Add the elastic nodal forces [N] of displacements u to f; both vec4 [worlds * N]."""
        if self._divided is not None:
            self._divided.add_forces(u, f)
        elif self.slots is None:
            self.scatter_forces(u, f)
        else:
            self.slots.values.zero_()
            self.scatter_forces(u, self.slots.values)
            self.slots.gather(f)

    @abstractmethod
    def scatter_forces(self, u: wp.array, f: wp.array) -> None:
        """Launch the kernels that add the forces to the nodes, or to the slots if there are any."""

    def tangent(self, *, exact: bool = False) -> Tangent:
        """The stiffness K(u), minus the derivative of the elastic forces, for many products at the same displacements.

        K is symmetric, and may be indefinite. Sums are atomic: on CUDA rounding differs from call to call, even if
        forces are deterministic.

        Args:
            exact: Whether K must be the exact derivative, if the field has two stiffnesses; see ``CorotatedField``.
        """
        law = self.stress_law
        assert law is not None
        return ElementTangent(self, law.differential, lambda: cast("StressLaw", self.stress_law).material, law.Material)

    def definite_tangent(self) -> Tangent:
        """A positive semidefinite K(u) where the field has one, otherwise ``tangent``."""
        return self.tangent()

    def add_stiffness(self, u: wp.array, p: wp.array, y: wp.array, *, exact: bool = False) -> None:
        """Add K(u) p to y [N], of displacements u and p [m]; all vec4 [worlds * N].

        For many products at the same u, keep a ``tangent``.
        """
        tangent = self.tangent(exact=exact)
        tangent.prepare(u)
        tangent.take(u)
        tangent.add_product(p, y)

    def plan_of(self, discretization: Discretization) -> Plan:
        """The plan of the field; by default the elements one by one."""
        return discretization.plan(subtrees=False, deterministic=self.deterministic)

    @property
    def kernels(self) -> list[LoadedKernel]:
        """Kernels of factories that steps on the CPU launch; each that is named is loaded beside others."""
        return []

    def load_kernels(self) -> None:
        """Load every kernel that a later plan may need, so that none is compiled during steps.

        Called before the first step if plans change.
        """
        if self._fast is not None:
            load((), self.device, self._fast.later_kernels)

    def note(self) -> None:  # noqa: B027 (most keep nothing)
        """Launch the update of the data that elements carry; called before a pass changes the mesh."""

    def derive(self) -> None:
        """Launch the update of the field's data of elements, if the plan has changed; may be recorded.

        Called if plans change, each time after one is derived.
        """
        if self._fast is not None:
            self._fast.derive()

    def follow(self) -> None:
        """Adapt launches to the present sizes of the plan.

        Called if plans change, before steps are recorded, whenever a size has changed.
        """
        if self._fast is not None:
            self._fast.follow()

    def share_dilatation(self, dilating: Dilating) -> bool:
        """Add the forces of a dilatation that subtrees and groups share, too, from now on (CPU); return whether the
        field can.
        """
        return self._fast is not None and self._fast.share_dilatation(dilating)

    @property
    def stiffest(self) -> SmallForces:
        """Forces near rest that bound the step: these, or stiffer ones if the field becomes stiffer under strain."""
        return self

    @abstractmethod
    def write_energies(self, u: wp.array, energies: wp.array) -> None:
        """Write strain energies whose sum is the body's [J], world after world; float64."""

    def write_potentials(self, u: wp.array, energies: wp.array) -> None:
        """Write the energies [J] whose negative gradient is the forces, like ``write_energies``. They include the
        energy of an active stress that stays constant.
        """
        self.write_energies(u, energies)

    @abstractmethod
    def write_von_mises(self, u: wp.array, stress: wp.array) -> None:
        """Write the von Mises stress of each element [Pa], float32 [T]."""

    @property
    def stress_law(self) -> StressLaw | None:
        """The law's stress in each element, for derivatives; None if forces do not come from stresses."""
        return None

    @property
    def element_count(self) -> int:
        """Number of elements in launches; elements beyond the body's do nothing."""
        return self.discretization.sizes.launch_elements

    @property
    def energy_count(self) -> int:
        """Number of energies that ``write_energies`` writes."""
        return self.element_count

    @property
    def state(self) -> dict[str, wp.array]:
        """Arrays that must be saved so that steps continue in the same way."""
        return {}

    @property
    def elapsed(self) -> wp.array | None:
        """Seconds since the time of the stored state, float32 [1], if forces depend on it; steppers set it."""
        return None

    def complete_step(self, u: wp.array, pace: Pace) -> None:  # noqa: B027 (most keep nothing)
        """Launch the update at the end of a step of the clock's length, at displacements u; may be recorded."""

    def relax_fully(self) -> None:  # noqa: B027 (most keep nothing)
        """Make forces those after an infinite time, from now on."""

    @contextmanager
    def state_kept(self) -> Iterator[None]:
        """Inside, launches do not change the state from which steps continue."""
        kept = {name: wp.clone(array) for name, array in self.state.items()}
        try:
            yield
        finally:
            for name, array in self.state.items():
                wp.copy(array, kept[name])

    def reset(self, chosen: wp.array) -> None:  # noqa: B027 (most have no state)
        """Forget the state of chosen worlds, nonzero in int32 [worlds]."""

    def elastic_forces(self, u: wp.array) -> wp.array:
        """Elastic nodal forces [N] of displacements u, a new vec4 [worlds * N]."""
        f = wp.zeros_like(u)
        with self.state_kept():
            self.add_forces(u, f)
        return f

    def elastic_energy(self, u: wp.array) -> float:
        """Strain energy of the body in all worlds together [J]."""
        return float(self.elastic_energies(u).sum())

    def elastic_energies(self, u: wp.array, clear: Callable[[wp.array], None] | None = None) -> npt.NDArray[np.float64]:
        """Strain energy of the body in each world [J], float64 [worlds]; ``clear`` resets those of elements that do not
        count."""
        return self._sums(self.write_energies, u, clear)

    def potentials(self, u: wp.array) -> npt.NDArray[np.float64]:
        """The energy of ``write_potentials`` in each world [J], float64 [worlds]."""
        return self._sums(self.write_potentials, u)

    def _sums(
        self,
        write: Callable[[wp.array, wp.array], None],
        u: wp.array,
        clear: Callable[[wp.array], None] | None = None,
    ) -> npt.NDArray[np.float64]:
        energies = wp.zeros(self.energy_count, dtype=wp.float64, device=self.device)
        with self.state_kept():
            write(u, energies)
        if clear is not None:
            clear(energies)
        return energies.numpy().reshape(self.discretization.worlds, -1).sum(axis=1)

    def von_mises(self, u: wp.array) -> npt.NDArray[np.float32]:
        """Von Mises stress of each element [Pa], float32 [T]."""
        stress = wp.zeros(self.element_count, dtype=wp.float32, device=self.device)
        with self.state_kept():
            self.write_von_mises(u, stress)
        return stress.numpy()[: self.discretization.sizes.elements]

    @property
    def in_clusters(self) -> tuple[ClusterScatter, Sequence[Batch]] | None:
        """The launch of elements in clusters, and the subtrees outside them; None without clusters, or if clusters
        change.
        """
        return None if self._fast is None else self._fast.in_clusters

    def launch(self, kernel: wp.Kernel, dim: int | tuple[int, ...], inputs: list, outputs: list) -> None:
        launch(kernel, dim, inputs, outputs, device=self.device)

    def _launch_over_elements(
        self, kernel: wp.Kernel, material: ElementMaterial, u: wp.array, output: wp.array
    ) -> None:
        """Launch a kernel that writes a number of each element, or adds to it."""
        self._regions.launch_over(
            kernel,
            self.element_count,
            lambda _, own: ([own(self.elements), own(material), u], [own(output)]),
            u.ptr,
            output.ptr,
        )

    @property
    def isotropic(self) -> IsotropicMaterial:
        """Lamé's parameters for forces and energies, scaled by the filled share of each element."""
        discretization = self.discretization
        return self._isotropic(discretization.mu, discretization.lam, discretization.material_stride)

    @property
    def isotropic_shown(self) -> IsotropicMaterial:
        """Lamé's parameters for stresses: those of the material."""
        return isotropic_material(list(self.discretization.lame))


class Model(ABC):
    """The description of an elastic model: a frozen dataclass of plain values.

    Class attributes:
        step_safety: Default fraction of the stable step at small strains.
        strained_safety: Default fraction at large strains, where stiffness can change before the next measurement.
    """

    step_safety: ClassVar[float] = 0.9
    strained_safety: ClassVar[float] = 0.6

    @abstractmethod
    def bind(self, body: Discretized | Discretization, *, deterministic: bool = False) -> ForceField:
        """The model's force field on a discretization.

        Args:
            deterministic: Whether forces must be the same bit by bit every time, even on CUDA.

        Raises:
            InputError: The model does not support this body's mesh or material.
        """

    @property
    def carried(self) -> tuple[str, ...]:
        """Names of the force field's numbers for each element, which elements carry when the mesh changes."""
        return ()

    @property
    def kept_of_elements(self) -> str | None:
        """The data of elements in the force field, for a message; None if the field supports a change of elements.

        A body whose elements change cannot have a model that keeps data of them.
        """
        return None


class ElementField(ForceField):
    """Force field of device functions of each element's nodal displacements, element by element.

    Args:
        body, deterministic: As for every field.
        stress, density, cauchy: The functions of ``kernels.elements.forces``.
        differential: The differential of the stress, one of ``kernels.elements.forces``.
        Material: The struct that they read.
    """

    def __init__(
        self,
        body: Discretized | Discretization,
        *,
        stress: wp.Function,
        differential: wp.Function,
        density: wp.Function,
        cauchy: wp.Function,
        Material: type = IsotropicMaterial,
        deterministic: bool = False,
    ):
        super().__init__(body, deterministic)
        kind = self.discretization.element_kind
        self._functions, self._Material = (stress, differential), Material
        self._energies = element_energies(kind, Material, density)
        self._von_mises = element_von_mises(kind, Material, cauchy)

    @property
    def material(self) -> ElementMaterial:
        """The struct for forces and energies."""
        return self.isotropic

    @property
    def material_shown(self) -> ElementMaterial:
        """The struct for stresses."""
        return self.isotropic_shown

    @property
    def kernels(self) -> list[LoadedKernel]:
        return [*self._force_kernels, self._energies, self._von_mises]

    @property
    def _force_kernels(self) -> list[LoadedKernel]:
        return [self._forces] if self._fast is None else self._fast.kernels

    @property
    def _forces(self) -> wp.Kernel:
        return scatter_forces(self.discretization.element_kind, self._Material, self._functions[0])

    @property
    def stress_law(self) -> StressLaw:
        return StressLaw(*self._functions, self.material, self._Material)

    def scatter_forces(self, u: wp.array, f: wp.array) -> None:
        if self._fast is not None:
            self._fast.scatter_forces(u, f)
        else:
            self.launch(self._forces, self.element_count, [self.elements, self.material, u], [f])

    def write_energies(self, u: wp.array, energies: wp.array) -> None:
        self._launch_over_elements(self._energies, self.material, u, energies)

    def write_von_mises(self, u: wp.array, stress: wp.array) -> None:
        self.launch(self._von_mises, self.element_count, [self.elements, self.material_shown, u], [stress])
