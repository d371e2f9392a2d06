"""Meshes made from domains: conforming, well shaped, and fine only where a criterion requires it."""

import numpy as np
import oracle
import pytest
from bodies import Body, ball, ring, united
from meshes import SHAPES, as_trimesh, assert_conforming, assert_well_shaped, held

import warp_corot as wc


@pytest.mark.parametrize("error", [None, 5e-3])
@pytest.mark.parametrize("shape", SHAPES)
def test_every_mesh_is_conforming_and_well_shaped(shape, error, device):
    body = SHAPES[shape][0]()
    forest = wc.TetForest.from_domain(body, 0.3, max_level=11, surface_error=error, min_level=2, device=device)
    assert_conforming(forest)
    assert_well_shaped(forest)
    assert forest.levels.max() <= 11
    assert forest.levels.min() >= 2
    assert np.allclose(forest.volumes, oracle.Mesh(forest.points, forest.tets).volumes, rtol=1e-9)
    assert forest.tets.max() == len(forest.points) - 1
    assert forest.node_ends.shape == (len(forest.lattice), 2)
    inner = forest.node_ends[:, 0] >= 0
    assert np.array_equal(2 * forest.lattice[inner], forest.lattice[forest.node_ends[inner]].sum(axis=1))


def test_counts_on_a_ball_fall_against_uniform_ones():
    """Surface elements scale with 1/h^2, all elements with 1/h^3: the ratio halves every three levels."""
    count = {level: len(wc.TetForest.from_domain(ball(), 1.0, max_level=level).tets) for level in (12, 15, 18)}
    ratio = {level: n / (6 * 2**level * 4 / 3 * np.pi * 0.064) for level, n in count.items()}
    assert ratio[15] < 0.6
    assert 0.4 < ratio[15] / ratio[12] < 0.65
    assert 0.4 < ratio[18] / ratio[15] < 0.6


def test_fine_local_features_need_a_tenth():
    """A ball with a needle: the error requires the finest level only at the needle."""
    body = united(ball(0.4), ball(0.012, (0.41, 0, 0)))
    forest = wc.TetForest.from_domain(body, 1.0, max_level=18, surface_error=1e-3)
    assert forest.levels.max() == 18
    volume = 4 / 3 * np.pi * 0.064
    assert len(forest.tets) < 0.1 * 6 * 2**18 * volume


def test_each_point_is_evaluated_once():
    """Except in the last evaluation of a few elements, whose midpoint may be another element's node."""
    body = ball()
    forest = wc.TetForest.from_domain(body, 1.0, max_level=15, surface_error=1e-3)
    asked = np.concatenate(body.asked)
    assert len(asked) > len(forest.points)
    assert len(np.unique(asked, axis=0)) > 0.99 * len(asked)


def test_refining_where_a_function_asks_for_it(device):
    def near(x):
        return np.linalg.norm(x - [0.1, 0, 0], axis=1) < 0.08

    plain = wc.TetForest.from_domain(ball(), 0.5, max_level=12, surface_error=2e-2)
    forest = wc.TetForest.from_domain(ball(), 0.5, max_level=12, surface_error=2e-2, refine_where=near, device=device)
    middle = forest.points[forest.tets].mean(axis=1)
    assert (forest.levels[near(middle)] == 12).all()
    assert near(middle).sum() > 100
    assert forest.levels[np.linalg.norm(middle - [0.1, 0, 0], axis=1) > 0.3].max() <= plain.levels.max() + 2
    assert_conforming(forest)


def test_refining_where_a_field_varies(device):
    def stiffness(x):
        return np.where(x[:, 2] > 0.013, 3.0, 1.0)

    forest = wc.TetForest.from_domain(ball(), 0.5, max_level=9, surface_error=5e-2, field=stiffness, device=device)
    values = stiffness(forest.points)[forest.tets]
    assert (forest.levels[np.ptp(values, axis=1) > 0] == 9).all()
    smooth = wc.TetForest.from_domain(
        ball(), 0.5, max_level=9, surface_error=5e-2, field=lambda x: x[:, 2], field_tolerance=0.1
    )
    coarse = np.ptp(smooth.points[smooth.tets][..., 2], axis=1) > 0.1
    assert not coarse[smooth.levels < 9].any()


