"""Static answers: Newton's method from the answer on a coarser mesh, and smaller parts of the load if it must be.

Along the direction of Newton's method, volumes are kept to first order only. With a lambda of thousands of mu, the rest
costs so much energy that a line search takes hundreds of short steps where tissue turns far. So bodies with a smaller
lambda are solved first, each from the answer of the one before.

The mesh of an earlier level needs an eighth of the elements, and the state of rest there, with its displacements
interpolated at the midpoints of edges, is so near to the answer that Newton's method takes a third of its iterations.
The coarser body has the mean of its elements' stiffness and the loads that do the same work in interpolated motions.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.body.soft_body import SoftBody
from warp_corot.elasticity import Corotated, ForceField, Model, NeoHookean
from warp_corot.kernels.implicit import newton as kernels
from warp_corot.materials.isotropic import Isotropic
from warp_corot.mesh import TetForest
from warp_corot.mesh.coarser import Coarser, coarser

from .block_system import BlockSystem
from .newton import Newton, NewtonReport
from .preconditioners import preconditioner_of
from .tangent import TangentOperator

#: Lambda over mu of the first body; those that follow have more by this factor.
FIRST, FACTOR = 4.0, 10.0


def limits(field: ForceField) -> list[float]:
    """Ascending limits of lambda over mu up to a field's own, which is not included; empty if it needs none."""
    discretization = field.discretization
    if discretization.is_anisotropic or field.is_linear:
        return []
    mu, lam = discretization.mu.numpy(), discretization.lam.numpy()
    most = float(np.max(lam[mu > 0.0] / mu[mu > 0.0], initial=0.0))
    found = []
    limit = FIRST
    while limit * FACTOR <= 2.0 * most:
        found.append(limit)
        limit *= FACTOR
    return found


@contextmanager
def limited(field: ForceField, limit: float) -> Iterator[None]:
    """Inside this block, lambda of a field is at most this many times mu; launches that were recorded before use it,
    too.
    """
    discretization = field.discretization
    mu, lam = discretization.mu.numpy(), discretization.lam.numpy().copy()
    discretization.lam.assign(np.minimum(lam, limit * mu))
    try:
        yield
    finally:
        discretization.lam.assign(lam)


#: Mass in the operator of a free body, as a fraction of that of its slowest vibration.
SHIFT = 1.0
#: The smallest fraction of the load that is added in one step.
LEAST_SHARE = 1.0 / 64.0
#: Maximum number of iterations of a linear solve.
LINEAR_ITERATIONS = 5000
#: Newton's tolerance for intermediate states.
ROUGH = 1e-3


