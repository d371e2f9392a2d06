"""The state in which the search for a static answer begins: the answer on a coarser mesh of the same forest.

The mesh of an earlier level needs an eighth of the elements, and the state of rest there, with its displacements
interpolated at the midpoints of edges, is so near to the answer that Newton's method takes a third of its iterations.
The coarser body has the mean of its elements' stiffness and the loads that do the same work in interpolated motions.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.body.soft_body import SoftBody
from warp_corot.elasticity import Corotated, ForceField, Model, NeoHookean
from warp_corot.materials.isotropic import Isotropic
from warp_corot.mesh import TetForest
from warp_corot.mesh.coarser import Coarser, coarser

from .static import StaticSolver
from .volume import FIRST, limits

#: Bodies with fewer elements, of all worlds, are solved at once: a solve has some 10 ms of its own.
FEWEST = 8192
#: The tolerance of the coarser answer.
TOLERANCE = 1e-2
#: The most iterations there.
MOST = 40


def nested_start(
    body: SoftBody, law: Model, field: ForceField, loads: npt.NDArray[np.float64]
) -> npt.NDArray[np.float32] | None:
    """Displacements near the state of rest of a body whose free nodes do not move yet [m], [nodes, 4], or None.

    Args:
        body: The body. Its held nodes have their displacements.
        law: The elastic model.
        field: Its forces.
        loads: Loads and weight [N], [worlds * N, 3].
    """
    if not _is_nested(body, law):
        return None
    between = _Interpolation(body)
    held, given = body.conditions.held_mask()[:, None], body.state.displacements.numpy()[: body.sizes.nodes]
    # A coarser node is held if a held node depends on it, so that no held node would move.
    of_free = between.restrict(np.column_stack([np.where(held, 0.0, loads), held]))
    of_held = between.restrict(np.column_stack([np.where(held, given[:, :3], 0.0), held]))
    is_held = of_held[..., 3] > 0.0
    if is_held.all() or not is_held.any(axis=1).all():
        return None
    coarse = _coarse_body(body, between.coarser, bool(limits(field)))
    coarse.fix(is_held)
    nodes = coarse.sizes.nodes
    displaced = np.zeros_like(of_held)
    displaced[is_held, :3] = of_held[is_held, :3] / of_held[is_held, 3:]
    coarse.state.displacements[:nodes].assign(displaced.reshape(-1, 4))
    of_free[..., 3] = 0.0
    coarse.conditions.make_loads()
    coarse.conditions.loads[:nodes].assign(of_free.reshape(-1, 4))
    like: Any = replace(law, dilatation="shared" if field.shares_dilatation else "element")  # type: ignore[type-var]
    forces = like.bind(coarse)
    first = nested_start(coarse, like, forces, of_free.reshape(-1, 4)[:, :3].astype(np.float64))
    options: dict[str, Any] = {"tolerance": TOLERANCE, "most": MOST, "load_steps": 1, "least_share": 1.0}
    solver = StaticSolver(coarse, forces, (0.0, 0.0, 0.0), preconditioner="multigrid", **options)
    solver.solve(first)
    if solver.share < 1.0:
        return None
    start = np.zeros((len(body.state.displacements), 4), np.float32)
    found = between.prolongate(coarse.state.displacements.numpy()[:nodes])
    start[: body.sizes.nodes] = np.where(held, given, found)
    return start


class _Interpolation:
    """Linear interpolation from the mesh three levels up.

    Attributes:
        coarser: That mesh.
    """

    def __init__(self, body: SoftBody):
        mesh, self._levels = body.mesh, body.discretization.levels()
        assert isinstance(mesh, TetForest)
        levels = self._levels
        self._level = (levels.depth - 1) // 3 * 3
        self.coarser = coarser(mesh, self._level)
        # Lattice points of the mesh, by their number among the nodes of all levels.
        number = np.full(len(mesh.lattice), -1)
        number[: levels.mesh_nodes] = np.arange(levels.mesh_nodes)
        number[levels.others.numpy()] = np.arange(levels.mesh_nodes, levels.node_count)
        self._nodes = number[self.coarser.nodes]

    def restrict(self, values: npt.NDArray[np.floating]) -> npt.NDArray[np.float32]:
        """The transpose, from the mesh's nodes [worlds * N, 4] to the coarser one's [worlds, n, 4]."""
        levels = self._levels
        everywhere = np.zeros((levels.worlds, levels.node_count, 4), np.float32)
        everywhere[:, : levels.mesh_nodes] = values.reshape(levels.worlds, -1, 4)
        x = wp.array(everywhere.reshape(-1, 4), dtype=wp.vec4, device=levels.device)
        levels.restrict(x, self._level)
        return x.numpy().reshape(everywhere.shape)[:, self._nodes]

    def prolongate(self, values: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """From the coarser mesh's nodes [worlds * n, 4] to the mesh's [worlds * N, 4]."""
        levels = self._levels
        everywhere = np.zeros((levels.worlds, levels.node_count, 4), np.float32)
        everywhere[:, self._nodes] = values.reshape(levels.worlds, -1, 4)
        x = wp.array(everywhere.reshape(-1, 4), dtype=wp.vec4, device=levels.device)
        levels.prolongate(x, self._level)
        return x.numpy().reshape(everywhere.shape)[:, : levels.mesh_nodes].reshape(-1, 4)


def _is_nested(body: SoftBody, law: Model) -> bool:
    """Whether a coarser mesh may have an answer that is near. Bodies with cut elements, and laws that need many short
    steps, took as many iterations as without it."""
    if not (isinstance(body.mesh, TetForest) and isinstance(body.material, Isotropic) and body.device.is_cpu):
        return False
    if body.discretization.fill is not None:
        return False
    free = body.conditions.inverse_mass.numpy() > 0.0
    if body.state.displacements.numpy()[free].any():
        return False
    if body.sizes.elements < FEWEST or body.discretization.levels().depth <= 3:
        return False
    if isinstance(law, Corotated):
        return law.rotation_level is None
    return isinstance(law, NeoHookean)


def _coarse_body(body: SoftBody, found: Coarser, compressible: bool) -> SoftBody:
    """The body on the coarser mesh, with the stiffness and the weights of a light one."""
    discretization, worlds = body.discretization, body.worlds
    mu, lam = discretization.mu.numpy(), discretization.lam.numpy()
    if discretization.material_stride:
        weights, total = body.mesh.volumes, found.forest.volumes
        mu, lam = (_means(each.reshape(worlds, -1), found.leaves, weights, total) for each in (mu, lam))
    mu, lam = mu.astype(np.float64), lam.astype(np.float64)
    if compressible:
        lam = np.minimum(lam, FIRST * mu)
    young, poisson = mu * (3.0 * lam + 2.0 * mu) / (lam + mu), lam / (2.0 * (lam + mu))
    if not discretization.material_stride:
        young, poisson = float(young[0]), float(poisson[0])
    return SoftBody(found.forest, Isotropic(young, poisson, 1.0), worlds=worlds, device=body.device)


def _means(
    values: npt.NDArray[np.float32], leaves: np.ndarray, volumes: np.ndarray, total: np.ndarray
) -> npt.NDArray[np.float64]:
    """The mean over the volume of each coarser leaf, [worlds, leaves]."""
    sums = [np.bincount(leaves, weights=row * volumes, minlength=len(total)) for row in values]
    return np.array(sums) / total
