"""Derivatives with respect to the users' input, from sums over adjoint motions of the work of elements' forces."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.sizes import padded
from warp_corot.elasticity import ForceField
from warp_corot.elasticity.dilatation import DilatationField
from warp_corot.elasticity.model import isotropic_material
from warp_corot.errors import InputError
from warp_corot.inputs.checks import shown
from warp_corot.kernels.corotated.anisotropic import FibreMaterial
from warp_corot.kernels.elements.constitutive import IsotropicMaterial
from warp_corot.kernels.gradients import elements as kernels
from warp_corot.kernels.gradients import steps

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody


class ElementWork:
    """Derivatives of a . f(u), summed over pairs of displacements u and adjoint motions a; see
    ``kernels.gradients.elements``.

    Args:
        field: The forces f.
        names: The sums of ``add``: "lame", "rest" and "activation".

    Raises:
        InputError: The forces have no such derivative.
    """

    def __init__(self, field: ForceField, names: set[str]):
        self.field, self.names, self.device = field, names, field.device
        self._shared = field if isinstance(field, DilatationField) else None
        law = (self._shared.shear if self._shared else field).stress_law
        missing = names if law is None else {"rest"} & names if law.sees_shape else set()
        if missing:
            words = {"lame": "moduli", "rest": "the rest shape", "activation": "active stress"}
            said = " and ".join(words[name] for name in sorted(missing))
            raise InputError(f"the model's forces have no derivative with respect to {said}; leave it out of wrt")
        if "lame" in names and law is not None and law.Material is not IsotropicMaterial:
            raise InputError("the material is anisotropic; derivatives with respect to its moduli do not exist yet")
        if "activation" in names and law is not None and law.Material is not FibreMaterial:
            raise InputError("wrt has 'activation', but only anisotropic materials with Corotated have this derivative")
        count, nodes = field.element_count, field.discretization.sizes.launch_nodes
        needs = {"mu": "lame", "lam": "lame", "activation": "activation"}
        self._sums = {
            name: wp.zeros(count if need in names else 0, dtype=wp.float64, device=self.device)
            for name, need in needs.items()
        }
        self._sums["rest"] = wp.zeros(nodes if "rest" in names else 0, dtype=wp.vec4, device=self.device)
        self._unit_mu, self._unit_lam = (self._lame(*pair) for pair in ((1.0, 0.0), (0.0, 1.0)))

    def add(self, u: wp.array, adjoint: wp.array, scale: float = 1.0) -> None:
        """Launch the sums of one pair; both vec4 [worlds * N]. ``scale`` multiplies all sums except "rest"."""
        kind, shared, pair = self.field.discretization.element_kind, self._shared, [u, adjoint]
        law: Any = (shared.shear if shared else self.field).stress_law
        weights = None if shared is None or self.names <= {"activation"} else shared.share_weights(u, adjoint)
        if "lame" in self.names:
            kernel = kernels.add_stress_work(kind, IsotropicMaterial, law.stress)
            self._launch(kernel, [self._unit_mu, *pair, scale], "mu")
            if shared is None:
                self._launch(kernel, [self._unit_lam, *pair, scale], "lam")
            else:
                self._launch(kernels.add_dilatation_work(kind, shared.of), [weights, *pair, scale], "lam")
        if "activation" in self.names:
            self._launch(kernels.add_fibre_work(kind), [law.material, *pair, scale], "activation")
        if "rest" in self.names:
            kernel = kernels.add_rest_work(kind, law.Material, law.stress, law.differential)
            self._launch(kernel, [law.material, *pair], "rest")
            if shared is not None:
                kernel = kernels.add_dilatation_rest_work(kind, shared.of)
                self._launch(kernel, [shared.isotropic, weights, *pair], "rest")

    def clear(self) -> None:
        """Begin the sums again."""
        for array in self._sums.values():
            array.zero_()

    def of_lame(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """The derivatives with respect to mu and lambda of forces, float64 [worlds * T]."""
        return self._sums["mu"].numpy(), self._sums["lam"].numpy()

    def of_activation(self) -> npt.NDArray[np.float64]:
        """The derivative with respect to active stress, float64 [worlds * T]."""
        return np.asarray(self._sums["activation"].numpy())

    def of_rest(self) -> npt.NDArray[np.float64]:
        """The derivative with respect to rest positions, float64 [worlds * N, 3]."""
        return self._nodal("rest")

    def of_weights(self, densities: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """The derivative with respect to rest positions of the work of weights, float64 [worlds * N, 3].

        Args:
            densities: Density of that work in elements [J/m^3], [worlds * T].
        """
        count = self.field.discretization.sizes.launch_nodes
        self._sums["weights"] = wp.zeros(count, dtype=wp.vec4, device=self.device)
        on_device = wp.array(densities, dtype=wp.float32, device=self.device)
        self._launch(kernels.add_rest_weight(self.field.discretization.element_kind), [on_device], "weights")
        return self._nodal("weights")

    def _nodal(self, name: str) -> npt.NDArray[np.float64]:
        return np.asarray(self._sums[name].numpy()[: self.field.discretization.sizes.nodes, :3], np.float64)

    def _lame(self, mu: float, lam: float) -> IsotropicMaterial:
        return isotropic_material([*(wp.full(1, v, dtype=wp.float32, device=self.device) for v in (mu, lam)), 0])

    def _launch(self, kernel: wp.Kernel, inputs: list, name: str) -> None:
        given = [self.field.discretization.elements, *inputs, self._sums[name]]
        wp.launch(kernel, self.field.element_count, given, device=self.device)


Array = npt.NDArray[np.float64]


class StepSums:
    """Sums of the work of forces in the adjoint motions of all steps.

    Args:
        body, field: The body and its elastic forces.
        names: Names of the requested derivatives.

    Attributes:
        loads: The loads of the run [N], vec4 [worlds * N].
        of_loads: The sum of adjoint motions, vec4 [worlds * N].
    """

    def __init__(self, body: SoftBody, field: ForceField, names: Sequence[str]):
        self.body, self.field, self.names = body, field, tuple(names)
        self.work = ElementWork(field, needed(names))
        like, count = body.state.displacements, body.sizes.nodes
        self.loads, self.of_loads, self._forces = (wp.zeros_like(like) for _ in range(3))
        if body.conditions.has_loads:
            self.loads[:count].assign(padded(body.conditions.loads.numpy()[:count, :3]))
        self._wants_mass = bool({"density", "rest"} & set(names))
        self._of_mass = wp.zeros(len(like), dtype=wp.float64, device=body.device)

    def add(self, u: wp.array, p: wp.array) -> None:
        """Launch the sums of one step, except those of loads, for the adjoint motion p and forces at displacements
        u.
        """
        self.work.add(u, p)
        if self._wants_mass:
            self._forces.zero_()
            self.field.add_forces(u, self._forces)
            inputs = [self.body.conditions.inverse_mass, self._forces, self.loads, p]
            wp.launch(steps.add_of_mass, len(p), inputs, [self._of_mass], device=self.body.device)

    def clear(self) -> None:
        """Begin the sums again."""
        self.work.clear()
        self.of_loads.zero_()
        self._of_mass.zero_()

    def derivatives(self, **places: Any) -> dict[str, Any]:
        """The derivatives with respect to everything but the initial state; "rest" lacks the part of that state."""
        count = self.body.sizes.nodes
        moved = self.of_loads.numpy()[:count, :3].astype(np.float64)
        return derivatives(self.body, self.work, self.names, moved, self._of_mass.numpy()[:count], **places)


def derivatives(
    body: SoftBody, work: Any, names: Sequence[str], moved: Array, of_mass: Array, *, boundary: Any = 0.0, **places: Any
) -> dict[str, Any]:
    """Derivatives of these names from sums.

    Args:
        body: The body.
        work: The sums of elements, an ``ElementWork`` or what has the same results.
        names: Any except those of an initial state.
        moved: The sum of adjoint motions, [worlds * N, 3].
        of_mass: The derivative with respect to the mass of each node, [worlds * N].
        boundary: The derivative with respect to the places of held nodes, [worlds * N, 3]; they keep their
            displacements, so their places follow the rest shape.
        places: Other derivatives with respect to places.
    """
    found: dict[str, Callable[[], Any]] = {
        "loads": lambda: moved,
        "gravity": lambda: body.masses @ moved,
        "young": lambda: of_modulus(body, "young", *work.of_lame()),
        "poisson": lambda: of_modulus(body, "poisson", *work.of_lame()),
        "density": lambda: of_density(body, of_mass),
        "activation": lambda: work.of_activation().reshape(body.worlds, -1),
        "rest": lambda: work.of_rest() + work.of_weights(weight_densities(body, of_mass)) + boundary,
        "boundary": lambda: boundary,
    }
    return {
        name: places[name] if name in places else found[name]() for name in names if name in places or name in found
    }


#: Names of derivatives of static answers, and the sums of ``ElementWork`` that each of them needs.
NEEDS = {"young": "lame", "poisson": "lame", "rest": "rest", "activation": "activation"} | dict.fromkeys(
    ("density", "loads", "boundary", "gravity", "obstacles")
)


def needed(names: Sequence[str]) -> set[str]:
    """The sums of ``ElementWork`` for derivatives of these names."""
    return {need for name in names if (need := NEEDS.get(name)) is not None}


def checked_names(wrt: str | Sequence[str], known: Collection[str]) -> tuple[str, ...]:
    """Names of derivatives, each once.

    Raises:
        InputError: A name is not one of those known, or there are none.
    """
    given = (wrt,) if isinstance(wrt, str) or not isinstance(wrt, Iterable) else tuple(wrt)
    names = tuple(each for place, each in enumerate(given) if each not in given[:place])
    wanted = ", ".join(map(repr, known))
    for name in names:
        if not isinstance(name, str) or name not in known:
            raise InputError(f"wrt has {shown(name)}; it must be one or several of {wanted}")
    if not names:
        raise InputError(f"wrt is empty; it must be one or several of {wanted}")
    return names


@dataclass(frozen=True, kw_only=True)
class Derivatives:
    """Derivatives of an objective, float64; those that were not requested are None."""

    young: Array | float | None = None
    poisson: Array | float | None = None
    density: Array | float | None = None
    loads: Array | None = None
    gravity: Array | None = None
    rest: Array | None = None
    activation: Array | None = None
    obstacles: Array | None = None

    def __getitem__(self, name: str) -> Any:
        known = {field.name for field in fields(self) if field.default is None}
        if name not in known or getattr(self, name) is None:
            raise InputError(f"{shown(name)} is not one of the requested derivatives")
        return getattr(self, name)


def of_modulus(body: SoftBody, name: str, of_mu: Array, of_lam: Array) -> Array | float:
    """The derivative with respect to Young's modulus or Poisson's ratio, in the shape of the material's value."""
    material = body.material.isotropic
    young, nu = (np.asarray(value, np.float64) for value in (material.young, material.poisson))
    if name == "young":
        d_mu, d_lam = 1.0 / (2.0 * (1.0 + nu)), nu / ((1.0 + nu) * (1.0 - 2.0 * nu))
    else:
        d_mu = -young / (2.0 * (1.0 + nu) ** 2)
        d_lam = young * (1.0 + 2.0 * nu**2) / ((1.0 + nu) * (1.0 - 2.0 * nu)) ** 2
    return _of_shape(body, name, d_mu * _filled(body, of_mu) + d_lam * _filled(body, of_lam))