class StaticSolver:
    """Finds the state of rest of a body under its loads, from its present displacements.

    Args:
        body: The body.
        field: Its elastic forces.
        gravity: [m/s^2].
        tolerance: The tolerance, as for ``Newton``.
        most: Maximum number of iterations of each load step.
        load_steps: Number of equal steps in which loads and gravity are added.
        preconditioner: The name of a preconditioner, or None.
        least_share: The smallest fraction of the load that is added in one step.

    Attributes:
        iterations, linear_iterations: Sums over all load steps, of the world that needed most.
        share: The fraction of the load in the last good state, of worlds that are not at rest under all of it.
    """

    def __init__(
        self,
        body: SoftBody,
        field: ForceField,
        gravity: Sequence[float],
        *,
        tolerance: float,
        most: int,
        load_steps: int,
        preconditioner: str | None,
        least_share: float = LEAST_SHARE,
    ):
        self.body, self.field, self._load_steps, self._least_share = body, field, load_steps, least_share
        self.operator = TangentOperator(body, field, exact=True)
        chosen = preconditioner_of(preconditioner, self.operator, few_digits=True)
        system = BlockSystem([self.operator], [chosen], most=LINEAR_ITERATIONS)
        self.newton = Newton(system, gravity, tolerance=tolerance, most=most)
        self.iterations = self.linear_iterations = 0
        self.share = 0.0

    def solve(self, near: npt.NDArray[np.float32] | None = None) -> NewtonReport:
        """Find the state of rest, or leave worlds that have none in the last good state on the way there. Waits for the
        device. Worlds are at rest under the whole load where the report says that they converged.

        Args:
            near: Displacements near the answer [m], [nodes, 4]. They are used if the body's free nodes are at rest,
                their energy is less, and they turn no element over.

        If the search begins with elements turned over, their neighbours may hold such elements in place. Then another
        search begins with all free nodes at rest, and the state with less energy is used.
        """
        state = self.body.state
        self.operator.set_scales(self._keep_free_worlds(), 0.0, 1.0)
        graph = self._record()
        self._limits = limits(self.field) if self._load_steps == 1 else []
        given, rest = wp.clone(state.displacements), self._free_nodes_at_rest()
        if near is not None and np.array_equal(given.numpy(), rest) and self._is_better(near):
            report = self._solve_from(given, graph, wp.array(near - rest, dtype=wp.vec4, device=self.body.device))
            if report.converged.all():
                return report
        report = self._solve_from(given, graph)
        if np.array_equal(given.numpy(), rest) or (report.converged.all() and not self._turned_over()):
            return report
        first, share, energy = wp.clone(state.displacements), self.share, self._energy()
        again = self._solve_from(wp.array(rest, dtype=wp.vec4, device=self.body.device), graph)
        if again.converged.all() and (not report.converged.all() or self._energy() <= energy):
            return again
        self.share = share
        wp.copy(state.displacements, first)
        return report

    def _solve_from(self, start: wp.array, graph: wp.Graph, first: wp.array | None = None) -> NewtonReport:
        """Add the load at once, or in parts, smaller and smaller ones where Newton's method does not converge; the
        first search begins at an increment, if there is one."""
        newton = self.newton
        wp.copy(newton.base, start)
        newton.increment.zero_()
        good = wp.clone(newton.increment)
        if first is not None:
            wp.copy(newton.increment, first)
        self.share, step = 0.0, 1.0 / self._load_steps
        answers = _Answers(newton)
        if self._limits:
            report = self._solve_at_once(start, graph)
            if report.converged.all():
                self.share = 1.0
                return report
            answers.take(report, 1.0)
            wp.copy(newton.increment, good)
            step = 0.5
        while True:
            share = self.share + step
            share = 1.0 if share > 1.0 - 1e-9 else share
            report = self._run(graph, share)
            if report.converged.all():
                self.share = share
                if share == 1.0:
                    return report
                wp.copy(good, newton.increment)
                continue
            answers.take(report, share)
            wp.copy(newton.increment, good)
            step *= 0.5
            if step < self._least_share or answers.found.all():
                self.share = 1.0 if answers.found.all() else self.share
                answers.put_into(good)
                self._put_back(good)
                return answers.reported(report)

    def _solve_at_once(self, start: wp.array, graph: wp.Graph) -> NewtonReport:
        """Add the whole load to a body that hardly changes its volume: from a state that is not at rest directly, which
        may be near, and else through states in which volumes change more easily."""
        newton = self.newton
        if start.numpy()[self.body.conditions.inverse_mass.numpy() > 0.0].any():
            report = self._run(graph, 1.0)
            if report.converged.all():
                return report
            newton.increment.zero_()
        tolerance, newton.tolerance = newton.tolerance, ROUGH
        rough = self._record()
        newton.tolerance = tolerance
        for limit in self._limits:
            with limited(self.field, limit):
                self._run(rough, 1.0)
        return self._run(graph, 1.0)

    def _keep_free_worlds(self) -> float:
        """Keep free worlds where they are: a uniform acceleration balances the small rest of their loads (inertia
        relief). Returns the factor of the mass that makes the operator definite there [1/s^2].
        """
        body, worlds = self.body, self.body.worlds
        free = np.logical_not(body.conditions.held_mask().reshape(worlds, -1).any(axis=1))
        if not free.any():
            return 0.0
        masses = body.masses.reshape(worlds, -1, 1)
        mean = self._loads().reshape(worlds, -1, 3).sum(axis=1, keepdims=True) / masses.sum(axis=1, keepdims=True)
        pull = np.zeros((len(self.newton.pull), 4), np.float32)
        pull[: body.sizes.nodes, :3] = np.where(free[:, None, None], -mean, 0.0 * masses).reshape(-1, 3)
        self.newton.pull.assign(pull)
        size = float(np.ptp(body.mesh.points, axis=0).max())
        density = masses.sum() / (worlds * np.sum(body.mesh.volumes))
        return SHIFT * float(body.discretization.mu.numpy().mean()) / (density * size**2)

    def _free_nodes_at_rest(self) -> npt.NDArray[np.float32]:
        """Displacements of held nodes, and zero at others [n, 4]."""
        u = self.body.state.displacements.numpy().copy()
        u[self.body.conditions.inverse_mass.numpy() > 0.0] = 0.0
        return u

    def _turned_over(self, displacements: npt.NDArray[np.float32] | None = None) -> bool:
        """Whether an element is inside out, at the present displacements or at others."""
        mesh, body = self.body.mesh, self.body
        u = body.state.displacements.numpy() if displacements is None else displacements
        at_rest = _determinants(mesh.points, mesh.tets)
        for world in u[: body.sizes.nodes, :3].reshape(body.worlds, -1, 3):
            if (_determinants(mesh.points + world, mesh.tets) * at_rest <= 0.0).any():
                return True
        return False

    def _is_better(self, near: npt.NDArray[np.float32]) -> bool:
        """Whether displacements turn no element over and have less energy than the present ones, with the smallest
        lambda of the search."""
        if self._turned_over(near):
            return False
        with limited(self.field, self._limits[0]) if self._limits else nullcontext():
            return self._energy(wp.array(near, dtype=wp.vec4, device=self.body.device)) < self._energy()

    def _energy(self, displacements: wp.array | None = None) -> float:
        """Strain energy minus the work of loads and gravity [J], of all worlds."""
        count = self.body.sizes.nodes
        where = self.body.state.displacements if displacements is None else displacements
        u = where.numpy()[:count, :3].astype(np.float64)
        return float(self.field.potentials(where).sum()) - float(np.sum(self._loads() * u))

    def _loads(self) -> npt.NDArray[np.float64]:
        """Loads and weight [N], [worlds * N, 3]."""
        return self.body.conditions.loads_and_weights([*self.newton.gravity])

    def _run(self, graph: wp.Graph, share: float) -> NewtonReport:
        """Newton's method at one share of the load."""
        newton = self.newton
        newton.external_share.fill_(share)
        newton.launch_begin()
        while newton.running.numpy()[0] > 0:
            wp.capture_launch(graph)
        report = newton.report()
        self.iterations += int(report.iterations.max())
        self.linear_iterations += int(report.linear_iterations.max())
        return report

    def _record(self) -> wp.Graph:
        """Record an iteration, after everything that it uses exists."""
        newton, u = self.newton, self.body.state.displacements
        self.field.elastic_forces(u)
        self.field.potentials(u)
        self.operator.take(u)
        with wp.ScopedCapture(device=self.body.device) as capture:
            newton.launch_iteration()
        return capture.graph

    def _put_back(self, increment: wp.array) -> None:
        wp.copy(self.newton.increment, increment)
        self.newton.running.zero_()
        self.newton.launch_begin()


