#!/usr/bin/env python3
"""Iterations and time of conjugate gradients with each preconditioner, over levels of a beam and of an adaptive body.

    python benchmarks/solvers.py [--device cuda:0] [--levels 6 9 12] [--poisson 0.3 0.45 0.49] [--tolerance 1e-4]
                                 [--dilatation shared] [--json FILE] [--plot FILE]

The system is the stiffness at rest, 50 kPa, and the weight. Elements have their own dilatation, or share it. The beam
of 64 x 64 x 192 mm is clamped at one end. The adaptive body is two merged balls of levels up to --levels, with the
lowest tenth of the nodes held. A time is the least of several recorded runs of one linearisation and its solve. That of
PyAMG (smoothed aggregation with the six rigid motions, float64, conjugate gradients) is its own set-up and solve. If a
direct solve is quick, every answer is compared with SciPy's in the energy norm.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from measure import Parser, machine, number, save, table, tell
from problem import oracle
from scipy.sparse import csr_matrix, diags
from scipy.sparse.linalg import spsolve

import warp_corot as wc
from warp_corot.inputs.checks import checked_device
from warp_corot.solvers.implicit.conjugate_gradients import ConjugateGradients
from warp_corot.solvers.implicit.preconditioners import BlockDiagonal, preconditioner_of
from warp_corot.solvers.implicit.tangent import TangentOperator

YOUNG, DENSITY, DOWN = 50e3, 1000.0, np.array([0.0, -9.8, 0.0])
MOST = 10000
#: A solve is repeated until this much time is spent [s], or this often.
TIMED, ROUNDS = 2.0, 9
#: Bodies of more free nodes are not solved directly.
MOST_DIRECT = 5000
#: An answer with a larger error is wrong.
WRONG = 1e-2
HEADER = ("body", "level", "elements", "Poisson", "preconditioner", "iterations", "ms", "ns/element", "error")


@dataclass
class Row:
    """One solve; ``error`` is relative, in the energy norm."""

    body: str
    level: int
    elements: int
    poisson: float
    preconditioner: str
    iterations: int
    seconds: float
    error: float | None

    def cells(self) -> list[str]:
        per_element = number(1e9 * self.seconds / self.elements)
        shown = [self.body, str(self.level), str(self.elements), str(self.poisson), self.preconditioner]
        return [
            *shown,
            str(self.iterations),
            number(1e3 * self.seconds),
            per_element,
            "-" if self.error is None else f"{self.error:.0e}",
        ]


class Nothing:
    """No preconditioner."""

    def update(self, operator: TangentOperator) -> None: ...

    def apply(self, r: wp.array, z: wp.array) -> None:
        wp.copy(z, r)


PRECONDITIONERS: dict[str, Callable[[TangentOperator], Any]] = {
    "none": lambda operator: Nothing(),
    "diagonal": BlockDiagonal,
    "multigrid": lambda operator: preconditioner_of("multigrid", operator),
}


class Problem:
    """A held body under its weight, on a device and as a float64 matrix of its free nodes."""

    def __init__(self, mesh: wc.TetForest, fixed: np.ndarray, poisson: float, dilatation: str, device: wp.Device):
        self.mesh, self.free = mesh, ~fixed
        self.body = wc.SoftBody(mesh, wc.Isotropic(YOUNG, poisson, DENSITY), device=device)
        self.body.fix(fixed)
        self.operator = TangentOperator(self.body, wc.Linear(dilatation=dilatation).bind(self.body))
        self.right = np.where(fixed[:, None], 0.0, self.body.masses[:, None] * DOWN)
        reference, fill = oracle.Mesh(mesh.points, mesh.tets), 1.0 if mesh.fill is None else mesh.fill
        mu, lam = (value * fill for value in oracle.lame(YOUNG, poisson))
        rows = np.repeat(self.free, 3)
        shares = np.broadcast_to(mu, len(mesh.tets)), np.broadcast_to(lam, len(mesh.tets))
        if dilatation == "shared":
            shear = oracle.tangent_matrix("linear", reference, mesh.points, shares[0], 0.0 * shares[1])
            whole = shear + shared_part(reference, shares[1], self.operator.field.groups())
        else:
            whole = oracle.tangent_matrix("linear", reference, mesh.points, *shares)
        self.matrix = whole.tocsr()[rows][:, rows]
        small = self.free.sum() <= MOST_DIRECT
        self._direct = spsolve(self.matrix.tocsc(), self.right[self.free].ravel()) if small else None

    def error(self, x: np.ndarray) -> float | None:
        """The relative error of displacements of all nodes; None if there is no direct solution."""
        if self._direct is None:
            return None
        off = x[self.free].ravel() - self._direct
        return float(np.sqrt(off @ (self.matrix @ off) / (self._direct @ (self.matrix @ self._direct))))

    def solve(self, name: str, tolerance: float) -> tuple[int, float, float | None]:
        """Iterations, time [s] and error."""
        operator, device = self.operator, self.body.device
        padded = np.zeros((len(self.right), 4), np.float32)
        padded[:, :3] = self.right
        b = wp.array(padded, dtype=wp.vec4, device=device)
        x, u = wp.zeros_like(b), self.body.state.displacements
        preconditioner = PRECONDITIONERS[name](operator)
        cg = ConjugateGradients(operator, len(b), most=MOST)
        cg.tolerance.fill_(tolerance)

        def launch() -> None:
            operator.take(u)
            preconditioner.update(operator)
            cg.launch(preconditioner, b, x)

        launch()
        with wp.ScopedCapture(device=device) as capture:
            launch()
        times: list[float] = []
        while len(times) < ROUNDS and sum(times) < TIMED:
            times.append(self._timed(capture.graph))
        return int(cg.report().iterations[0]), min(times), self.error(x.numpy()[:, :3].astype(float))

    def _timed(self, graph: wp.Graph) -> float:
        wp.synchronize_device(self.body.device)
        began = time.perf_counter()
        wp.capture_launch(graph)
        wp.synchronize_device(self.body.device)
        return time.perf_counter() - began

    def solve_algebraically(self, tolerance: float) -> tuple[int, float, float | None]:
        """The same with PyAMG."""
        import pyamg

        points = self.mesh.points[self.free] - self.mesh.points.mean(axis=0)
        motions = np.zeros((len(points), 3, 6))
        for axis in range(3):
            motions[:, axis, axis] = 1.0
            motions[:, :, 3 + axis] = np.cross(np.eye(3)[axis], points)
        residuals: list[float] = []
        began = time.perf_counter()
        solver = pyamg.smoothed_aggregation_solver(self.matrix.tobsr((3, 3)), B=motions.reshape(-1, 6))
        b = self.right[self.free].ravel()
        x = solver.solve(b, tol=tolerance, accel="cg", maxiter=MOST, residuals=residuals)
        seconds = time.perf_counter() - began
        everywhere = np.zeros_like(self.right)
        everywhere[self.free] = x.reshape(-1, 3)
        return len(residuals) - 1, seconds, self.error(everywhere)


def shared_part(mesh: Any, lam: np.ndarray, groups: list[np.ndarray]) -> csr_matrix:
    """The stiffness of a dilatation that groups of elements share: g g^T / sum of lambda V of each group, where g is
    the derivative of the sum of lambda V tr e."""
    weights = lam * mesh.volumes
    element = np.concatenate(groups)
    group = np.repeat(np.arange(len(groups)), [len(members) for members in groups])
    places = (3 * mesh.tets[:, :, None] + np.arange(3)).reshape(len(mesh.tets), 12)
    values = (mesh.gradients * weights[:, None, None]).reshape(len(mesh.tets), 12)[element]
    size = (len(groups), 3 * len(mesh.points))
    g = csr_matrix((values.ravel(), (np.repeat(group, 12), places[element].ravel())), size)
    return (g.T @ diags(1.0 / np.bincount(group, weights[element])) @ g).tocsr()


def beam(level: int) -> tuple[wc.TetForest, np.ndarray]:
    mesh = wc.TetForest.box((1, 1, 3), 0.064, level)
    return mesh, mesh.points[:, 2] < 1e-9


def balls(level: int) -> tuple[wc.TetForest, np.ndarray]:
    """Two merged balls, with elements filled down to 2 %."""
    domain = wc.Domain.sphere(0.1, device="cpu") | wc.Domain.sphere(0.06, (0.11, 0.02, 0.01), device="cpu")
    mesh = wc.TetForest.from_domain(domain, 0.12, max_level=level, surface_error=0.0005)
    return mesh, mesh.points[:, 1] <= np.quantile(mesh.points[:, 1], 0.1)


def rows(options: argparse.Namespace, device: wp.Device, names: list[str]) -> Iterator[Row]:
    for body, make in (("beam", beam), ("balls", balls)):
        for level in options.levels:
            mesh, fixed = make(level)
            for poisson in options.poisson:
                problem = Problem(mesh, fixed, poisson, options.dilatation, device)
                for name in names:
                    tell(f"{body}, level {level}, Poisson's ratio {poisson}, {name}")
                    is_ours = name in PRECONDITIONERS
                    solve = (lambda t, n=name, p=problem: p.solve(n, t)) if is_ours else problem.solve_algebraically
                    yield Row(body, level, len(mesh.tets), poisson, name, *solve(options.tolerance))


def plot(found: list[Row], path: Path) -> None:
    """Iterations over elements."""
    from matplotlib import pyplot
    from matplotlib.ticker import NullFormatter

    figure, axes = pyplot.subplots(1, 2, figsize=(10, 4), sharey=True, layout="constrained")
    for axis, body in zip(axes, ("beam", "balls"), strict=True):
        kept = [row for row in found if row.body == body]
        for n, poisson in enumerate(sorted({row.poisson for row in kept})):
            for name, style in (("none", ":"), ("diagonal", "--"), ("multigrid", "-"), ("PyAMG", "-.")):
                line = [(r.elements, r.iterations) for r in kept if (r.preconditioner, r.poisson) == (name, poisson)]
                if line:
                    axis.loglog(*zip(*line, strict=True), style, marker="o", color=f"C{n}", label=f"{name}, {poisson}")
        axis.set(title=body, xlabel="elements")
        axis.xaxis.set_minor_formatter(NullFormatter())  # its numbers would overlap
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("iterations")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside right upper", fontsize=8)
    figure.savefig(path)
    print(f"wrote {path}")


def main() -> int:
    of = Parser(prog="solvers.py", description="Preconditioners of conjugate gradients over levels.")
    of.add_argument("--device", help="cpu, cuda:0, … (default: Warp's)")
    of.add_argument("--levels", type=int, nargs="+", default=[6, 9, 12], help="3 to 21 (default: 6 9 12)")
    of.add_argument("--poisson", type=float, nargs="+", default=[0.3, 0.45, 0.49], help="Poisson's ratios")
    of.add_argument("--tolerance", type=float, default=1e-4, help="of the residual (default: 1e-4)")
    of.add_argument("--dilatation", default="element", choices=["element", "shared"], help="of the law")
    of.add_argument("--json", type=Path, metavar="FILE", help="write everything to this file, too")
    of.add_argument("--plot", type=Path, metavar="FILE", help="draw iterations over elements")
    options = of.parse_args()
    if not all(3 <= level <= 21 for level in options.levels):
        of.error(f"--levels is {options.levels}; levels must be from 3 to 21")
    if not all(0.0 <= poisson < 0.5 for poisson in options.poisson):
        of.error(f"--poisson is {options.poisson}; ratios must be from 0 to below 0.5")
    wp.config.log_level = wp.LOG_ERROR
    device = checked_device(options.device)
    names = list(PRECONDITIONERS)
    try:
        import pyamg

        names.append("PyAMG")
        print(f"PyAMG {pyamg.__version__} in {np.dtype(np.float64)}, one core", file=sys.stderr)
    except ImportError:
        print("PyAMG is not installed (pip install pyamg); its rows are left out", file=sys.stderr)
    found = list(rows(options, device, names))
    print(table(HEADER, [row.cells() for row in found], left=1))
    if options.json is not None:
        save(
            options.json,
            machine(device)
            | {
                "tolerance": options.tolerance,
                "dilatation": options.dilatation,
                "rows": [asdict(row) for row in found],
            },
        )
    if options.plot is not None:
        plot(found, options.plot)
    wrong = [row for row in found if row.error is not None and not row.error < WRONG]
    for row in wrong:
        print(f"WRONG: {row.body}, {row.level}, {row.preconditioner}: error {row.error:.1e}", file=sys.stderr)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
