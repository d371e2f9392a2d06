"""Corotated linear elasticity, the paper's model: linear in a frame that turns with the element or its ancestor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import warp as wp

from ..elements import forest_elements
from ..errors import InputError
from ..kernels.corotated import (
    corotated_energies,
    corotated_von_mises,
    extract_rotations,
    extract_warm_rotations,
    scatter_matrix_product,
    scatter_own_rotation,
    scatter_with_rotations,
)
from ..mesh import TetForest
from ..mesh.forest import MAX_LEVEL
from ..rotations import METHODS, rotation_function
from .model import ForceField, Model

if TYPE_CHECKING:
    from ..body import SoftBody

STIFFNESSES = ("factored", "sparse", "dense")


@dataclass(frozen=True)
class Corotated(Model):
    """W = V (mu e:e + lambda/2 tr(e)^2) with e = sym(R^T F) - I and R the rotation of F.

    With every element's own rotation the force is the gradient of W and conserves linear and angular momentum. Shared
    rotations are cheaper; they conserve linear momentum only.

    Attributes:
        rotation_level: None: every element has its own rotation. An int: the rotation of the ancestor at that level of
            the tree, or an element's own where it lies above (forests only).
        rotation: "byers-xu" (the paper's), "svd" (McAdams et al. 2011) or "warm" (a quaternion kept from step to step).
        iterations: For "byers-xu": None iterates to the paper's tolerance 3.85e-5, an int 2 to 12 that often.
        stiffness: "factored" (sums and differences), "sparse" (the paper's explicit K_T by type, zeros skipped) or
            "dense" (the same with all 144 products); the last two for forests only. All agree to rounding.

    Raises:
        InputError: An option is none of these.
    """

    step_safety: ClassVar[float] = 0.8

    rotation_level: int | None = None
    rotation: str = "byers-xu"
    iterations: int | None = None
    stiffness: str = "factored"

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

    def bind(self, body: SoftBody) -> CorotatedField:
        if not isinstance(body.mesh, TetForest):
            if self.rotation_level is not None:
                raise InputError(f"rotation_level {self.rotation_level} needs a forest; a general mesh has no tree")
            if self.stiffness != "factored":
                raise InputError(f"stiffness {self.stiffness!r} needs a forest; general elements have no three shapes")
        return CorotatedField(body, self)


class CorotatedField(ForceField):
    """Rotations and forces, as one kernel where each element uses its own, as two stages otherwise."""

    def __init__(self, body: SoftBody, model: Corotated):
        super().__init__(body)
        self.model = model
        kind = body.element_kind
        if isinstance(body.mesh, TetForest) and model.rotation_level is not None:
            units, unit = np.unique(body.mesh.ancestors(model.rotation_level), return_inverse=True)
            self._units = forest_elements(body.mesh, units, self.device)
            self.unit_count = len(units)
        else:
            self._units, unit = self.elements, np.arange(self.element_count)
            self.unit_count = self.element_count
        self._fused = model.rotation_level is None and model.rotation != "warm" and model.stiffness == "factored"
        self._unit = wp.array(unit.ravel(), dtype=wp.int32, device=self.device)
        self._rotations = wp.empty(self.unit_count, dtype=wp.mat33, device=self.device)
        self._state: dict[str, wp.array] = {}
        if model.rotation == "warm":
            identity = np.tile(np.array([0.0, 0.0, 0.0, 1.0], np.float32), (self.unit_count, 1))
            self._state["quaternions"] = wp.array(identity, dtype=wp.quat, device=self.device)
            self._extract = extract_warm_rotations(kind)
        else:
            rotation = rotation_function(model.rotation, model.iterations)
            self._extract = extract_rotations(kind, rotation)
            self._own = scatter_own_rotation(kind, rotation)
        if model.stiffness == "factored":
            self._forces = scatter_with_rotations(kind)
        else:
            self._forces = scatter_matrix_product(model.stiffness == "sparse")
        self._energies = corotated_energies(kind)
        self._von_mises = corotated_von_mises(kind)

    @property
    def state(self) -> dict[str, wp.array]:
        return self._state

    def extract_rotations(self, u: wp.array) -> wp.array:
        """The rotation of every unit, mat33 [units]."""
        outputs = [*self.state.values(), self._rotations]
        self.launch(self._extract, self.unit_count, [self._units, u], outputs)
        return self._rotations

    def add_rotated_forces(self, u: wp.array, f: wp.array) -> None:
        """Forces with the rotations that were extracted last."""
        self._launch_with_rotations(self._forces, u, f)

    def add_forces(self, u: wp.array, f: wp.array) -> None:
        if self._fused:
            self.launch(self._own, self.element_count, [self.elements, *self.material_inputs, u], [f])
        else:
            self.extract_rotations(u)
            self.add_rotated_forces(u, f)

    def write_energies(self, u: wp.array, energies: wp.array) -> None:
        self.extract_rotations(u)
        self._launch_with_rotations(self._energies, u, energies)

    def write_von_mises(self, u: wp.array, stress: wp.array) -> None:
        self.extract_rotations(u)
        self._launch_with_rotations(self._von_mises, u, stress)

    def _launch_with_rotations(self, kernel: wp.Kernel, u: wp.array, output: wp.array) -> None:
        inputs = [self.elements, *self.material_inputs, u, self._rotations, self._unit]
        self.launch(kernel, self.element_count, inputs, [output])
