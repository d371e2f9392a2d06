"""What every elastic model is: a small description, and the force field that it becomes on a body."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.elements import in_worlds, with_targets
from warp_corot.discretization.slots import Slots
from warp_corot.errors import InputError
from warp_corot.kernels.elements.forces import element_energies, element_von_mises, scatter_forces
from warp_corot.materials.anisotropic import Anisotropic

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody
    from warp_corot.discretization.changing.plan import DevicePlan
    from warp_corot.discretization.changing.pools import DeviceForest
    from warp_corot.solvers.steps.pace import Pace


class ForceField(ABC):
    """An elastic model on one body: launches that read displacements and add forces.

    Launches only; nothing here waits for the device or comes back to the host but ``elastic_energies``.

    Args:
        body: The body.
        deterministic: Whether forces must come out the same bit by bit every time, also on CUDA, where threads run in
            any order; a subclass then says by ``slots`` where its kernels add them first.

    Raises:
        InputError: The body's material is anisotropic and the field does not know such.
    """

    takes_anisotropic: ClassVar[bool] = False

    def __init__(self, body: SoftBody, deterministic: bool = False):
        if isinstance(body.material, Anisotropic) and not self.takes_anisotropic:
            raise InputError(f"the material is {type(body.material).__name__}; only the model Corotated knows such")
        self.body = body
        self.device = body.device
        self.elements = body.elements
        #: On the CPU there is one thread, and nothing to settle.
        self.deterministic = deterministic and body.device.is_cuda
        self.slots: Slots | None = None

    def add_forces(self, u: wp.array, f: wp.array) -> None:
        """Add the elastic nodal forces [N] of displacements u to f; both vec4 [worlds * N]."""
        if self.slots is None:
            self.scatter_forces(u, f)
        else:
            self.slots.values.zero_()
            self.scatter_forces(u, self.slots.values)
            self.slots.gather(f)

    @abstractmethod
    def scatter_forces(self, u: wp.array, f: wp.array) -> None:
        """Launch the kernels that add the forces to the nodes, or to the slots if there are any."""

    def plan_of(self, forest: DeviceForest) -> DevicePlan:
        """What the field wants to know of a mesh that changes, derived there."""
        from warp_corot.discretization.changing.plan import DevicePlan

        return DevicePlan(forest, subtrees=False)

    def follow(self, plan: DevicePlan) -> None:
        """Go through the elements of a mesh that changes.

        Called before the first launch, and again, before others are recorded, whenever a pass has changed the size of
        any launch.
        """
        self.elements = plan.elements

    def derive(self, plan: DevicePlan) -> None:  # noqa: B027 (most need nothing)
        """Launch what brings up to date what is kept of such elements, if ``plan.goes``; may be recorded."""

    def begin_step(self, pace: Pace, offset: int) -> None:  # noqa: B027 (most do not change)
        """Launch what sets the field for a step, where it changes with time.

        Args:
            pace: The clock.
            offset: How many steps are launched that it does not count yet.
        """

    @abstractmethod
    def write_energies(self, u: wp.array, energies: wp.array) -> None:
        """Write the strain energies [J] that make up the whole, world after world; float64."""

    @abstractmethod
    def write_von_mises(self, u: wp.array, stress: wp.array) -> None:
        """Write the von Mises stress of each element [Pa], float32 [T]."""

    @property
    def element_count(self) -> int:
        """How many elements launches go through; those beyond the body's do nothing."""
        return self.body.sizes.launch_elements

    @property
    def energy_count(self) -> int:
        """How many energies ``write_energies`` writes."""
        return self.element_count

    @property
    def state(self) -> dict[str, wp.array]:
        """Arrays that must be kept for the steps to go on as they would have."""
        return {}

    @contextmanager
    def state_kept(self) -> Iterator[None]:
        """Whatever is launched inside leaves no trace in the state that steps go on from."""
        kept = {name: wp.clone(array) for name, array in self.state.items()}
        try:
            yield
        finally:
            for name, array in self.state.items():
                wp.copy(array, kept[name])

    def reset(self, chosen: wp.array) -> None:  # noqa: B027 (most have no state)
        """Forget the state of chosen worlds; int32 [worlds], not zero for these."""

    def elastic_forces(self, u: wp.array) -> wp.array:
        """Elastic nodal forces [N] of displacements u, a new vec4 [worlds * N]."""
        f = wp.zeros_like(u)
        with self.state_kept():
            self.add_forces(u, f)
        return f

    def elastic_energy(self, u: wp.array) -> float:
        """Strain energy of the body in all worlds together [J]."""
        return float(self.elastic_energies(u).sum())

    def elastic_energies(self, u: wp.array) -> npt.NDArray[np.float64]:
        """Strain energy of the body in each world [J], float64 [worlds]."""
        energies = wp.zeros(self.energy_count, dtype=wp.float64, device=self.device)
        with self.state_kept():
            self.write_energies(u, energies)
        return energies.numpy().reshape(self.body.worlds, -1).sum(axis=1)

    def von_mises(self, u: wp.array) -> npt.NDArray[np.float32]:
        """Von Mises stress of each element [Pa], float32 [T]."""
        stress = wp.zeros(self.element_count, dtype=wp.float32, device=self.device)
        with self.state_kept():
            self.write_von_mises(u, stress)
        return stress.numpy()[: self.body.element_count]

    def launch(self, kernel: wp.Kernel, dim: int, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)

    @property
    def material_inputs(self) -> list:
        """The kernel arguments mu, lam and stride for forces and energies: those of what elements hold of the body."""
        return [self.body.mu, self.body.lam, self.body.material_stride]

    @property
    def stress_inputs(self) -> list:
        """The same for stresses: those of the material."""
        return list(self.body.lame)


