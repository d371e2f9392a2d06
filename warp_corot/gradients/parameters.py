"""Derivatives with respect to the users' input, from sums over adjoint motions of the work of elements' forces."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.elasticity import ForceField
from warp_corot.elasticity.dilatation import DilatationField
from warp_corot.elasticity.model import StressLaw, isotropic_material
from warp_corot.errors import InputError
from warp_corot.inputs.checks import shown
from warp_corot.kernels.corotated.anisotropic import FibreMaterial
from warp_corot.kernels.elements.constitutive import IsotropicMaterial
from warp_corot.kernels.gradients import elements as kernels
from warp_corot.kernels.gradients import steps

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody
    from warp_corot.discretization.elements import Elements


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
            said = _listed(missing)
            raise InputError(f"the model's forces have no derivative with respect to {said}; leave it out of wrt")
        if "lame" in names and law is not None and law.Material is not IsotropicMaterial:
            raise InputError("the material is anisotropic; derivatives with respect to its moduli do not exist yet")
        if "activation" in names and law is not None and law.Material is not FibreMaterial:
            raise InputError("wrt has 'activation', but only anisotropic materials with Corotated have this derivative")
        count, nodes = field.element_count, field.discretization.sizes.launch_nodes
        self._of_mu, self._of_lam, self._of_activation = (
            wp.zeros(count if name in names else 0, dtype=wp.float64, device=self.device)
            for name in ("lame", "lame", "activation")
        )
        self._of_rest = wp.zeros(nodes if "rest" in names else 0, dtype=wp.vec4, device=self.device)
        self._unit_mu, self._unit_lam = (self._lame(*pair) for pair in ((1.0, 0.0), (0.0, 1.0)))

    def add(self, u: wp.array, adjoint: wp.array, scale: float = 1.0) -> None:
        """Launch the sums of one pair; both vec4 [worlds * N]. ``scale`` multiplies all sums except "rest"."""
        if "lame" in self.names:
            self._add_lame(u, adjoint, scale)
        if "activation" in self.names:
            kernel = kernels.add_fibre_work(self._kind)
            self._launch(kernel, [self._law.material, u, adjoint, scale], self._of_activation)
        if "rest" in self.names:
            self._add_rest(u, adjoint)

    def clear(self) -> None:
        """Begin the sums again."""
        for array in (self._of_mu, self._of_lam, self._of_activation, self._of_rest):
            array.zero_()

    def of_lame(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """The derivatives with respect to mu and lambda of forces, float64 [worlds * T]."""
        return self._of_mu.numpy(), self._of_lam.numpy()

    def of_activation(self) -> npt.NDArray[np.float64]:
        """The derivative with respect to active stress, float64 [worlds * T]."""
        return np.asarray(self._of_activation.numpy())

    def of_rest(self) -> npt.NDArray[np.float64]:
        """The derivative with respect to rest positions, float64 [worlds * N, 3]."""
        return np.asarray(self._of_rest.numpy()[: self.field.discretization.sizes.nodes, :3], np.float64)

    def of_weights(self, densities: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """The derivative with respect to rest positions of the work of weights, float64 [worlds * N, 3].

        Args:
            densities: Density of that work in elements [J/m^3], [worlds * T].
        """
        discretization = self.field.discretization
        rest = wp.zeros(discretization.sizes.launch_nodes, dtype=wp.vec4, device=self.device)
        on_device = wp.array(densities, dtype=wp.float32, device=self.device)
        self._launch(kernels.add_rest_weight(self._kind), [on_device], rest)
        return np.asarray(rest.numpy()[: discretization.sizes.nodes, :3], np.float64)

    def _add_lame(self, u: wp.array, adjoint: wp.array, scale: float) -> None:
        kernel = kernels.add_stress_work(self._kind, IsotropicMaterial, self._law.stress)
        self._launch(kernel, [self._unit_mu, u, adjoint, scale], self._of_mu)
        if self._shared is None:
            self._launch(kernel, [self._unit_lam, u, adjoint, scale], self._of_lam)
        else:
            shared = self._shared.share_weights(u, adjoint)
            kernel = kernels.add_dilatation_work(self._kind, self._shared.of)
            self._launch(kernel, [shared, u, adjoint, scale], self._of_lam)

    def _add_rest(self, u: wp.array, adjoint: wp.array) -> None:
        law = self._law
        kernel = kernels.add_rest_work(self._kind, law.Material, law.stress, law.differential)
        self._launch(kernel, [law.material, u, adjoint], self._of_rest)
        if self._shared is not None:
            shared = self._shared.share_weights(u, adjoint)
            kernel = kernels.add_dilatation_rest_work(self._kind, self._shared.of)
            self._launch(kernel, [self._shared.isotropic, shared, u, adjoint], self._of_rest)

    @property
    def _law(self) -> StressLaw:
        law = (self._shared.shear if self._shared else self.field).stress_law
        assert law is not None
        return law

    @property
    def _kind(self) -> type:
        return self.field.discretization.element_kind

    def _lame(self, mu: float, lam: float) -> IsotropicMaterial:
        return isotropic_material([*(wp.full(1, v, dtype=wp.float32, device=self.device) for v in (mu, lam)), 0])

    def _launch(self, kernel: wp.Kernel, inputs: list, output: wp.array) -> None:
        elements: Elements = self.field.discretization.elements
        wp.launch(kernel, self.field.element_count, [elements, *inputs], [output], device=self.device)


def _listed(names: set[str]) -> str:
    words = {"lame": "moduli", "rest": "the rest shape", "activation": "active stress"}
    return " and ".join(words[name] for name in sorted(names))


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
            self.loads[:count].assign(_four(body.conditions.loads.numpy()[:count, :3]))
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

    def derivatives(self) -> dict[str, Any]:
        """The derivatives with respect to everything but the initial state; "rest" lacks the part of that state."""
        count = self.body.sizes.nodes
        moved = self.of_loads.numpy()[:count, :3].astype(np.float64)
        return derivatives(self.body, self.work, self.names, moved, self._of_mass.numpy()[:count])


class Work(Protocol):
    """Sums of elements; see ``ElementWork``."""

    def of_lame(self) -> tuple[Array, Array]: ...

    def of_activation(self) -> Array: ...

    def of_rest(self) -> Array: ...

    def of_weights(self, densities: Array) -> Array: ...


def derivatives(body: SoftBody, work: Work, names: Sequence[str], moved: Array, of_mass: Array) -> dict[str, Any]:
    """Derivatives of these names from sums.

    Args:
        body: The body.
        work: The sums of elements.
        names: Any except "boundary" and those of an initial state; "rest" is the derivative at constant positions.
        moved: The sum of adjoint motions, [worlds * N, 3].
        of_mass: The derivative with respect to the mass of each node, [worlds * N].
    """
    found: dict[str, Any] = {}
    for name in names:
        if name == "loads":
            found[name] = moved
        elif name == "gravity":
            found[name] = body.masses @ moved
        elif name == "young":
            found[name] = of_young(body, *work.of_lame())
        elif name == "poisson":
            found[name] = of_poisson(body, *work.of_lame())
        elif name == "density":
            found[name] = of_density(body, of_mass)
        elif name == "activation":
            found[name] = work.of_activation().reshape(body.worlds, -1)
        elif name == "rest":
            found[name] = work.of_rest() + work.of_weights(weight_densities(body, of_mass))
    return found


def _four(values: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    return np.pad(values.astype(np.float32), ((0, 0), (0, 1)))


#: The sums of ``ElementWork`` that each of these needs.
NEEDS = {
    "young": "lame",
    "poisson": "lame",
    "rest": "rest",
    "activation": "activation",
    "density": None,
    "loads": None,
    "boundary": None,
    "gravity": None,
    "obstacles": None,
}


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


def requested(found: object, name: str, known: Collection[str]) -> Any:
    """A derivative by its name.

    Raises:
        InputError: It was not requested.
    """
    if name not in known or getattr(found, name) is None:
        raise InputError(f"{shown(name)} is not one of the requested derivatives")
    return getattr(found, name)


def of_young(body: SoftBody, of_mu: Array, of_lam: Array) -> Array | float:
    """The derivative with respect to Young's modulus, in the shape of the material's value."""
    _, nu = _young_and_poisson(body)
    d_mu, d_lam = 1.0 / (2.0 * (1.0 + nu)), nu / ((1.0 + nu) * (1.0 - 2.0 * nu))
    return _of_shape(body, "young", d_mu * _filled(body, of_mu) + d_lam * _filled(body, of_lam))


def of_poisson(body: SoftBody, of_mu: Array, of_lam: Array) -> Array | float:
    """The derivative with respect to Poisson's ratio, in the shape of the material's value."""
    young, nu = _young_and_poisson(body)
    d_mu = -young / (2.0 * (1.0 + nu) ** 2)
    d_lam = young * (1.0 + 2.0 * nu**2) / ((1.0 + nu) * (1.0 - 2.0 * nu)) ** 2
    return _of_shape(body, "poisson", d_mu * _filled(body, of_mu) + d_lam * _filled(body, of_lam))


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


def _young_and_poisson(body: SoftBody) -> tuple[Array, Array]:
    material = body.material.isotropic
    return np.asarray(material.young, np.float64), np.asarray(material.poisson, np.float64)


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
    if shape == ():
        return float(values.sum())
    if len(shape) == 1:
        values = values.sum(axis=0)
        return values if shape == values.shape else values.sum(keepdims=True)
    for axis, count in enumerate(shape):
        if count == 1:
            values = values.sum(axis=axis, keepdims=True)
    return values
