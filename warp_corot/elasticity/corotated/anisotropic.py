"""Corotated elasticity of anisotropic materials, with active stress along the fibres."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.elasticity.model import ForceField, leaf_slots
from warp_corot.elasticity.paths.lanes import Lanes, as_general
from warp_corot.inputs.checks import check_float32
from warp_corot.kernels.corotated.anisotropic import (
    OrthotropicMaterial,
    anisotropic_energies,
    anisotropic_von_mises,
    scatter_anisotropic,
    vec9,
)
from warp_corot.kernels.corotated.anisotropic_cpu import (
    repair_anisotropic,
    scatter_anisotropic_lanes,
    turn_changed,
    turn_elements,
)
from warp_corot.kernels.elements.elements import GeneralElements
from warp_corot.kernels.remesh.anisotropic import assemble_materials
from warp_corot.kernels.stepping.activation import follow_activation
from warp_corot.materials.anisotropic import FRAME_ENTRIES, STIFFNESS_ENTRIES, Anisotropic

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody
    from warp_corot.discretization.changing.plan import DevicePlan
    from warp_corot.solvers.steps.pace import Pace


class AnisotropicField(ForceField):
    """W = V/2 e : C : e with e = sym(R^T F) - I, R the element's own rotation, C fixed in rest space.

    The force is the gradient of W, with the turning of R that isotropic materials need not account for, and conserves
    linear and angular momentum. Where F comes near having no definite rotation (inverted, or flattened to a sixth in
    two directions, as fibres are that stretch 3.4 times; see ``kernels.corotated.anisotropic``), C goes over to that of the
    nearest isotropic material, and the force is the gradient of that energy.

    To it comes the active stress of ``SoftBody.activation``, P = s (F d) d^T along the fibres' direction d. It keeps
    both momenta; it puts work in, so that there is no energy of it.

    Args:
        body: Of an ``Anisotropic`` material.
        rotation: Device function that finds rotations.
        deterministic: As for every field.
    """

    takes_anisotropic: ClassVar[bool] = True

    def __init__(self, body: SoftBody, rotation: wp.Function, deterministic: bool):
        super().__init__(body, deterministic)
        kind = body.element_kind
        self._forces = scatter_anisotropic(kind, rotation)
        self._energies = anisotropic_energies(kind, rotation)
        self._von_mises = anisotropic_von_mises(kind, rotation)
        self.material = device_material(body)
        if self.deterministic:
            self.slots, self.elements = leaf_slots(body)

    def scatter_forces(self, u: wp.array, f: wp.array) -> None:
        self.launch(self._forces, self.element_count, [self.elements, self.material, *self._activation, u], [f])

    def follow(self, plan: DevicePlan) -> None:
        if self.elements is not plan.elements:
            self.material = changing_material(self.material, self.body, plan)
        super().follow(plan)

    def derive(self, plan: DevicePlan) -> None:
        names, material = plan.forest.carriage.names, self.material
        rows = [names.index(name) if name in names else -1 for name in (FRAME_ENTRIES[0], STIFFNESS_ENTRIES[0])]
        inputs = [plan.forest.threads, plan.forest.pools, plan.arrays, *rows]
        if max(rows) >= 0:
            self.launch(assemble_materials, plan.forest.threads, inputs, [material.axes, material.stiffness])

    def write_energies(self, u: wp.array, energies: wp.array) -> None:
        self.launch(self._energies, self.element_count, [self.elements, self.material, u], [energies])

    def write_von_mises(self, u: wp.array, stress: wp.array) -> None:
        inputs = [self.elements, self.material, *self._activation, u]
        self.launch(self._von_mises, self.element_count, inputs, [stress])

    def begin_step(self, pace: Pace, offset: int) -> None:
        body = self.body
        for activation in body.conditions.activations:
            inputs = [
                activation.elements,
                activation.times,
                activation.stress,
                pace.arrays,
                body.conditions.world_starts,
            ]
            inputs += [body.world_element_count, offset]
            self.launch(follow_activation, len(activation.elements), inputs, [body.conditions.activation])

    @property
    def _activation(self) -> list:
        return [int(self.body.conditions.has_activation), self.body.conditions.activation]


class AnisotropicLanesField(AnisotropicField):
    """On the CPU, eight elements at a time."""

    def __init__(self, body: SoftBody, rotation: wp.Function, deterministic: bool):
        super().__init__(body, rotation, deterministic)
        if body.changing is None:
            self._general = self._turned()
            self._lanes = self._lanes_of(self.elements, self._general)

    def follow(self, plan: DevicePlan) -> None:
        is_new = self.elements is not plan.elements
        super().follow(plan)
        if is_new:
            self._general = self._turned()
        count = self.element_count
        self._lanes = self._lanes_of(_first(self.elements, count), _first(self._general, count))

    def derive(self, plan: DevicePlan) -> None:
        super().derive(plan)
        inputs = [plan.forest.threads, plan.arrays, self.elements, self.material]
        self.launch(turn_changed, plan.forest.threads, inputs, [self._general.rest_inverse, self._general.volume])

    def scatter_forces(self, u: wp.array, f: wp.array) -> None:
        self._lanes.scatter_forces([self.material, *self._activation], u, f)

    def _turned(self) -> GeneralElements:
        """The elements as general ones, their rest matrices turned into the material's axes."""
        return as_general(self.elements, turn_elements(self.body.element_kind), [self.elements, self.material])

    def _lanes_of(self, elements: Any, general: GeneralElements) -> Lanes:
        repair = repair_anisotropic(self.body.element_kind)
        return Lanes(elements, general, scatter=scatter_anisotropic_lanes, repair=repair)


