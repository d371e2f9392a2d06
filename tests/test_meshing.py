"""Forests of domains: the surface they follow, what they leave out, and what a cut element counts for."""

import itertools

import numpy as np
import oracle
import pytest
import trimesh
import warp as wp
from bodies import Body, ball, ring, turned_box, united, without
from scipy.spatial import ConvexHull, cKDTree
from scipy.spatial.transform import Rotation
from warp_corot.kernels.embedding import nearest_faces

import warp_corot as wc
from warp_corot.mesh.cut import inside_shares, label_shares, merged

PAIRS = list(itertools.combinations(range(4), 2))
TURN = Rotation.from_rotvec([0.3, 0.5, 0.7]).as_matrix()
HALF = (0.3, 0.2, 0.15)
LEVELS = (9, 12, 15)


def assert_conforming(forest):
    """No face is shared by more than two leaves, and no node lies in the middle of an edge."""
    faces = np.concatenate([forest.tets[:, list(face)] for face in itertools.combinations(range(4), 3)])
    _, count = np.unique(np.sort(faces, axis=1), axis=0, return_counts=True)
    assert count.max() <= 2
    edges = np.unique(np.sort(np.concatenate([forest.tets[:, pair] for pair in PAIRS]), axis=1), axis=0)
    doubled = {tuple(p) for p in 2 * forest.lattice[: len(forest.points)]}
    assert doubled.isdisjoint(map(tuple, forest.lattice[edges].sum(axis=1)))


def assert_well_shaped(forest):
    """Aspect ratio 3 r_in / R is at least 0.64, R over the shortest edge at most sqrt(5)/2, and no element is flat."""
    x = forest.points[forest.tets]
    edges = x[:, 1:] - x[:, :1]
    centre = np.linalg.solve(2 * edges, (edges**2).sum(2)[..., None])[..., 0]
    radius = np.linalg.norm(centre, axis=1)
    area = sum(
        np.linalg.norm(np.cross(x[:, j] - x[:, i], x[:, k] - x[:, i]), axis=1) / 2
        for i, j, k in itertools.combinations(range(4), 3)
    )
    assert (3 * 3 * forest.volumes / area / radius).min() > 0.64 - 0.005
    shortest = np.min([np.linalg.norm(x[:, i] - x[:, j], axis=1) for i, j in PAIRS], axis=0)
    assert (radius / shortest).max() < np.sqrt(5) / 2 + 1e-9


def as_trimesh(surface):
    return trimesh.Trimesh(surface.points, surface.triangles, process=False)


def held(forest):
    return float((forest.fill * forest.volumes).sum())


def farthest(surface, points, near=16):
    """The largest distance of points from a surface, by trimesh's formula: of each from the triangle that Warp finds,
    which in float32 may be the one beside the nearest, and from those whose middles are nearest; so none is too small.
    """
    corners = surface.points[surface.triangles]
    mesh = wp.Mesh(
        wp.array(surface.points, dtype=wp.vec3, device="cpu"),
        wp.array(surface.triangles.ravel(), dtype=wp.int32, device="cpu"),
    )
    found = wp.empty(len(points), dtype=wp.int32, device="cpu")
    given = wp.array(points, dtype=wp.vec3, device="cpu")
    wp.launch(nearest_faces, len(points), [given, mesh.id, 1e15], [found], device="cpu")
    _, faces = cKDTree(corners.mean(axis=1)).query(points, k=near)
    faces = np.column_stack([faces, found.numpy()])
    closest = trimesh.triangles.closest_point(corners[faces.ravel()], np.repeat(points, near + 1, axis=0))
    distance = np.linalg.norm(closest.reshape(*faces.shape, 3) - points[:, None], axis=2)
    return distance.min(axis=1).max()


def off_surface(body, surface):
    """The largest distance of a surface from the body's, at its points and in its triangles."""
    rng = np.random.default_rng(4)
    x = surface.points[surface.triangles]
    inner = np.einsum("sfk,fkc->sfc", rng.dirichlet(np.ones(3), (3, len(x))), x).reshape(-1, 3)
    return np.abs(body.function(np.concatenate([surface.points, inner]))).max()


