"""Elastic laws in states of rest: patch test, bending, torsion, pressure, near incompressibility."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from warp_corot.body.soft_body import SoftBody
from warp_corot.elasticity import Corotated, Linear, Model, NeoHookean, StVenantKirchhoff
from warp_corot.errors import ConvergenceError
from warp_corot.materials.isotropic import Isotropic
from warp_corot.mesh import TetForest, TetMesh
from warp_corot.simulation.simulation import Simulation
from warp_corot.simulation.static import solve_static

from .case import Row, Setup, case

Array = npt.NDArray[np.float64]

NONE = (0.0, 0.0, 0.0)


def at_rest(body: SoftBody, model: Model) -> Array:
    """The displacements of a body at rest under its loads [m]; the nodes it holds stay where they are.

    Raises:
        ConvergenceError: No state of rest was found.
    """
    report = solve_static(body, model=model, gravity=NONE)
    if not report.converged:
        raise ConvergenceError(report.message)
    return body.displacements.numpy().astype(np.float64)


def spread(body: SoftBody, faces: npt.NDArray[np.int32], traction: npt.ArrayLike) -> None:
    """Load triangles of the surface, [n, 3] nodes, evenly: a traction [Pa], or a pressure on their inside."""
    x = body.mesh.points
    a, b, c = np.moveaxis(x[faces], 1, 0)
    areas = 0.5 * np.cross(b - a, c - a)
    vector = np.asarray(traction, float)
    forces = vector * (areas if vector.ndim == 0 else np.linalg.norm(areas, axis=1)[:, None])
    loads = np.zeros_like(x)
    np.add.at(loads, faces, np.repeat(forces[:, None] / 3.0, 3, axis=1))
    body.load(np.arange(len(x)), loads)


def faces_where(body: SoftBody, chosen: npt.NDArray[np.bool_]) -> npt.NDArray[np.int32]:
    """Triangles of the surface all of whose nodes are chosen, [n, 3]."""
    return body.surface_triangles[chosen[body.surface_triangles].all(axis=1)]


def mapped_grid(cells: tuple[int, int, int], place: Callable[[Array, Array, Array], list[Array]]) -> TetMesh:
    """A general mesh: a grid of the unit cube, six tetrahedra each, whose points are moved to places [m]. Points that
    come to the same place are one node."""
    grid = TetForest.box(cells, 1.0, 0)
    points = np.stack(place(*(grid.points / cells).T), axis=1)
    _, first, node = np.unique(np.round(points, 9), axis=0, return_index=True, return_inverse=True)
    return TetMesh(points[first], node.reshape(-1)[grid.tets])


@case("patch", "homogeneous deformation; stress by the law's formula")
def patch(setup: Setup) -> list[Row]:
    """A cube with an irregular mesh is stretched to 1.3 by its surface: nodes inside follow, and so does the force.

    Linear elasticity is stretched only; the others are turned, too.
    """
    forest, young, poisson, stretch = TetForest.box((2, 2, 2), 0.05, 3), 1e4, 0.3, 1.3
    x = forest.points.copy()
    inside = np.all((x > 1e-9) & (x < 0.1 - 1e-9), axis=1)
    x[inside] += np.random.default_rng(0).uniform(-4e-3, 4e-3, (int(inside.sum()), 3))
    mu, lam = 0.5 * young / (1.0 + poisson), young * poisson / (1.0 + poisson) / (1.0 - 2.0 * poisson)
    stresses = {
        Linear(): (2.0 * mu + lam) * (stretch - 1.0),
        Corotated(dilatation="element"): (2.0 * mu + lam) * (stretch - 1.0),
        StVenantKirchhoff(dilatation="element"): stretch * (mu + 0.5 * lam) * (stretch**2 - 1.0),
        NeoHookean(dilatation="element"): mu * (stretch - 1.0 / stretch) + lam * np.log(stretch) / stretch,
    }
    rows, off = [], 0.0
    for model, stress in stresses.items():
        c, s = (1.0, 0.0) if isinstance(model, Linear) else (np.cos(0.7), np.sin(0.7))
        gradient = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ np.diag([stretch, 1.0, 1.0])
        body = SoftBody(TetMesh(x, forest.tets), Isotropic(young, poisson, 1e3), device=setup.device)
        body.fix(~inside)
        moved = x @ gradient.T - x
        body.displacements = np.where(inside[:, None], 0.0, moved)
        off = max(off, float(np.abs(at_rest(body, model) - moved).max()))
        end = np.isclose(x[:, 0], 0.1)
        forces = Simulation(body, model=model, gravity=NONE).forces().numpy().astype(np.float64)[end].sum(axis=0)
        along = -forces @ gradient[:, 0] / stretch / 0.1**2
        rows.append(Row(f"stress, {type(model).__name__}", along, stress, 1e-4, "Pa"))
    return [Row("nodes inside, off their places", 1e3 * off, 0.0, 1e-5, "mm", scale=30.0), *rows]


@case("cantilever", "Reissner's beam theory (1972): a beam that stretches and shears")
def cantilever(setup: Setup) -> list[Row]:
    """A cantilever of 10 : 1 under a dead load across its end, P L^2 / (E I) = 2, bends by half of its length."""
    young, side = 1e6, 0.1
    load = 2.0 * young * side**4 / 12.0
    mesh = TetForest.box((1, 1, 10), side, 9 if setup.full else 6)
    body = SoftBody(mesh, Isotropic(young, 0.0, 1e3), device=setup.device)
    body.fix("z == zmin")
    end = np.isclose(mesh.points[:, 2], 10.0 * side)
    spread(body, faces_where(body, end), (load / side**2, 0.0, 0.0))
    moved = at_rest(body, StVenantKirchhoff(dilatation="element"))[end].mean(axis=0)
    setup.shown = [body], []
    return [Row("deflection of the end", moved[0], REISSNER, 0.025 if setup.full else 0.1, "m")]


@case("torsion", "Saint-Venant: J = 0.14058 side^4")
def torsion(setup: Setup) -> list[Row]:
    """The torque of a square bar, 1 : 4, twisted by its ends, against the twist in its middle."""
    side, angle, young, poisson = 0.064, 0.02, 1e5, 0.3
    mesh = TetForest.box((1, 1, 4), side, 12 if setup.full else 9, origin=(-0.5 * side, -0.5 * side, 0.0))
    body = SoftBody(mesh, Isotropic(young, poisson, 1e3), device=setup.device)
    body.fix("z == zmin or z == zmax")
    x = mesh.points
    end = np.isclose(x[:, 2], 4.0 * side)
    body.displacements = np.where(end[:, None], angle * np.stack([-x[:, 1], x[:, 0], 0.0 * x[:, 0]], axis=1), 0.0)
    u = at_rest(body, Linear())
    forces = -Simulation(body, model=Linear(), gravity=NONE).forces().numpy().astype(np.float64)
    torque = np.sum(x[end, 0] * forces[end, 1] - x[end, 1] * forces[end, 0])

    def twist(height: float) -> float:
        of = np.isclose(x[:, 2], height) & (np.hypot(x[:, 0], x[:, 1]) > 1e-9)
        return float(np.mean((x[of, 0] * u[of, 1] - x[of, 1] * u[of, 0]) / (x[of, 0] ** 2 + x[of, 1] ** 2)))

    rate = (twist(3.0 * side) - twist(side)) / (2.0 * side)
    long = 0.5 * young / (1.0 + poisson) * 0.1405770 * side**4 * rate
    return [Row("torque", 1e3 * torque, 1e3 * long, 0.03 if setup.full else 0.1, "N mm")]


@case("pipe", "Lamé")
def pipe(setup: Setup) -> list[Row]:
    """A pipe with free ends, radii 1 : 2, under pressure inside, held nowhere; also nearly incompressible."""
    inner, outer, height, pressure, young = 0.05, 0.1, 0.02, 100.0, 1e5
    layers = 8 if setup.full else 4

    def place(r: Array, t: Array, z: Array) -> list[Array]:
        r = inner + (outer - inner) * r
        return [r * np.cos(2.0 * np.pi * t), r * np.sin(2.0 * np.pi * t), height * z]

    mesh = mapped_grid((layers, 12 * layers, layers // 2), place)
    rows = []
    for poisson in (0.3, 0.4999):
        body = SoftBody(mesh, Isotropic(young, poisson, 1e3), device=setup.device)
        wall = np.hypot(mesh.points[:, 0], mesh.points[:, 1]) < 1.001 * inner
        spread(body, faces_where(body, wall), -pressure)
        u = at_rest(body, Linear())
        grown = float(np.mean(np.sum(mesh.points[wall, :2] * u[wall, :2], axis=1))) / inner
        square = inner**2 / (outer**2 - inner**2)
        exact = pressure * square / young * ((1.0 - poisson) * inner + (1.0 + poisson) * outer**2 / inner)
        bound = 0.01 if setup.full else 0.03
        rows.append(Row(f"growth of the inner radius, nu = {poisson:g}", 1e6 * grown, 1e6 * exact, bound, "um"))
    return rows


@case("cook", "scikit-fem, quadratic tetrahedra, 45,387 unknowns")
def cook(setup: Setup) -> list[Row]:
    """Cook's membrane, 48 x 44 to 16 x 10 mm, clamped on the left and sheared on the right, E = 100 kPa, 1 N."""
    n = 24 if setup.full else 12
    mesh = mapped_grid((n, n, n // 4), lambda x, y, z: [0.048 * x, 0.044 * x + y * (0.044 - 0.028 * x), 0.010 * z])
    rows = []
    for poisson, reference in COOK.items():
        body = SoftBody(mesh, Isotropic(1e5, poisson, 1e3), device=setup.device)
        x = mesh.points
        body.fix(np.isclose(x[:, 0], 0.0))
        spread(body, faces_where(body, np.isclose(x[:, 0], 0.048)), (0.0, 1.0 / (0.016 * 0.010), 0.0))
        corner = np.argmin(np.linalg.norm(x - (0.048, 0.060, 0.005), axis=1))
        found = 1e3 * at_rest(body, Linear(dilatation="shared"))[corner, 1]
        setup.shown = [body], []
        rows.append(Row(f"upper corner, nu = {poisson:g}", found, reference, 0.08 if setup.full else 0.15, "mm"))
    return rows


#: Deflection of the end of the cantilever [m], by Reissner's beam that stretches and shears, to four digits.
REISSNER = 0.49642
#: Displacement of the upper corner of Cook's membrane [mm] by Poisson's ratio.
COOK = {0.3: 24.889, 0.4999: 24.478}