@pytest.mark.parametrize("target", [500, 3000, 20000])
def test_a_number_of_elements_can_be_given(target):
    forest = wc.TetForest.from_domain(ball(), 0.5, max_level=24, target_elements=target)
    assert 0.5 * target < len(forest.tets) <= target


@pytest.mark.parametrize(("scale", "shift"), [(1e-3, 0.0), (1e3, 0.0), (1.0, 30.0)])
def test_size_and_place_do_not_matter(scale, shift):
    """The same ring in millimetres, in kilometres and far from the origin: equal numbers of elements within 1 %,
    where float32 coordinates decide differently."""
    body, other = ring(), ring()
    other.function = lambda x: scale * body.function((x - shift) / scale)
    other.bounds = scale * body.bounds + shift
    one = wc.TetForest.from_domain(body, 0.3, max_level=12, surface_error=4e-3)
    two = wc.TetForest.from_domain(other, 0.3 * scale, max_level=12, surface_error=4e-3 * scale)
    assert len(two.tets) == pytest.approx(len(one.tets), rel=0.01)
    assert held(two) == pytest.approx(held(one) * scale**3, rel=1e-3)
    assert as_trimesh(two.surface()).is_watertight


@pytest.mark.slow
def test_a_million():
    forest = wc.TetForest.from_domain(ball(), 1.0, max_level=23)
    assert len(forest.tets) > 1_000_000
    assert_conforming(forest)
    surface = forest.surface()
    assert held(forest) == pytest.approx(surface.volume, rel=1e-10)
    assert surface.volume == pytest.approx(4 / 3 * np.pi * 0.064, rel=1e-3)
    assert as_trimesh(surface).is_watertight


def test_the_same_mesh_comes_out_twice(device):
    """Even though threads race for the numbers of new nodes."""
    one, two = (
        wc.TetForest.from_domain(ring(), 0.3, max_level=12, surface_error=2e-3, device=device) for _ in range(2)
    )
    assert np.array_equal(one.lattice, two.lattice)
    assert np.array_equal(one.tets, two.tets)
    assert np.array_equal(one.fill, two.fill)
    assert np.array_equal(one.node_ends, two.node_ends)
    assert np.array_equal(one.phi, two.phi)


def test_an_empty_body_is_refused():
    with pytest.raises(wc.InputError, match="empty"):
        wc.TetForest.from_domain(Body(lambda x: np.ones(len(x)), [[0, 0, 0], [1, 1, 1]]), 0.5, max_level=6)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({"cell_size": 0.0}, "cell_size"),
        ({"cell_size": np.nan}, "cell_size"),
        ({"cell_size": 1e-6}, "cell_size.*root cubes"),
        ({"max_level": 49}, "max_level"),
        ({"max_level": 2.5}, "max_level"),
        ({"max_level": np.nan}, "max_level is nan"),
        ({"min_level": "three"}, "min_level is 'three'"),
        ({"min_level": 5, "max_level": 4}, "min_level"),
        ({"surface_error": 0.0}, "surface_error"),
        ({"surface_error": np.inf}, "surface_error"),
        ({"sliver": 1.0}, "sliver"),
        ({"target_elements": 0}, "target_elements"),
        ({"target_elements": 3, "max_level": 9}, "target_elements"),
        ({"field_tolerance": -1.0}, "field_tolerance"),
        ({"field": lambda x: np.full(len(x), np.nan), "max_level": 4}, "finite"),
        ({"refine_where": lambda x: True, "max_level": 4}, "shape"),
    ],
)
def test_bad_arguments(arguments, named):
    with pytest.raises(wc.InputError, match=named):
        wc.TetForest.from_domain(ball(), **{"cell_size": 0.5, "surface_error": 0.1} | arguments)