class _Answers:
    """The worlds that came to rest under the whole load while others did not, and where they did.

    Attributes:
        found: Whether each world has, bool [worlds].
    """

    def __init__(self, newton: Newton):
        self._newton, worlds = newton, newton.worlds
        self.found = np.zeros(worlds, bool)
        self._status = np.full(worlds, int(kernels.STUCK), np.int32)
        self._kept = np.zeros((worlds, newton.operator.node_count, 4), np.float32)

    def take(self, report: NewtonReport, share: float) -> None:
        """Keep the worlds that are at rest under the whole load for the first time, and why others failed. Waits for
        the device."""
        self._status = np.where(report.converged, self._status, report.status)
        new = report.converged & ~self.found & (share == 1.0)
        if new.any():
            self._kept[new] = self._by_world(self._newton.increment.numpy())[new]
            self.found |= new

    def put_into(self, increment: wp.array) -> None:
        """Put the worlds that were kept into an increment."""
        values = increment.numpy().copy()
        self._by_world(values)[self.found] = self._kept[self.found]
        increment.assign(values)

    def reported(self, report: NewtonReport) -> NewtonReport:
        """The report with the status of each world under the whole load."""
        return replace(report, status=np.where(self.found, int(kernels.CONVERGED), self._status))

    def _by_world(self, values: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        worlds, count = len(self.found), self._newton.operator.node_count
        return values[: worlds * count].reshape(worlds, count, 4)


def _determinants(points: npt.NDArray[np.float64], tets: npt.NDArray[np.int32]) -> npt.NDArray[np.float64]:
    """Six times the volume of each tetrahedron, with its sign."""
    x = np.ascontiguousarray(points.T)
    a, b, c = ([row[tets[:, k]] - row[tets[:, 0]] for row in x] for k in (1, 2, 3))
    return a[0] * (b[1] * c[2] - b[2] * c[1]) + a[1] * (b[2] * c[0] - b[0] * c[2]) + a[2] * (b[0] * c[1] - b[1] * c[0])


def status_words(report: NewtonReport) -> str:
    """The reason why Newton's method ended in the worlds that did not converge."""
    status = set(report.status[~report.converged].tolist())
    if int(kernels.BROKEN) in status:
        return "the state is not finite"
    if int(kernels.LIMIT) in status:
        return "the iterations were not enough"
    return "no step along the search direction lowers the energy"


#: Bodies with fewer elements, of all worlds, are solved at once: a solve has some 10 ms of its own.
FEWEST_NESTED = 8192
#: The tolerance of the coarser answer.
COARSE_TOLERANCE = 1e-2
#: The most iterations there.
COARSE_ITERATIONS = 40


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
    options: dict[str, Any] = {
        "tolerance": COARSE_TOLERANCE,
        "most": COARSE_ITERATIONS,
        "load_steps": 1,
        "least_share": 1.0,
    }
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
        nodes, ends = levels.nodes.numpy(), levels.ends.numpy()
        parts = [slice(*levels.starts[level : level + 2]) for level in range(self._level + 1, levels.depth + 1)]
        self._midpoints = [(nodes[part], ends[part].T) for part in parts]

    def restrict(self, values: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
        """The transpose, from the mesh's nodes [worlds * N, 4] to the coarser one's [worlds, n, 4]."""
        levels = self._levels
        found = np.zeros((levels.node_count, levels.worlds, 4))
        found[: levels.mesh_nodes] = values.reshape(levels.worlds, -1, 4).swapaxes(0, 1)
        for nodes, ends in reversed(self._midpoints):
            for end in ends:
                np.add.at(found, end, 0.5 * found[nodes])
        return np.ascontiguousarray(found[self._nodes].swapaxes(0, 1))

    def prolongate(self, values: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
        """From the coarser mesh's nodes [worlds * n, 4] to the mesh's [worlds * N, 4]."""
        levels = self._levels
        found = np.zeros((levels.node_count, levels.worlds, 4))
        found[self._nodes] = values.reshape(levels.worlds, -1, 4).swapaxes(0, 1)
        for nodes, ends in self._midpoints:
            found[nodes] = 0.5 * (found[ends[0]] + found[ends[1]])
        return found[: levels.mesh_nodes].swapaxes(0, 1).reshape(-1, 4)


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
    if body.sizes.elements < FEWEST_NESTED or body.discretization.levels().depth <= 3:
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
