"""Laws of meshes and surfaces, and bodies with samples of their exact surface."""

import itertools

import numpy as np
import trimesh
from bodies import ball, ring, turned_box
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from warp_corot.mesh.surfaces.bound import nearest_faces

PAIRS = list(itertools.combinations(range(4), 2))
TURN = Rotation.from_rotvec([0.3, 0.5, 0.7]).as_matrix()
HALF = (0.3, 0.2, 0.15)


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


def assert_balanced(surface):
    """Every edge is passed equally often in both directions, even if more than two triangles share it."""
    edges = np.concatenate([surface.triangles[:, [i, j]] for i, j in ((0, 1), (1, 2), (2, 0))]).astype(np.int64)
    count = len(surface.points)
    assert np.array_equal(np.sort(edges @ [count, 1]), np.sort(edges @ [1, count]))


def assert_bound(surface, forest):
    """Each point is the mean of the nodes to which it is bound, with weights that sum to one, and moves with them."""
    assert surface.nodes.max() < len(forest.points)
    assert np.allclose(surface.weights.sum(axis=1), 1)
    at = np.einsum("vn,vnc->vc", surface.weights, forest.points[surface.nodes])
    assert np.allclose(at, surface.points, rtol=0, atol=1e-12)


def as_trimesh(surface):
    return trimesh.Trimesh(surface.points, surface.triangles, process=False)


def held(forest):
    return float((forest.fill * forest.volumes).sum())


def farthest(surface, points, near=16):
    """The largest distance of points from a surface, by trimesh's formula: from the triangle that Warp finds,
    which in float32 may be next to the nearest, and from those with the nearest centres; so no distance is too small.
    """
    corners = surface.points[surface.triangles]
    found = nearest_faces(surface.points, surface.triangles, points, 1e15)
    _, faces = cKDTree(corners.mean(axis=1)).query(points, k=near)
    faces = np.column_stack([faces, found])
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
    """Faces, edges and corners of the rotated box."""
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
