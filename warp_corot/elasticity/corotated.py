"""Corotated linear elasticity, the paper's model: linear in a frame that turns with the element or its ancestor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import warp as wp

from ..anisotropy import Anisotropic
from ..elements import forest_elements, in_worlds, with_targets
from ..errors import InputError
from ..kernels import general_cpu, subtree_cpu, subtree_cuda
from ..kernels.corotated import (
    corotated_energies,
    corotated_von_mises,
    extract_rotations,
    extract_warm_rotations,
    reset_quaternions,
    scatter_matrix_product,
    scatter_own_rotation,
    scatter_with_rotations,
)
from ..kernels.elements import GeneralElements
from ..kernels.lanes import LANES
from ..kernels.repair import repair_own, repair_shared
from ..kernels.rotation import byers_xu, quick_rotation
from ..mesh import TetForest
from ..mesh.forest import MAX_LEVEL
from ..plan import Batch, ForcePlan, Sharing
from ..rotations import METHODS, rotation_function
from .anisotropic import AnisotropicField, AnisotropicLanesField
from .model import ForceField, Model, leaf_slots

if TYPE_CHECKING:
    from ..body import SoftBody

STIFFNESSES = ("factored", "sparse", "dense")


@dataclass(frozen=True)
class Corotated(Model):
    """W = V (mu e:e + lambda/2 tr(e)^2) with e = sym(R^T F) - I and R the rotation of F.

    With every element's own rotation the force is the gradient of W and conserves linear and angular momentum. Shared
    rotations are cheaper; they conserve linear momentum only.

    Anisotropic materials keep both momenta too (see ``AnisotropicField``); they go leaf by leaf with own rotations.

    With the defaults, forests take the fast path: complete three-level subtrees as units of work. Any other rotation,
    iterations or stiffness goes leaf by leaf.

    Attributes:
        rotation_level: None: every element has its own rotation. An int: the rotation of the ancestor at that level of
            the tree, or an element's own where it lies above (forests only). On the fast path three levels above the
            leaves or more; one or two levels above go leaf by leaf and are slower than own rotations.
        rotation: "byers-xu" (the paper's), "svd" (McAdams et al. 2011) or "warm" (a quaternion kept from step to step).
        iterations: For "byers-xu": None iterates to the paper's tolerance 3.85e-5, an int 2 to 12 that often.
        stiffness: "factored" (sums and differences), "sparse" (the paper's explicit K_T by type, zeros skipped) or
            "dense" (the same with all 144 products); the last two for forests only. All agree to rounding.
        subtrees: False: leaf by leaf also where the fast path could be taken, as the paper has it; for comparison.

    Raises:
        InputError: An option is none of these.
    """

    step_safety: ClassVar[float] = 0.8

    rotation_level: int | None = None
    rotation: str = "byers-xu"
    iterations: int | None = None
    stiffness: str = "factored"
    subtrees: bool = True

    def __post_init__(self) -> None:
        level = self.rotation_level
        if level is not None and (isinstance(level, bool) or level != int(level) or not 0 <= level <= MAX_LEVEL):
            raise InputError(f"rotation_level is {level}; it must be None or a whole number from 0 to {MAX_LEVEL}")
        if self.rotation not in METHODS:
            raise InputError(f"rotation is {self.rotation!r}; it must be one of {', '.join(METHODS)}")
        if self.iterations is not None:
            rotation_function(self.rotation, self.iterations)
        if self.stiffness not in STIFFNESSES:
            raise InputError(f"stiffness is {self.stiffness!r}; it must be one of {', '.join(STIFFNESSES)}")

    def bind(self, body: SoftBody, *, deterministic: bool = False) -> CorotatedField | AnisotropicField:
        if isinstance(body.material, Anisotropic):
            return self._bind_anisotropic(body, deterministic)
        fast = self.rotation == "byers-xu" and self.iterations is None and self.stiffness == "factored"
        fast = fast and self.subtrees
        if isinstance(body.mesh, TetForest):
            if fast:
                return SubtreeField(body, self, deterministic)
        elif self.rotation_level is not None:
            raise InputError(f"rotation_level {self.rotation_level} needs a forest; a general mesh has no tree")
        elif self.stiffness != "factored":
            raise InputError(f"stiffness {self.stiffness!r} needs a forest; general elements have no three shapes")
        elif fast and body.device.is_cpu:
            return LanesField(body, self, deterministic)
        return LeafField(body, self, deterministic)

    def _bind_anisotropic(self, body: SoftBody, deterministic: bool) -> AnisotropicField:
        for name, given, wanted in (
            ("rotation_level", self.rotation_level, None),
            ("stiffness", self.stiffness, "factored"),
        ):
            if given != wanted:
                raise InputError(f"{name} is {given!r}; with an anisotropic material it must be {wanted!r}")
        if self.rotation == "warm":
            raise InputError("rotation is 'warm'; with an anisotropic material it must be 'byers-xu' or 'svd'")
        lanes = body.device.is_cpu and self.own_rotation is quick_rotation
        return (AnisotropicLanesField if lanes else AnisotropicField)(body, self.own_rotation, deterministic)

    @property
    def own_rotation(self) -> wp.Function:
        """The device function that finds an element's own rotation."""
        rotation = rotation_function(self.rotation, self.iterations)
        return quick_rotation if rotation is byers_xu and self.subtrees else rotation


@dataclass(frozen=True)
class Rotations:
    """Rotations of elements or their ancestors, and who uses which.

    Attributes:
        units: Whose rotations are found, as elements.
        count: How many.
        rotations: mat33 [count].
        unit: Which of them each element of the mesh uses, int32 [T].
    """

    units: Any
    count: int
    rotations: wp.array
    unit: wp.array


class CorotatedField(ForceField):
    """Rotations and forces as one kernel where each element uses its own, as two stages otherwise."""

    def __init__(self, body: SoftBody, model: Corotated, deterministic: bool):
        super().__init__(body, deterministic)
        self.model = model
        kind = body.element_kind
        self._shared: Rotations | None = None
        self._fused = model.rotation_level is None and model.rotation != "warm" and model.stiffness == "factored"
        self._state: dict[str, wp.array] = {}
        if model.rotation == "warm":
            self._state["quaternions"] = wp.empty(self.unit_count, dtype=wp.quat, device=self.device)
            self.reset(wp.ones(body.worlds, dtype=wp.int32, device=self.device))
            self._extract = extract_warm_rotations(kind)
        else:
            self._extract = extract_rotations(kind, model.own_rotation)
            self._own = scatter_own_rotation(kind, model.own_rotation)
        if model.stiffness == "factored":
            self._forces = scatter_with_rotations(kind)
        else:
            self._forces = scatter_matrix_product(model.stiffness == "sparse")
        self._energies = corotated_energies(kind)
        self._von_mises = corotated_von_mises(kind)
        if not self._fused:
            self._sharing()

    @property
    def state(self) -> dict[str, wp.array]:
        return self._state

    def reset(self, chosen: wp.array) -> None:
        for quaternions in self._state.values():
            in_world = len(quaternions) // self.body.worlds
            self.launch(reset_quaternions, len(quaternions), [chosen, in_world], [quaternions])

    @property
    def unit_count(self) -> int:
        """How many rotations are found."""
        return self._sharing().count

    def extract_rotations(self, u: wp.array) -> wp.array:
        """The rotation of every unit, mat33 [units]."""
        shared = self._sharing()
        self.launch(self._extract, shared.count, [shared.units, u], [*self.state.values(), shared.rotations])
        return shared.rotations

    def add_rotated_forces(self, u: wp.array, f: wp.array) -> None:
        """Forces with the rotations that were extracted last."""
        self._launch_with_rotations(self._forces, self.material_inputs, u, f)

    def scatter_forces(self, u: wp.array, f: wp.array) -> None:
        if self._fused:
            self.launch(self._own, self.element_count, [self.elements, *self.material_inputs, u], [f])
        else:
            self.extract_rotations(u)
            self.add_rotated_forces(u, f)

    def write_energies(self, u: wp.array, energies: wp.array) -> None:
        self.extract_rotations(u)
        self._launch_with_rotations(self._energies, self.material_inputs, u, energies)

    def write_von_mises(self, u: wp.array, stress: wp.array) -> None:
        self.extract_rotations(u)
        self._launch_with_rotations(self._von_mises, self.stress_inputs, u, stress)

    def _sharing(self) -> Rotations:
        """Who uses whose rotation; made on first use, since own rotations need none of it for their forces."""
        if self._shared is None:
            body, mesh, level = self.body, self.body.mesh, self.model.rotation_level
            units, unit = self.elements, np.arange(len(mesh.tets))
            count = len(mesh.tets)
            if isinstance(mesh, TetForest) and level is not None:
                ancestors, unit = np.unique(mesh.ancestors(level), return_inverse=True)
                units, count = forest_elements(mesh, ancestors, self.device, body.worlds), len(ancestors)
            self._shared = Rotations(
                units,
                body.worlds * count,
                wp.empty(body.worlds * count, dtype=wp.mat33, device=self.device),
                wp.array(in_worlds(unit.ravel(), body.worlds, count), dtype=wp.int32, device=self.device),
            )
        return self._shared

    def _launch_with_rotations(self, kernel: wp.Kernel, material: list, u: wp.array, output: wp.array) -> None:
        shared = self._sharing()
        inputs = [self.elements, *material, u, shared.rotations, shared.unit]
        self.launch(kernel, self.element_count, inputs, [output])


class LeafField(CorotatedField):
    """Leaf by leaf."""

    def __init__(self, body: SoftBody, model: Corotated, deterministic: bool):
        super().__init__(body, model, deterministic)
        if self.deterministic:
            self.slots, self.elements = leaf_slots(body)


class Lanes:
    """Elements with rotations of their own on the CPU, eight at a time."""

    def __init__(self, elements: Any, material: list):
        self.elements = elements
        self.count = len(elements.nodes)
        self.material = material
        self._flagged = wp.zeros(self.count, dtype=wp.uint8, device="cpu")

    @classmethod
    def of_forest(cls, elements: Any, material: list) -> Lanes:
        """From elements of a forest."""
        count, general = len(elements.nodes), GeneralElements()
        general.nodes = general.targets = elements.nodes
        general.rest_inverse = wp.empty(count, dtype=wp.mat33, device="cpu")
        general.volume = wp.empty(count, dtype=wp.float32, device="cpu")
        outputs = [general.rest_inverse, general.volume]
        wp.launch(general_cpu.rest_matrices, dim=count, inputs=[elements], outputs=outputs, device="cpu")
        return cls(general, material)

    def scatter_forces(self, u: wp.array, f: wp.array) -> None:
        inputs = [self.elements, self.count, *self.material, u]
        blocks = -(-self.count // LANES)
        wp.launch(general_cpu.scatter_elements, blocks, inputs, [f, self._flagged], device="cpu")
        repair = [self._flagged, self.elements, *self.material, u]
        wp.launch(general_cpu.repair_elements, self.count, repair, [f], device="cpu")


class LanesField(CorotatedField):
    """General elements on the CPU."""

    def __init__(self, body: SoftBody, model: Corotated, deterministic: bool):
        super().__init__(body, model, deterministic)
        self._lanes = Lanes(self.elements, self.material_inputs)

    def scatter_forces(self, u: wp.array, f: wp.array) -> None:
        self._lanes.scatter_forces(u, f)


class SubtreeField(CorotatedField):
    """The fast path: complete subtrees in batches, leaf by leaf only what is left over."""

    def __init__(self, body: SoftBody, model: Corotated, deterministic: bool):
        super().__init__(body, model, deterministic)
        assert isinstance(body.mesh, TetForest)
        self.plan = ForcePlan.of_forest(
            body.mesh, model.rotation_level, self.device, worlds=body.worlds, deterministic=self.deterministic
        )
        self.slots = self.plan.slots
        if self.plan.leaf_targets is not None and self.slots is not None:
            targets = in_worlds(self.plan.leaf_targets, body.worlds, self.slots.per_world)
            self.elements = with_targets(self.elements, targets)
        self._uniform = body.material_stride == 0
        self._kernels = [self._kernel(batch) for batch in self.plan.batches]
        above = [batch.sharing is Sharing.ABOVE for batch in self.plan.batches]
        self._needs_rotations = model.rotation_level is not None and (any(above) or len(self.plan.flat) > 0)
        nothing = wp.empty(0, dtype=wp.int32, device=self.device)
        no_rotations = wp.empty(0, dtype=wp.mat33, device=self.device)
        self._rotations = self._sharing().rotations if self._needs_rotations else no_rotations
        self._batch_units = [
            self._units_of(batch) if is_above else nothing
            for batch, is_above in zip(self.plan.batches, above, strict=True)
        ]
        if len(self.plan.flat):
            self._prepare_flat(body.mesh, in_worlds(self.plan.flat, body.worlds, len(body.mesh.tets)))

    def _prepare_flat(self, mesh: TetForest, flat: np.ndarray) -> None:
        """The leaves that are in no subtree, as elements of their own."""
        plan, worlds = self.plan, self.body.worlds
        self._flat_elements = forest_elements(mesh, mesh.tree.leaves[plan.flat], self.device, worlds)
        if plan.leaf_targets is not None and plan.slots is not None:
            targets = in_worlds(plan.leaf_targets[plan.flat], worlds, plan.slots.per_world)
            self._flat_elements = with_targets(self._flat_elements, targets)
        self._flat_material = self.material_inputs
        if not self._uniform:
            self._flat_material = [
                wp.array(a.numpy()[flat], dtype=wp.float32, device=self.device) for a in (self.body.mu, self.body.lam)
            ] + [1]
        self._flat_lanes: Lanes | None = None
        if self.device.is_cpu and not self._needs_rotations:
            self._flat_lanes = Lanes.of_forest(self._flat_elements, self._flat_material)
        if self._needs_rotations:
            self._flat_unit = wp.array(self._sharing().unit.numpy()[flat], dtype=wp.int32, device=self.device)

    def scatter_forces(self, u: wp.array, f: wp.array) -> None:
        if self._needs_rotations:
            self.extract_rotations(u)
        for batch, kernel, unit in zip(self.plan.batches, self._kernels, self._batch_units, strict=True):
            self._launch_batch(batch, kernel, unit, u, f)
        if len(self.plan.flat):
            inputs = [self._flat_elements, *self._flat_material, u]
            count = len(self._flat_elements.code)
            if self._flat_lanes is not None:
                self._flat_lanes.scatter_forces(u, f)
            elif self._needs_rotations:
                self.launch(self._forces, count, [*inputs, self._rotations, self._flat_unit], [f])
            else:
                self.launch(self._own, count, inputs, [f])

    def _kernel(self, batch: Batch) -> wp.Kernel:
        given = batch.sharing is Sharing.ABOVE
        if self.device.is_cuda:
            if batch.sharing is Sharing.OWN:
                return subtree_cuda.scatter_subtrees_own(batch.shape, batch.grouped, self._uniform)
            return subtree_cuda.scatter_subtrees_shared(batch.shape, batch.grouped, self._uniform, given)
        if batch.sharing is Sharing.OWN:
            return subtree_cpu.scatter_subtrees_own(batch.shape)
        return subtree_cpu.scatter_subtrees_shared(batch.shape, given)

    def _units_of(self, batch: Batch) -> wp.array:
        """Which of the extracted rotations each subtree uses."""
        unit = self._sharing().unit.numpy()[batch.subtrees.first.numpy()]
        return wp.array(unit, dtype=wp.int32, device=self.device)

    def _launch_batch(self, batch: Batch, kernel: wp.Kernel, unit: wp.array, u: wp.array, f: wp.array) -> None:
        body = self.body
        if self.device.is_cuda:
            threads, block = batch.count, subtree_cuda.BLOCK
            inputs = [batch.subtrees, body.mu, body.lam, u]
        else:
            threads, block = -(-batch.count // LANES), 256
            inputs = [batch.subtrees, batch.count, *self.material_inputs, u]
        if batch.sharing is not Sharing.OWN:
            inputs += [self._rotations, unit]
        wp.launch(kernel, dim=threads, inputs=inputs, outputs=[f, batch.flagged], device=self.device, block_dim=block)
        flags = batch.flags_by_eights
        inputs = [self.elements, *self.material_inputs, u]
        if batch.sharing is Sharing.OWN:
            self.launch(repair_own, len(flags), [flags, batch.subtrees.first, *inputs], [f])
        elif batch.sharing is Sharing.ROOT:
            self.launch(repair_shared, len(flags), [flags, batch.subtrees.first, batch.roots, *inputs], [f])