def on_ball(n=20000, radius=0.4):
    x = np.random.default_rng(5).standard_normal((n, 3))
    return radius * x / np.linalg.norm(x, axis=1, keepdims=True)


def on_ring(n=20000, major=0.35, minor=0.12):
    a, b = np.random.default_rng(5).uniform(0, 2 * np.pi, (2, n))
    out = major + minor * np.cos(b)
    return np.stack([out * np.cos(a), out * np.sin(a), minor * np.sin(b)], axis=1)


def on_box(n=300):
    """Faces, edges and corners of the turned box."""
    solid = trimesh.creation.box(2 * np.array(HALF))
    faces = trimesh.sample.sample_surface(solid, 20000, seed=5)[0]
    t = np.linspace(-1, 1, n)
    edges = []
    for axis in range(3):
        for signs in itertools.product((-1.0, 1.0), repeat=2):
            x = np.insert(np.tile(signs, (n, 1)), axis, t, axis=1)
            edges.append(x * HALF)
    return np.concatenate([faces, *edges]) @ TURN.T


BALL = (ball, 4 / 3 * np.pi * 0.4**3, 4 * np.pi * 0.4**2, on_ball, 2)
RING = (ring, 2 * np.pi**2 * 0.35 * 0.12**2, 4 * np.pi**2 * 0.35 * 0.12, on_ring, 0)
BOX = (
    lambda: turned_box(HALF, TURN),
    8 * np.prod(HALF),
    8 * (HALF[0] * HALF[1] + HALF[1] * HALF[2] + HALF[2] * HALF[0]),
    on_box,
    2,
)
SHAPES = {"ball": BALL, "ring": RING, "box": BOX}


# --- the surface -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", SHAPES)
def test_surface_converges(shape):
    """Volume, area and Hausdorff distance of smooth bodies go with the edge length squared; a box loses its edges,
    which are cut by a share of the edge length: area and distance go with its first power."""
    make, volume, area, sample, _ = SHAPES[shape]
    errors = []
    for level in LEVELS:
        body = make()
        surface = wc.TetForest.from_domain(body, 0.5, max_level=level).surface()
        hausdorff = max(off_surface(body, surface), farthest(surface, sample()))
        errors.append([abs(surface.volume / volume - 1), abs(surface.area / area - 1), hausdorff])
    orders = np.log2(np.array(errors[0]) / errors[-1]) / (len(LEVELS) - 1)
    expected = [2, 1, 1] if shape == "box" else [2, 2, 2]
    assert (orders > 0.8 * np.array(expected)).all(), orders
    assert errors[-1][0] < 0.02


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("error", [None, 4e-3])
def test_surface_is_closed_and_has_the_right_topology(shape, error):
    make, _, _, _, euler = SHAPES[shape]
    surface = wc.TetForest.from_domain(make(), 0.3, max_level=10, surface_error=error).surface()
    solid = as_trimesh(surface)
    assert solid.is_watertight
    assert solid.is_winding_consistent
    assert solid.euler_number == surface.euler_characteristic == euler
    assert solid.volume == pytest.approx(surface.volume, rel=1e-9)
    assert surface.volume > 0
    assert solid.area == pytest.approx(surface.area, rel=1e-9)


def test_surface_of_bodies_with_cavities_and_pieces():
    shell = without(ball(0.4), ball(0.25))
    pair = united(ball(0.2, (-0.3, 0, 0)), ball(0.1, (0.3, 0.1, 0)))
    for body, volume in ((shell, 4 / 3 * np.pi * (0.4**3 - 0.25**3)), (pair, 4 / 3 * np.pi * (0.2**3 + 0.1**3))):
        forest = wc.TetForest.from_domain(body, 0.25, max_level=9)
        surface = forest.surface()
        assert as_trimesh(surface).is_watertight
        assert surface.euler_characteristic == 4
        assert surface.volume == pytest.approx(volume, rel=0.05)
    assert any("2 separate pieces" in line for line in forest.summary())


