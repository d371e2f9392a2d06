"""A user's objective, and copies of a body with some of its input replaced."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.body.soft_body import SoftBody
from warp_corot.errors import InputError
from warp_corot.inputs.checks import shown
from warp_corot.mesh import TetMesh

#: Positions [m] to a value that a tape differentiates, or to value and derivative.
Objective = Callable[[wp.array], Any]

WANTED = "a wp.array of one number, computed by Warp kernels, or a pair (value, gradient)"


def value_and_derivative(objective: Objective, positions: wp.array) -> tuple[float, npt.NDArray[np.float64]]:
    """The value of an objective, and its derivative with respect to positions, float64 [n, 3].

    Args:
        objective: A function of positions. It returns a ``wp.array`` of one number, computed by kernels that it
            launches, or a pair of a number and its derivative, [n, 3].
        positions: vec3 or vec3d [n].

    Raises:
        InputError: The objective returns something else, or a value that is not finite.
    """
    if not callable(objective):
        raise InputError(f"objective is {shown(objective)}; it must be a function of positions that gives {WANTED}")
    positions.requires_grad = True
    with wp.Tape() as tape:
        found = objective(positions)
    if isinstance(found, wp.array):
        if found.size != 1 or not found.requires_grad:
            raise InputError(
                f"objective gives an array of {found.size} numbers with requires_grad={found.requires_grad}; it must "
                "be one number, for instance in wp.zeros(1, dtype=float, requires_grad=True)"
            )
        tape.backward(found)
        found = found.numpy().ravel()[0], positions.grad
    try:
        value, gradient = found
        value = float(value)
        derivative = np.asarray(gradient.numpy() if isinstance(gradient, wp.array) else gradient, np.float64)
    except (TypeError, ValueError):
        raise InputError(f"objective gives {shown(found)}; it must give {WANTED}") from None
    if derivative.size != 3 * len(positions):
        wanted = f"it must be [{len(positions)}, 3]"
        raise InputError(f"the gradient that objective gives has shape {derivative.shape}; {wanted}")
    if not (np.isfinite(value) and np.isfinite(derivative).all()):
        raise InputError("objective gives a value or a gradient that is not finite")
    return value, derivative.reshape(-1, 3)


#: Names of the input that may be replaced; "gravity" does not belong to a body.
REPLACED = ("young", "poisson", "density", "loads", "boundary", "rest", "activation", "gravity")

Values = Mapping[str, npt.NDArray[Any]]


def with_values(body: SoftBody, values: Values) -> SoftBody:
    """A copy of a body: its mesh, material, displacements, supports, loads and active stress, or these values in their
    place.

    Args:
        body: The body, which does not change.
        values: The values by name: "young", "poisson" and "density" as a material takes them; "loads" [N],
            [worlds * N, 3]; "boundary", positions, of which only those of held nodes are read, [worlds * N, 3]; "rest",
            rest positions [N, 3], with which the mesh is a general one; "activation" [worlds, T] or as ``activate``
            takes it.

    Raises:
        InputError: A value cannot be used, or the rest shape of a mesh with cut elements is replaced.
    """
    count, nodes = body.sizes.nodes, np.arange(body.world_node_count)

    def nodal(name: str) -> npt.NDArray[np.float64]:
        array = np.asarray(values[name], np.float64)
        if array.shape != (count, 3):
            raise InputError(f"{name} has shape {array.shape}; it must be [{count}, 3]")
        return array

    arrays = {name: np.asarray(values[name], np.float64) for name in ("young", "poisson", "density") if name in values}
    moduli: dict[str, Any] = {name: array if array.ndim else float(array) for name, array in arrays.items()}
    material = replace(body.material, **moduli) if moduli else body.material
    mesh = _mesh(body, values.get("rest"))
    copy = SoftBody(mesh, material, worlds=body.worlds, device=body.device, threads=body.threads)
    conditions = copy.conditions
    wp.copy(conditions.held, body.conditions.held, count=count)
    conditions.find_inverse_masses()
    if "loads" in values or body.conditions.has_loads:
        loads = nodal("loads") if "loads" in values else body.conditions.loads.numpy()[:count, :3]
        copy.load(nodes, loads.reshape(body.worlds, -1, 3))
    if "activation" in values:
        copy.activate(np.asarray(values["activation"], np.float64))
    elif body.discretization.has_activation:
        conditions.make_activation()
        wp.copy(copy.discretization.activation, body.discretization.activation, count=body.sizes.elements)
    body.state.adopt_positions()
    displacements = body.state.displacements.numpy()[:count, :3].astype(np.float64)
    if "boundary" in values:
        held = body.conditions.held_mask()[:, None]
        displacements = np.where(held, nodal("boundary") - copy.rest_positions, displacements)
    copy.state.set_displacements(displacements)
    return copy


def _mesh(body: SoftBody, rest: npt.ArrayLike | None) -> Any:
    mesh = body.mesh
    if rest is None:
        return mesh
    if body.discretization.fill is not None:
        raise InputError("the mesh has cut elements, which belong to one rest shape; rest cannot be replaced")
    points = np.asarray(rest, np.float64)
    if points.shape != mesh.points.shape:
        raise InputError(f"rest has shape {points.shape}; it must be [{len(mesh.points)}, 3]")
    return TetMesh(points, mesh.tets, up_axis=mesh.up_axis)
