"""Static answers of linear elasticity against Saint-Venant's torsion and Lamé's pipe: the errors fall by the second
order."""

import numpy as np
import pytest

import warp_corot as wc

YOUNG, POISSON = 1e5, 0.3


def torque_over_that_of_a_long_bar(level: int) -> float:
    """The torque of a square bar, 1 : 4, twisted by its ends, over G J times the rate of twist in the middle."""
    side, angle, shear = 0.064, 0.02, YOUNG / (2.0 * (1.0 + POISSON))
    mesh = wc.TetForest.box((1, 1, 4), side, level, origin=(-0.5 * side, -0.5 * side, 0.0))
    body = wc.SoftBody(mesh, wc.Isotropic(YOUNG, POISSON, 1e3), device="cpu")
    body.fix("z == zmin or z == zmax")
    x = mesh.points
    end = np.isclose(x[:, 2], 4 * side)
    turned = np.zeros_like(x)
    turned[end, :2] = angle * np.column_stack([-x[end, 1], x[end, 0]])
    body.displacements = turned
    assert wc.solve_static(body, model=wc.Linear(), gravity=(0.0, 0.0, 0.0)).converged
    u = body.displacements.numpy().astype(float)
    forces = -wc.Simulation(body, model=wc.Linear(), gravity=(0.0, 0.0, 0.0)).forces().numpy().astype(float)
    torque = np.sum(x[end, 0] * forces[end, 1] - x[end, 1] * forces[end, 0])

    def twist(height: float) -> float:
        of = np.isclose(x[:, 2], height) & (np.hypot(x[:, 0], x[:, 1]) > 1e-9)
        return float(np.mean((x[of, 0] * u[of, 1] - x[of, 1] * u[of, 0]) / (x[of, 0] ** 2 + x[of, 1] ** 2)))

    rate = (twist(3 * side) - twist(side)) / (2 * side)
    return torque / (shear * 0.1405770 * side**4 * rate)


def growth_over_that_of_a_pipe(layers: int) -> float:
    """The growth of the inner radius of a pipe with free ends, radii 1 : 2, pressed from inside and held nowhere, over
    Lamé's solution, with this number of layers in a general mesh."""
    inner, outer, height, pressure = 0.05, 0.1, 0.02, 100.0
    around, along = 12 * layers, max(layers // 2, 1)
    turn = np.arange(around) * 2.0 * np.pi / around
    radii, heights = np.linspace(inner, outer, layers + 1), np.linspace(0.0, height, along + 1)
    z, r, t = (grid.ravel() for grid in np.meshgrid(heights, radii, turn, indexing="ij"))
    points = np.column_stack([r * np.cos(t), r * np.sin(t), z])
    k, i, j = (grid.ravel() for grid in np.indices((along, layers, around)))
    corners = np.stack(
        [
            ((k + up) * (layers + 1) + i + out) * around + (j + on) % around
            for up in (0, 1)
            for on in (0, 1)
            for out in (0, 1)
        ]
    )
    ways = [(0, 1, 3, 7), (0, 3, 2, 7), (0, 2, 6, 7), (0, 6, 4, 7), (0, 4, 5, 7), (0, 5, 1, 7)]
    mesh = wc.TetMesh(points, np.concatenate([corners[list(way)].T for way in ways]))
    body = wc.SoftBody(mesh, wc.Isotropic(YOUNG, POISSON, 1e3), device="cpu")
    wall = body.surface_triangles[(np.hypot(*points[body.surface_triangles, :2].T) < 1.001 * inner).T.all(axis=1)]
    edges = points[wall[:, 1:]] - points[wall[:, :1]]
    areas = 0.5 * np.cross(edges[:, 0], edges[:, 1])
    outwards = np.sign(np.sum(areas * points[wall].mean(axis=1), axis=1, where=[True, True, False]))
    forces = np.zeros_like(points)
    np.add.at(forces, wall, (pressure / 3.0 * outwards[:, None] * areas)[:, None])
    body.load(np.arange(len(points)), forces)
    assert wc.solve_static(body, model=wc.Linear(), gravity=(0.0, 0.0, 0.0)).converged
    at = np.isclose(r, inner)
    found = np.mean(np.sum(points[at, :2] * body.displacements.numpy()[at, :2], axis=1)) / inner
    square = inner**2 / (outer**2 - inner**2)
    return found / (pressure * square / YOUNG * ((1 - POISSON) * inner + (1 + POISSON) * outer**2 / inner))


@pytest.mark.parametrize(
    ("measure", "sizes", "least"),
    [
        (torque_over_that_of_a_long_bar, (3, 6), 3.5),
        (growth_over_that_of_a_pipe, (2, 4), 3.0),
        pytest.param(torque_over_that_of_a_long_bar, (6, 9), 3.5, marks=pytest.mark.slow),
        pytest.param(growth_over_that_of_a_pipe, (4, 8), 3.3, marks=pytest.mark.slow),
    ],
)
def test_halving_elements_divides_the_error(measure, sizes, least):
    coarse, fine = (abs(measure(size) - 1.0) for size in sizes)
    print(f"{measure.__name__}: off by {coarse:.4f} and {fine:.4f}")
    assert coarse > least * fine