@pytest.mark.parametrize("shape", ["ball", "ring"])
@pytest.mark.parametrize("error", [1e-2, 3e-3, 1e-3])
def test_surface_error_is_kept_by_smooth_bodies(shape, error):
    make, _, _, sample, _ = SHAPES[shape]
    body = make()
    surface = wc.TetForest.from_domain(body, 0.5, max_level=30, surface_error=error).surface()
    assert max(off_surface(body, surface), farthest(surface, sample())) < error


@pytest.mark.parametrize("error", [2e-2, 5e-3])
def test_surface_error_at_creases(error):
    """Also sharp edges and corners, which samples do not hit, are kept."""
    body = turned_box(HALF, TURN)
    surface = wc.TetForest.from_domain(body, 0.3, max_level=30, surface_error=error).surface()
    assert off_surface(body, surface) < error
    assert farthest(surface, on_box()) < error


def test_a_function_that_is_no_distance():
    """x^2/a + y^2/b + z^2/c - 1 changes by 1/0.1 to 2/0.2 per metre: the error is in metres all the same."""
    axes = np.array([0.4, 0.3, 0.2])
    body = Body(lambda x: ((x / axes) ** 2).sum(axis=1) - 1, [-axes, axes], lipschitz=2 / 0.2 * np.sqrt(3) * 1.5)
    surface = wc.TetForest.from_domain(body, 0.25, max_level=24, surface_error=2e-3).surface()
    assert as_trimesh(surface).is_watertight
    assert surface.volume == pytest.approx(4 / 3 * np.pi * axes.prod(), rel=0.02)
    assert farthest(surface, on_ball(radius=1.0) * axes) < 2e-3


@pytest.mark.parametrize("seed", range(12))
def test_a_small_ball_in_one_root_cube_is_found(seed):
    rng = np.random.default_rng(seed)
    radius = 10 ** rng.uniform(-2.5, -0.7)
    centre = rng.uniform(radius, 1 - radius, 3)
    body = ball(radius, centre)
    body.bounds = np.array([[0.0] * 3, [1.0] * 3])
    surface = wc.TetForest.from_domain(body, 1.0, max_level=30, surface_error=0.05 * radius).surface()
    assert surface.euler_characteristic == 2
    assert surface.volume == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.2)


def test_a_body_on_the_lattice_is_exact():
    """A box whose faces are faces of cubes: no cut elements, no flat triangles, nothing outside."""
    half = np.array([0.5, 0.25, 0.25])
    body = turned_box(half, np.eye(3))
    forest = wc.TetForest.from_domain(body, 0.25, max_level=9, surface_error=1e-3)
    assert (forest.fill == 1).all()
    assert len(forest.points) == len(forest.lattice)
    surface = forest.surface()
    solid = as_trimesh(surface)
    assert solid.is_watertight
    assert surface.volume == pytest.approx(8 * half.prod(), rel=1e-12)
    assert surface.area == pytest.approx(2.5, rel=1e-12)
    assert solid.area_faces.min() > 1e-3


@pytest.mark.parametrize("seed", range(4))
def test_marching_any_values(seed):
    """Random values: closed around what is inside. Many of them zero: no flat triangles, none twice, and every edge
    is gone along as often one way as the other."""
    from warp_corot.mesh.marching import marched

    rng = np.random.default_rng(seed)
    box = wc.TetForest.box((3, 3, 3), 1.0, 4)
    rim = ((box.points == 0) | (box.points == 3)).any(axis=1)
    values = rng.standard_normal(len(box.points))
    values[rim] = np.abs(values[rim])
    surface = marched(box.points, box.tets, values)
    assert as_trimesh(surface).is_watertight
    assert as_trimesh(surface).is_winding_consistent
    assert surface.volume == pytest.approx((inside_shares(values[box.tets]) * box.volumes).sum(), rel=1e-12)
    whole = np.round(values)
    assert (whole == 0).sum() > 20
    surface = marched(box.points, box.tets, whole)
    assert surface.volume == pytest.approx((inside_shares(whole[box.tets]) * box.volumes).sum(), rel=1e-12)
    assert as_trimesh(surface).area_faces.min() > 1e-9
    assert len(np.unique(np.sort(surface.triangles, axis=1), axis=0)) == len(surface.triangles)
    assert len(np.unique(surface.points, axis=0)) == len(surface.points)
    edges = np.concatenate([surface.triangles[:, [i, j]] for i, j in ((0, 1), (1, 2), (2, 0))])
    assert np.array_equal(np.sort(edges @ [1e6, 1]), np.sort(edges @ [1, 1e6]))