def _first(elements: Any, count: int) -> Any:
    """The first elements of either kind."""
    some = type(elements)()
    some.assign(elements)
    some.nodes = some.targets = elements.nodes[:count]
    return some


def device_material(body: SoftBody) -> OrthotropicMaterial:
    """A body's material as the kernels read it, world after world where it is not uniform."""
    given = body.material
    assert isinstance(given, Anisotropic)
    stiffness = given.stiffness()
    check_float32(np.abs(stiffness[..., [0, 1, 2, 6, 7, 8]]).ravel(), "the stiffness", "Pa")
    material = OrthotropicMaterial()
    material.axes, material.axes_stride = _for_elements(given.frames(), 2, body, wp.mat33)
    material.stiffness, material.stride = _for_elements(stiffness, 1, body, vec9)
    material.mu, material.lam, _stride = body.lame
    fill = np.ones(()) if body.fill is None else body.fill
    material.fill, material.fill_stride = _for_elements(fill, 0, body, wp.float32)
    return material


def changing_material(given: OrthotropicMaterial, body: SoftBody, plan: DevicePlan) -> OrthotropicMaterial:
    """The same material of leaves that change, and of padding; ``AnisotropicField.derive`` writes what varies."""
    material, count = OrthotropicMaterial(), plan.most_leaves
    material.assign(given)
    material.mu, material.lam, material.stride = body.lame
    if given.axes_stride:
        material.axes = wp.array(np.tile(np.eye(3), (count, 1, 1)), dtype=wp.mat33, device=body.device)
    if given.stride:
        material.stiffness = wp.zeros(count, dtype=vec9, device=body.device)
    if "fill" in plan.values:
        material.fill = plan.values["fill"]
    return material


def _for_elements(values: npt.NDArray[np.float64], rank: int, body: SoftBody, dtype: type) -> tuple[wp.array, int]:
    """One value, or one for each element of each world; and the stride by which to go through them."""
    head, tail = values.shape[: values.ndim - rank], values.shape[values.ndim - rank :]
    if np.prod(head, dtype=int) == 1:
        return wp.array(values.reshape(1, *tail), dtype=dtype, device=body.device), 0
    everywhere = np.broadcast_to(values, (body.worlds, len(body.mesh.tets), *tail)).astype(np.float32)
    return wp.array(everywhere.reshape(-1, *tail), dtype=dtype, device=body.device), 1
