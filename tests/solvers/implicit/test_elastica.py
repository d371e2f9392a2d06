"""A cantilever bent by half of its length, against a beam that stretches and shears (Reissner 1972)."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import warp_corot as wc

YOUNG, SIDE, LENGTH = 1e6, 0.1, 1.0
INERTIA, AREA = SIDE**4 / 12, SIDE**2
LOAD = 2.0 * YOUNG * INERTIA / LENGTH**2


def reissner():
    """Displacements of the end along and across the beam [m] under a dead load across, Poisson's ratio zero."""

    def bent(moment):
        def rates(_, state):
            along = np.array([np.cos(state[0]), np.sin(state[0])])
            across = np.array([-along[1], along[0]])
            stretch = 1.0 + LOAD * along[1] / (YOUNG * AREA)
            r = stretch * along + LOAD * across[1] / (5 / 6 * YOUNG / 2 * AREA) * across
            return [state[1] / (YOUNG * INERTIA), -r[0] * LOAD, *r]

        return solve_ivp(rates, (0, LENGTH), [0, moment, 0, 0], rtol=1e-9, atol=1e-12).y[:, -1]

    end = bent(brentq(lambda moment: bent(moment)[1], 0, 2 * LOAD * LENGTH))
    return end[2] - LENGTH, end[3]


def error(level, device):
    """Relative errors of the end's displacement across and along the beam: how much too little it moves."""
    mesh = wc.TetForest.box((1, 1, 10), SIDE, level)
    body = wc.SoftBody(mesh, wc.Isotropic(YOUNG, 0.0, 1000.0), device=device)
    body.fix("z == zmin")
    end = np.isclose(mesh.points[:, 2], LENGTH)
    faces = np.sort(mesh.tets[:, [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]].reshape(-1, 3), axis=1)
    own = faces[end[faces].all(1)]
    a, b, c = (mesh.points[own[:, k]] for k in range(3))
    areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    loads = np.zeros_like(mesh.points)
    np.add.at(loads[:, 0], own, np.repeat(areas[:, None] / 3, 3, 1) * LOAD / areas.sum())
    body.load(np.arange(len(loads)), loads)
    assert wc.solve_static(body, model=wc.StVenantKirchhoff(dilatation="element"), gravity=(0, 0, 0)).converged
    along, across = reissner()
    moved = body.displacements.numpy()[end].mean(0)
    errors = 1 - moved[0] / across, 1 - moved[2] / along
    print(f"level {level}: {errors[0]:.2%} across, {errors[1]:.2%} along")
    return errors[0]


def test_the_end_comes_nearer_as_elements_get_smaller(device):
    """Halving elements takes errors to 0.31 of what they were, at these sizes."""
    coarse, fine = error(3, device), error(6, device)
    assert 0 < fine < 0.11
    assert coarse / fine > 3.0


@pytest.mark.slow
def test_it_converges_with_second_order(device):
    coarse, fine = error(6, device), error(9, device)
    assert 0 < fine < 0.03
    assert np.log2(coarse / fine) > 1.9