# --- elements --------------------------------------------------------------------------------------------------------


def test_share_inside_is_the_volume_of_the_convex_hull():
    rng = np.random.default_rng(1)
    values = rng.standard_normal((200, 4))
    corner = np.vstack([np.zeros(3), np.eye(3)])
    for value, share in zip(values, inside_shares(values), strict=True):
        if (value >= 0).all():
            assert share == 0
            continue
        points = [corner[value < 0]]
        for i, j in PAIRS:
            if (value[i] < 0) != (value[j] < 0):
                points.append((corner[i] * value[j] - corner[j] * value[i])[None] / (value[j] - value[i]))
        assert share == pytest.approx(6 * ConvexHull(np.concatenate(points)).volume, rel=1e-9)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("sliver", [0.0, 0.02, 0.3])
def test_what_elements_hold_is_what_the_surface_encloses(shape, sliver):
    forest = wc.TetForest.from_domain(SHAPES[shape][0](), 0.3, max_level=9, surface_error=3e-3, sliver=sliver)
    surface = forest.surface()
    assert held(forest) == pytest.approx(surface.volume, rel=1e-11)
    assert forest.fill.min() > sliver * (1 - 1e-12)
    named = np.zeros(len(forest.points), bool)
    named[forest.tets] = True
    assert named.all()
    assert as_trimesh(surface).is_watertight
    assert surface.nodes.max() < len(forest.points)


def test_slivers_without_other_neighbours_go_to_the_fullest():
    box = wc.TetForest.box((1, 1, 1), 1.0, 3)
    rng = np.random.default_rng(2)
    volumes = rng.random(len(box.tets))
    after, gone = merged(box.tets, volumes, np.ones(len(volumes), bool))
    assert gone.sum() == len(volumes) - 1
    assert not gone[np.argmax(volumes)]
    assert after.sum() == pytest.approx(volumes.sum())
    small = rng.random(len(volumes)) < 0.4
    after, gone = merged(box.tets, volumes, small)
    assert np.array_equal(gone, small)
    assert after.sum() == pytest.approx(volumes.sum())
    assert (after[~gone] >= volumes[~gone]).all()
    # What a single one holds goes to the neighbour across a face that holds most.
    alone = np.arange(len(volumes)) == 17
    after, gone = merged(box.tets, volumes, alone)
    shared = (box.tets[:, :, None] == box.tets[17]).any(axis=2).sum(axis=1)
    taker = max(np.flatnonzero(shared == 3), key=lambda t: volumes[t])
    assert np.flatnonzero(after > volumes).tolist() == [taker]


@pytest.mark.parametrize("error", [None, 5e-3])
@pytest.mark.parametrize("shape", SHAPES)
def test_every_mesh_is_conforming_and_well_shaped(shape, error):
    forest = wc.TetForest.from_domain(SHAPES[shape][0](), 0.3, max_level=11, surface_error=error, min_level=2)
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
    """Surface elements go with 1/h^2, all of them with 1/h^3: the ratio halves every three levels."""
    count = {level: len(wc.TetForest.from_domain(ball(), 1.0, max_level=level).tets) for level in (12, 15, 18)}
    ratio = {level: n / (6 * 2**level * 4 / 3 * np.pi * 0.064) for level, n in count.items()}
    assert ratio[15] < 0.6
    assert 0.4 < ratio[15] / ratio[12] < 0.65
    assert 0.4 < ratio[18] / ratio[15] < 0.6


