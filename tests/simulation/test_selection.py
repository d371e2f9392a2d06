"""Nodes chosen by expressions: equal to NumPy's own answer, and only arithmetic is ever evaluated."""

import warnings

import numpy as np
import pytest

import warp_corot as wc
from warp_corot.inputs.selection import select_nodes

POINTS = np.random.default_rng(1).uniform(-1.0, 1.0, (200, 3))
px, py, pz = POINTS.T


@pytest.mark.parametrize(
    ("expression", "expected"),
    [
        ("z < 0.01", pz < 0.01),
        ("x > 0.1 and not (y < 0.2)", (px > 0.1) & ~(py < 0.2)),
        ("0 <= z <= 0.5", (pz >= 0) & (pz <= 0.5)),
        ("x < 0 or y < 0 and z < 0", (px < 0) | ((py < 0) & (pz < 0))),
        ("(x > 0) & ~(y > 0) | (z > 0.5)", ((px > 0) & ~(py > 0)) | (pz > 0.5)),
        ("hypot(x, y, z) <= 1", np.linalg.norm(POINTS, axis=1) <= 1),
        ("max(abs(x), abs(y), 0.2) < 0.5", np.maximum(np.maximum(abs(px), abs(py)), 0.2) < 0.5),
        ("min(x, y) > sqrt(0.04) - 2**-3", np.minimum(px, py) > 0.075),
        ("atan2(y, x) > pi / 4", np.arctan2(py, px) > np.pi / 4),
        ("-x % 0.5 < 0.2", np.mod(-px, 0.5) < 0.2),
        ("x == xmax or z != zmin and y < ymin + 0.3", (px == px.max()) | ((pz != pz.min()) & (py < py.min() + 0.3))),
        ("all", np.ones(200, bool)),
        ("none", np.zeros(200, bool)),
        ("1 < 2", np.ones(200, bool)),
        ("  z<0  ", pz < 0),
    ],
)
def test_same_as_numpy(expression, expected):
    mask = select_nodes(expression, POINTS)
    assert mask.dtype == np.bool_
    assert mask.shape == (200,)
    np.testing.assert_array_equal(mask, expected)


def test_and_guards_against_division_by_zero():
    points = np.array([[1.0, 0.0, 0.0], [1.0, 2.0, 0.0], [3.0, 2.0, 0.0]])
    np.testing.assert_array_equal(select_nodes("y > 0 and x / y < 1", points), [False, True, False])
    np.testing.assert_array_equal(select_nodes("y == 0 or x / y < 1", points), [True, True, False])


def test_given_bounds_are_used():
    np.testing.assert_array_equal(select_nodes("z < zmin", POINTS, bounds=np.zeros((2, 3))), pz < 0)


@pytest.mark.parametrize(
    ("expression", "said"),
    [
        ("", "empty"),
        ("   ", "empty"),
        ("z <", "invalid syntax"),
        ("z = 0", "=="),
        ("(z < 1", "was never closed"),
        ("z", "the result is a number"),
        ("z + 1", "the result is a number"),
        ("w < 1", "'w' is not known"),
        ("foo(z) < 1", "'foo' is not a function"),
        ("sqrt(x, y) < 1", "takes 1 arguments, not 2"),
        ("hypot(x) < 1", "takes 2 or more"),
        ("x / (y - y) < 1", "division by zero) at 200 of 200"),
        ("1 / 0 < z", "division by zero"),
        ("sqrt(x) < 1", "not a finite number"),
        ("9 ** 9 ** 9 < z", "not a finite number"),
        ("1" * 400 + " < z", "too large"),
        ("x > 0 & y > 0", "parentheses"),
        ("not x", "a number where true or false"),
        ("x and y < 1", "a number where true or false"),
        ("(x < 1) + 1 < 2", "true or false where a number"),
        ("x in (1, 2)", "not understood"),
        ("x is y", "not understood"),
        ("'a' < z", "not understood"),
        ("1j < z", "not understood"),
        ("[z < 1][0]", "not understood"),
        ("(lambda: z < 1)()", "not understood"),
        ("x.real < 1", "not understood"),
        ("x[0] < 1", "not understood"),
        ("z < 1 if x < 1 else z > 1", "not understood"),
        ("(q := z) < 1", "not understood"),
        ("__import__('os').system('true') < 1", "not understood"),
        ("abs(z, key=1) < 1", "not understood"),
        ("abs(*z) < 1", "not understood"),
        ("abs < 1", "'abs' is not known"),
        ("z < 1; z", "invalid syntax"),
        ("z < 1\x00", "printable"),
        ("-" * 999 + "z", ""),
        ("(" * 500 + "z" + ")" * 499, ""),
        ("z < 1 and " * 200 + "z < 1", "at most 1000"),
    ],
)
def test_other_expressions_are_refused_in_one_line(expression, said):
    with pytest.raises(wc.InputError, match="expression ") as caught:
        select_nodes(expression, POINTS)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_nothing_runs(tmp_path):
    file = tmp_path / "made"
    for attempt in (f"open('{file}', 'w')", f"[c for c in ().__class__.__base__.__subclasses__()] or open('{file}')"):
        with pytest.raises(wc.InputError):
            select_nodes(attempt, POINTS)
    assert not file.exists()


def test_an_expression_that_holds_nowhere_warns():
    """Most often, coordinates were taken for millimetres."""
    body = wc.SoftBody(wc.TetForest.box((1, 1, 2), 0.1, 0), wc.Isotropic(1e4, 0.4, 1e3), device="cpu")
    with pytest.warns(UserWarning, match="no node is where .z > 150.; the body lies between .0, 0, 0. and"):
        body.fix("z > 150")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        body.fix("none")
        body.fix("z > 0.15")
        body.fix(lambda x: x[:, 2] > 150)
