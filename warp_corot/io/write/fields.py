"""The fields of a frame: displacements and velocities of nodes, strain and stress of elements."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from warp_corot.elasticity.float64 import cauchy_stress, displacement_gradients, green_strain, has_tensor
from warp_corot.mesh.surfaces.boundary import right_handed, signed_volumes

if TYPE_CHECKING:
    from warp_corot.simulation.simulation import Simulation


@dataclass(frozen=True)
class Fields:
    """A frame.

    Attributes:
        time: Time [s].
        points: Rest positions [m], float64 [N, 3].
        tets: int32 [T, 4], none mirrored.
        nodal: Fields of nodes by name, [N] or [N, 3].
        elemental: Fields of elements by name, [T] or [T, 9], tensors row by row.
    """

    time: float
    points: npt.NDArray[np.float64]
    tets: npt.NDArray[np.int32]
    nodal: dict[str, npt.NDArray[Any]]
    elemental: dict[str, npt.NDArray[Any]]


def fields_of(sim: Simulation, worlds: Sequence[Any], time: float) -> Fields:
    """The current state of bodies in one world, body after body.

    Nodes have ``displacement`` [m], ``velocity`` [m/s] and ``fixed``; elements ``strain`` (Green-Lagrange), ``stress``
    [Pa] if the elastic law is local and isotropic, ``von_mises`` [Pa], and ``region`` if meshes have labels.

    Args:
        sim: The simulation.
        worlds: A view of one world of each body.
        time: Time of the frame [s].
    """
    meshes = [world.body.mesh for world in worlds]
    offsets = np.cumsum([0, *(len(mesh.points) for mesh in meshes)])
    nodal: dict[str, list[npt.NDArray[Any]]] = {}
    elemental: dict[str, list[npt.NDArray[Any]]] = {}
    tensors = all(has_tensor(model, w.body.material) for model, w in zip(sim.models, worlds, strict=True))
    labelled = any(getattr(mesh, "labels", None) is not None for mesh in meshes)
    for model, world, mesh in zip(sim.models, worlds, meshes, strict=True):
        displacements, body = world.displacements.numpy().astype(np.float64), world.body
        nodal.setdefault("displacement", []).append(displacements.astype(np.float32))
        nodal.setdefault("velocity", []).append(world.velocities.numpy())
        nodal.setdefault("fixed", []).append(body.constrained[world.nodes].astype(np.int8))
        a = displacement_gradients(mesh.points, mesh.tets, displacements)
        elemental.setdefault("strain", []).append(green_strain(a).reshape(-1, 9).astype(np.float32))
        if tensors:
            count = len(mesh.tets)
            young, poisson = (
                np.broadcast_to(getattr(body.material, name), (body.worlds, count))[world.index]
                for name in ("young", "poisson")
            )
            stress = cauchy_stress(model, a, young, poisson)
            elemental.setdefault("stress", []).append(stress.reshape(-1, 9).astype(np.float32))
        elemental.setdefault("von_mises", []).append(sim.von_mises(body)[world.elements])
        if labelled:
            labels = getattr(mesh, "labels", None)
            own = np.zeros(len(mesh.tets), np.int32) if labels is None else labels
            elemental.setdefault("region", []).append(own.astype(np.int32))
    points = np.concatenate([mesh.points for mesh in meshes])
    tets = np.concatenate([mesh.tets + n for mesh, n in zip(meshes, offsets[:-1], strict=True)]).astype(np.int32)
    return Fields(
        time,
        points,
        right_handed(tets, signed_volumes(points, tets) < 0.0),
        {name: np.concatenate(parts) for name, parts in nodal.items()},
        {name: np.concatenate(parts) for name, parts in elemental.items()},
    )