def test_fine_local_features_need_a_tenth():
    """A ball with a needle: the error asks for the finest level at the needle only."""
    body = united(ball(0.4), ball(0.012, (0.41, 0, 0)))
    forest = wc.TetForest.from_domain(body, 1.0, max_level=18, surface_error=1e-3)
    assert forest.levels.max() == 18
    volume = 4 / 3 * np.pi * 0.064
    assert len(forest.tets) < 0.1 * 6 * 2**18 * volume


def test_each_point_is_looked_at_once():
    """But for the last look at a few elements, whose middle may be a node elsewhere."""
    body = ball()
    forest = wc.TetForest.from_domain(body, 1.0, max_level=15, surface_error=1e-3)
    asked = np.concatenate(body.asked)
    assert len(asked) > len(forest.points)
    assert len(np.unique(asked, axis=0)) > 0.99 * len(asked)


def test_refining_where_a_function_asks_for_it():
    def near(x):
        return np.linalg.norm(x - [0.1, 0, 0], axis=1) < 0.08

    plain = wc.TetForest.from_domain(ball(), 0.5, max_level=12, surface_error=2e-2)
    forest = wc.TetForest.from_domain(ball(), 0.5, max_level=12, surface_error=2e-2, refine_where=near)
    middle = forest.points[forest.tets].mean(axis=1)
    assert (forest.levels[near(middle)] == 12).all()
    assert near(middle).sum() > 100
    assert forest.levels[np.linalg.norm(middle - [0.1, 0, 0], axis=1) > 0.3].max() <= plain.levels.max() + 2
    assert_conforming(forest)


def test_refining_where_a_field_varies():
    def stiffness(x):
        return np.where(x[:, 2] > 0.013, 3.0, 1.0)

    forest = wc.TetForest.from_domain(ball(), 0.5, max_level=9, surface_error=5e-2, field=stiffness)
    values = stiffness(forest.points)[forest.tets]
    assert (forest.levels[np.ptp(values, axis=1) > 0] == 9).all()
    smooth = wc.TetForest.from_domain(
        ball(), 0.5, max_level=9, surface_error=5e-2, field=lambda x: x[:, 2], field_tolerance=0.1
    )
    coarse = np.ptp(smooth.points[smooth.tets][..., 2], axis=1) > 0.1
    assert not coarse[smooth.levels < 9].any()


@pytest.mark.parametrize("target", [500, 3000, 20000])
def test_a_number_of_elements_can_be_asked_for(target):
    forest = wc.TetForest.from_domain(ball(), 0.5, max_level=24, target_elements=target)
    assert 0.5 * target < len(forest.tets) <= target


@pytest.mark.parametrize(("scale", "shift"), [(1e-3, 0.0), (1e3, 0.0), (1.0, 30.0)])
def test_size_and_place_do_not_matter(scale, shift):
    """The same ring in millimetres, in kilometres and far from the origin: as many elements within one in a hundred,
    where float32 coordinates decide otherwise."""
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


def test_the_same_mesh_comes_out_twice():
    one, two = (wc.TetForest.from_domain(ring(), 0.3, max_level=12, surface_error=2e-3) for _ in range(2))
    assert np.array_equal(one.lattice, two.lattice)
    assert np.array_equal(one.tets, two.tets)
    assert np.array_equal(one.fill, two.fill)


# --- the forest ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def forest():
    return wc.TetForest.from_domain(ring(), 0.3, max_level=12, surface_error=2e-3)


def test_void_is_not_part_of_the_mesh(forest):
    tree = forest.tree
    assert (tree.first_child == -2).any()
    assert np.array_equal(np.sort(tree.leaves), np.flatnonzero(tree.first_child == -1))
    assert len(forest.lattice) > len(forest.points)
    touched = tree.tets[tree.first_child == -2]
    share = inside_shares(forest.phi[touched])
    assert share.max() < 0.02
    assert len(tree.tets) == 6 * np.prod(forest.cells) + 2 * (tree.first_child >= 0).sum()