class Model(ABC):
    """The description of an elastic model: a frozen dataclass of plain values.

    Class attributes:
        step_safety: Share of the stable step that is taken by default while strains are small.
        strained_safety: The same for large strains, where stiffness can change before it is measured again.
    """

    step_safety: ClassVar[float] = 0.9
    strained_safety: ClassVar[float] = 0.6

    @abstractmethod
    def bind(self, body: SoftBody, *, deterministic: bool = False) -> ForceField:
        """The model's force field on a body.

        Args:
            deterministic: Whether forces must come out the same bit by bit every time also on CUDA.

        Raises:
            InputError: The model cannot be used with this body's mesh.
        """

    def check_remeshable(self) -> None:  # noqa: B027 (most are)
        """See that a body under this model can be remeshed.

        Raises:
            InputError: The model keeps something of the elements or edges that it was bound to.
        """


class ElementField(ForceField):
    """Force field of kernels that need nothing but each element's nodal displacements."""

    def __init__(
        self,
        body: SoftBody,
        *,
        forces: wp.Kernel,
        energies: wp.Kernel,
        von_mises: wp.Kernel,
        deterministic: bool = False,
    ):
        super().__init__(body, deterministic)
        self._forces = forces
        self._energies = energies
        self._von_mises = von_mises
        if self.deterministic:
            self._take_slots()

    def _take_slots(self) -> None:
        self.slots, self.elements = leaf_slots(self.body)

    def scatter_forces(self, u: wp.array, f: wp.array) -> None:
        self.launch(self._forces, self.element_count, [self.elements, *self.material_inputs, u], [f])

    def write_energies(self, u: wp.array, energies: wp.array) -> None:
        self.launch(self._energies, self.element_count, [self.elements, *self.material_inputs, u], [energies])

    def write_von_mises(self, u: wp.array, stress: wp.array) -> None:
        self.launch(self._von_mises, self.element_count, [self.elements, *self.stress_inputs, u], [stress])


class LawField(ElementField):
    """Force field of a constitutive law in each element's deformation gradient."""

    def __init__(
        self,
        body: SoftBody,
        *,
        stress: wp.Function,
        energy: wp.Function,
        cauchy: wp.Function,
        deterministic: bool = False,
    ):
        kind = body.element_kind
        super().__init__(
            body,
            deterministic=deterministic,
            forces=scatter_forces(kind, stress),
            energies=element_energies(kind, energy),
            von_mises=element_von_mises(kind, cauchy),
        )


def leaf_slots(body: SoftBody) -> tuple[Slots, Any]:
    """A slot for each node of each element, and the elements that add to them."""
    slots, (targets,) = Slots.of_units([body.mesh.tets], body.world_node_count, body.device, body.worlds)
    return slots, with_targets(body.elements, in_worlds(targets, body.worlds, slots.per_world))