def of_density(body: SoftBody, work: Array) -> Array | float:
    """The derivative with respect to density, in the shape of the material's value.

    Args:
        work: The work of the nodes' accelerations in the adjoint motion for each unit of mass, [worlds * N].
    """
    return _of_shape(body, "density", _filled(body, body.mesh.volumes * means_of_elements(body, work)))


def weight_densities(body: SoftBody, work: Array) -> Array:
    """The work of ``of_density`` for each unit of elements' volume, [worlds * T]."""
    density = np.broadcast_to(np.asarray(body.material.density), (body.worlds, len(body.mesh.tets)))
    return np.asarray(_filled(body, density * means_of_elements(body, work))).ravel()


def means_of_elements(body: SoftBody, values: Array) -> Array:
    """Means of nodal values, [worlds * N], over elements, [worlds, T]."""
    return np.asarray(values.reshape(body.worlds, -1)[:, body.mesh.tets].mean(axis=2))


def _filled(body: SoftBody, values: Array) -> Array:
    """Values of elements times their filled fraction, [worlds, T]."""
    fill = body.discretization.fill
    of_worlds = values.reshape(body.worlds, -1)
    return of_worlds if fill is None else of_worlds * fill


def _of_shape(body: SoftBody, name: str, values: Array) -> Array | float:
    """Values of elements, [worlds, T], summed to the shape of a field of the material: the derivative with respect to a
    value of many elements is a sum over them.
    """
    shape = np.shape(getattr(body.material, name))
    for axis, count in enumerate((1,) * (values.ndim - len(shape)) + shape):
        if count == 1:
            values = values.sum(axis=axis, keepdims=True)
    return values.reshape(shape) if shape else float(values.sum())