@pytest.mark.parametrize("level", [0, 3, 6, 8, 9, 12])
def test_ancestors_stand_on_nodes(forest, level):
    """The highest one, not above the level, whose corners are nodes: none between it and the level has that."""
    tree, found = forest.tree, forest.ancestors(level)
    assert (tree.tets[found] < len(forest.points)).all()
    assert (tree.level[found] >= np.minimum(forest.levels, level)).all()
    corners = forest.points[tree.tets[found]]
    centroid = forest.points[forest.tets].mean(1) - corners[:, 0]
    weights = np.linalg.solve(np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2), centroid[..., None])[..., 0]
    assert (weights > -1e-12).all()
    assert (weights.sum(1) < 1 + 1e-12).all()
    climbing = tree.parent[found]
    while (climbing := climbing[(climbing >= 0) & (tree.level[climbing] >= level)]).size:
        assert (tree.tets[climbing].max(axis=1) >= len(forest.points)).all()
        climbing = tree.parent[climbing]


def test_refining_keeps_nodes_volume_and_surface(forest):
    rng = np.random.default_rng(3)
    chosen = rng.random(len(forest.tets)) < 0.1
    refined = forest.refine(chosen)
    assert np.array_equal(refined.points[: len(forest.points)], forest.points)
    assert len(refined.tets) > len(forest.tets)
    assert_conforming(refined)
    assert held(refined) == pytest.approx(held(forest), rel=1e-12)
    surface = refined.surface()
    assert as_trimesh(surface).is_watertight
    assert surface.volume == pytest.approx(forest.surface().volume, rel=1e-9)
    assert np.array_equal(np.unique(refined.tets), np.arange(len(refined.points)))
    again = refined.refine(np.arange(5))
    assert_conforming(again)
    assert held(again) == pytest.approx(held(forest), rel=1e-12)


@pytest.mark.parametrize("rotation_level", [None, 6, 9])
def test_forces_by_subtrees_are_those_of_the_leaves(forest, rotation_level, device, rng):
    body = wc.SoftBody(forest, wc.Isotropic(1e4, 0.4, 1000.0), device=device)
    u = np.zeros((body.node_count, 4), np.float32)
    u[:, :3] = 5e-4 * rng.standard_normal(forest.points.shape)
    found = []
    for subtrees in (True, False):
        given, f = wp.array(u, dtype=wp.vec4, device=device), wp.zeros(len(u), dtype=wp.vec4, device=device)
        wc.Corotated(rotation_level=rotation_level, subtrees=subtrees).bind(body).add_forces(given, f)
        found.append(f.numpy()[:, :3])
    assert np.abs(found[0] - found[1]).max() < 1e-5 * np.abs(found[1]).max()


def test_the_largest_piece_alone():
    pair = united(ball(0.2, (-0.3, 0, 0)), ball(0.1, (0.3, 0.1, 0)))
    both = wc.TetForest.from_domain(pair, 0.25, max_level=9)
    piece = both.pieces()
    assert np.array_equal(piece, np.where(both.points[both.tets].mean(axis=1)[:, 0] > 0.05, 1, 0))
    one = both.largest_piece()
    assert len(one.tets) == (piece == 0).sum()
    assert held(one) == pytest.approx((both.fill * both.volumes)[piece == 0].sum(), rel=1e-12)
    surface = one.surface()
    assert surface.euler_characteristic == 2
    assert surface.volume == pytest.approx(held(one), rel=1e-11)
    assert_conforming(one)
    assert one.largest_piece() is one
    assert wc.TetForest.box().largest_piece().pieces().tolist() == [0] * 6


# --- regions ---------------------------------------------------------------------------------------------------------


def layered():
    """A ball of three labels: below a slanted plane, and above it left and right."""

    def labels(x):
        upper = np.where(x[:, 0] > 0.05, 3, 2)
        return np.where(x[:, 1] + 0.3 * x[:, 0] < 0.02, 1, upper).astype(np.int32)

    body = ball()
    body.labels, body.label_names = labels, ("fat", "left", "right")
    return body


@pytest.fixture(scope="module")
def labelled():
    return wc.TetForest.from_domain(layered(), 0.25, max_level=9)


def test_labels_become_regions(labelled):
    body, mesh = layered(), labelled
    middle = mesh.points[mesh.tets].mean(axis=1)
    away = np.ptp(body.labels(mesh.points)[mesh.tets], axis=1) == 0
    assert np.array_equal(mesh.labels[away], body.labels(middle)[away])
    assert (mesh.levels[~away] == 9).all()
    assert sum(mesh.elements_of(name) for name in body.label_names).tolist() == [1] * len(mesh.tets)
    for name in body.label_names:
        nodes = np.unique(mesh.tets[mesh.elements_of(name)])
        assert np.array_equal(np.flatnonzero(mesh.nodes_of(name)), nodes)
    assert any("label left" in line for line in mesh.summary())
    with pytest.raises(wc.InputError, match="fat, left, right"):
        mesh.elements_of("bone")
    with pytest.raises(wc.InputError, match="no label"):
        wc.TetForest.box().nodes_of("fat")


def test_surfaces_between_labels_are_closed_and_fit(labelled):
    surface = labelled.separating_surface()
    exact = layered()
    x = np.random.default_rng(0).uniform(-0.4, 0.4, (400_000, 3))
    inside = exact.function(x) < 0
    volumes = []
    for label in (1, 2, 3):
        one = surface.of_label(label)
        assert as_trimesh(one).is_watertight
        assert as_trimesh(one).is_winding_consistent
        volumes.append(one.volume)
        assert one.volume == pytest.approx(0.512 * (inside & (exact.labels(x) == label)).mean(), rel=0.05)
    outer = surface.triangles[surface.sides[:, 1] == 0]
    outer = trimesh.Trimesh(surface.points, outer, process=False)
    assert sum(volumes) == pytest.approx(outer.volume, rel=1e-9)
    assert outer.volume == pytest.approx(held(labelled), rel=2e-3)
    assert {tuple(s) for s in surface.sides} == {(1, 0), (2, 0), (3, 0), (2, 1), (3, 1), (3, 2)}
    assert surface.nodes.max() < len(labelled.points)
    assert np.allclose(surface.weights.sum(axis=1), 1)


@pytest.mark.parametrize("seed", range(3))
def test_random_labels_have_closed_surfaces_that_fill_the_box(seed):
    """Labels at random: elements of two, three and four labels in all arrangements, without gaps or overlaps."""
    from warp_corot.mesh.separating import separated

    rng = np.random.default_rng(seed)
    box = wc.TetForest.box((2, 2, 2), 1.0, 4)
    values = np.full(len(box.points), -1.0)
    labels = rng.integers(1, 6, len(box.points))
    labels[((box.points == 0) | (box.points == 2)).any(axis=1)] = 1
    surface = separated(box.points, box.tets, values, labels)
    total = 0.0
    for label in range(2, 6):
        one = surface.of_label(label)
        edges = np.concatenate([one.triangles[:, [i, j]] for i, j in ((0, 1), (1, 2), (2, 0))])
        assert np.array_equal(np.sort(edges @ [1e6, 1]), np.sort(edges @ [1, 1e6]))
        assert one.volume > 0
        total += one.volume
    assert total == pytest.approx(-surface.of_label(1).volume, rel=1e-9)


def test_label_shares_fill_what_is_inside():
    rng = np.random.default_rng(6)
    values, labels = rng.standard_normal((500, 4)), rng.integers(1, 4, (500, 4))
    shares = label_shares(values, labels, 3)
    assert np.allclose(shares.sum(axis=1), inside_shares(values), atol=1e-12)
    assert (shares >= 0).all()
    pure = np.ptp(labels, axis=1) == 0
    assert np.allclose(shares[pure, labels[pure, 0]], inside_shares(values[pure]))
    # Two labels, all inside: one node's corner is an eighth, two nodes' wedge a half.
    shares = label_shares(-np.ones((2, 4)), np.array([[1, 2, 2, 2], [1, 2, 1, 2]]), 2)
    assert np.allclose(shares, [[0, 1 / 8, 7 / 8], [0, 1 / 2, 1 / 2]])


# --- what is refused -------------------------------------------------------------------------------------------------


def test_an_empty_body_is_said_so():
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
