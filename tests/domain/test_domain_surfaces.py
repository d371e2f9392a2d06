"""Domains enclosed by triangle surfaces: against brute force in float64, disordered, with holes, and refused ones."""

import numpy as np
import pytest
import trimesh
from domains import ROUNDING, around, arrays, same, with_hole
from meshes import assert_balanced
from pxr import Gf, Usd, UsdGeom, Vt
from scipy.spatial.transform import Rotation
from warp.examples import get_asset_directory

from warp_corot.domain import Domain
from warp_corot.domain.closing import close_surface
from warp_corot.errors import InputError


@pytest.mark.parametrize("shape", ["torus", "box"])
def test_surfaces_against_brute_force(shape, device, rng):
    """Distances by trimesh's closest points of every triangle, signs by the sum of solid angles, in float64."""
    made = {"torus": trimesh.creation.torus(0.8, 0.3, 16, 8), "box": trimesh.creation.box((1.0, 0.01, 0.6))}
    points, triangles = arrays(made[shape])
    domain = Domain.from_surface((100 * points, triangles), unit="cm", device=device)
    at = around(domain, rng, 300)
    corners = points[triangles]
    for x, phi in zip(at, domain.phi(at), strict=True):
        nearest = trimesh.triangles.closest_point(corners, np.tile(x, (len(corners), 1)))
        distance = np.linalg.norm(nearest - x, axis=1).min()
        a, b, c = (corners - x).transpose(1, 0, 2)
        la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
        below = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
        winding = np.arctan2((a * np.cross(b, c)).sum(1), below).sum() / (2 * np.pi)
        assert np.isclose(phi, -distance if winding > 0.5 else distance, atol=ROUNDING)


def test_disorder_makes_no_difference(device, rng):
    points, triangles = arrays(trimesh.creation.torus(0.8, 0.3, 20, 9))
    right = Domain.from_surface((points, triangles), device=device)
    assert "closed" in right.report()
    inside_out = Domain.from_surface((points, triangles[:, ::-1]), device=device)
    same(inside_out, right, rng)
    assert any("inside out turned round" in line for line in inside_out.report())
    mixed = np.where((rng.random(len(triangles)) < 0.4)[:, None], triangles[:, ::-1], triangles)
    same(Domain.from_surface((points, mixed), device=device), right, rng)
    one = triangles.copy()
    one[0] = one[0, ::-1]
    one = Domain.from_surface((points, one), device=device)
    same(one, right, rng)
    assert "1 triangles wound against their neighbours turned round" in one.report()
    # Triangles without common points, as in .stl files, with corners off by less than the weld, and one duplicate.
    soup = points[triangles].reshape(-1, 3) + 1e-8 * rng.standard_normal((3 * len(triangles), 3))
    rows = np.arange(len(soup)).reshape(-1, 3)
    loose = Domain.from_surface((soup, np.concatenate([rows, rows[:1]])), device=device)
    same(loose, right, rng)
    assert "closed" in loose.report()
    # Every triangle twice, with both orientations.
    same(Domain.from_surface((points, np.concatenate([triangles, triangles[:, ::-1]])), device=device), right, rng)


@pytest.mark.parametrize("copies", ["alike", "both ways round", "nearly in place"])
def test_triangles_that_are_there_twice_make_no_holes(copies, device, rng):
    points, triangles = arrays(trimesh.creation.icosphere(2))
    right, again = Domain.from_surface((points, triangles), device=device), triangles[::8]
    if copies == "both ways round":
        again = again[:, ::-1]
    if copies == "nearly in place":
        near = points[again].reshape(-1, 3) + 1e-8 * rng.standard_normal((3 * len(again), 3))
        points, again = np.concatenate([points, near]), len(points) + np.arange(len(near)).reshape(-1, 3)
    doubled = Domain.from_surface((points, np.concatenate([triangles, again])), device=device)
    same(doubled, right, rng)
    assert {"closed", "40 triangles without area or there twice left out"} <= set(doubled.report())


def test_a_shell_that_is_there_both_ways_round_is_no_cavity(device):
    outer, inner = (trimesh.creation.icosphere(1, radius=r) for r in (1.0, 0.5))
    points, triangles = arrays(trimesh.util.concatenate([outer, inner, inner]))
    triangles[80:160] = triangles[80:160, ::-1]
    domain = Domain.from_surface((points, triangles), device=device)
    assert (domain.phi([[0, 0, 0], [0.7, 0, 0]]) < 0).all()


def test_a_cavity_with_triangles_both_ways_round_stays_hollow(device):
    outer, inner = (trimesh.creation.icosphere(1, radius=r) for r in (1.0, 0.5))
    inner.invert()
    points, triangles = arrays(trimesh.util.concatenate([outer, inner]))
    domain = Domain.from_surface((points, np.concatenate([triangles, triangles[80:120, ::-1]])), device=device)
    assert np.array_equal(domain.phi([[0, 0, 0], [0.7, 0, 0]]) < 0, [False, True])


def test_two_boxes_with_a_wall_between_are_one(device, rng):
    box = trimesh.creation.box((1.0, 1.0, 1.0))
    # Mirrored, so that the diagonals of the wall meet.
    other = box.copy().apply_transform(np.diag([-1.0, 1.0, 1.0, 1.0])).apply_translation([1.0, 0, 0])
    domain = Domain.from_surface(arrays(trimesh.util.concatenate([box, other])), device=device)
    same(domain, Domain.box((-0.5, -0.5, -0.5), (1.5, 0.5, 0.5), device=device), rng)


@pytest.mark.parametrize("inward", [False, True])
def test_a_cavity_stays_hollow(inward, device):
    outer, inner = trimesh.creation.icosphere(2), trimesh.creation.icosphere(2, radius=0.5)
    inner.invert()
    points, triangles = arrays(trimesh.util.concatenate([outer, inner]))
    domain = Domain.from_surface((points, triangles[:, ::-1] if inward else triangles), device=device)
    assert np.array_equal(domain.phi([[0, 0, 0], [0.7, 0, 0], [1.2, 0, 0]]) < 0, [False, True, False])
    assert "1 cavity" in domain.report()


def test_parts_are_turned_by_their_nesting(device):
    """Balls inside a ball are cavities, balls beside it are bodies; in the input all are wound inwards."""
    ball = trimesh.creation.icosphere(1, radius=0.3)
    ball.invert()
    places = [np.array(k) - 1.0 for k in np.ndindex(3, 3, 3)]
    parts = [trimesh.creation.icosphere(4, radius=3.0), *(ball.copy().apply_translation(p) for p in places)]
    beside = [place + np.array([6.0, 0, 0]) for place in places]
    parts += [ball.copy().apply_translation(p) for p in beside]
    domain = Domain.from_surface(arrays(trimesh.util.concatenate(parts)), device=device)
    assert (domain.phi(places) > 0).all()
    assert (domain.phi(beside) < 0).all()
    assert {"27 cavities", "27 parts inside out turned round", "28 separate parts"} <= set(domain.report())


def test_overlapping_parts_are_one_body(device, rng):
    first, second = trimesh.creation.icosphere(3), trimesh.creation.icosphere(3)
    second.apply_translation([0.8, 0, 0]).invert()
    domain = Domain.from_surface(arrays(trimesh.util.concatenate([first, second])), device=device)
    points = around(domain, rng)
    # Icospheres of level 3 are within 0.01 of the sphere.
    exact = (Domain.sphere(1.0) | Domain.sphere(1.0, (0.8, 0, 0))).phi(points)
    sure = np.abs(exact) > 0.01
    assert np.array_equal((domain.phi(points) < 0)[sure], (exact < 0)[sure])
    assert any("overlap" in line for line in domain.report())


def test_holes_are_closed_and_counted(device, rng):
    points, triangles = with_hole()
    with pytest.warns(UserWarning, match=r"open: its 1 hole took 1\.\d% of its area"):
        domain = Domain.from_surface((points, triangles), device=device)
    assert len(triangles) == 320 - 5
    assert any("open: 5 edges in 1 hole," in line for line in domain.report())
    # The cap is flatter than the sphere by the sagitta of its radius, which is at most 0.325.
    same(domain, Domain.sphere(1.0, device=device), rng, atol=1.0 - np.sqrt(1.0 - 0.325**2))


def test_a_sphere_with_a_tenth_of_its_triangles_gone(device, rng):
    points, triangles = arrays(trimesh.creation.icosphere(4))
    kept = triangles[rng.random(len(triangles)) > 0.1]
    with pytest.warns(UserWarning, match="open"):
        domain = Domain.from_surface((points, kept), device=device)
    at = around(domain, rng)
    exact = Domain.sphere(1.0).phi(at)
    assert np.array_equal(domain.phi(at)[np.abs(exact) > 0.05] < 0, exact[np.abs(exact) > 0.05] < 0)


def open_boxes_at_an_edge() -> tuple[np.ndarray, np.ndarray]:
    """Three cubes that share an edge, each without a face at it: their rims pass that edge in the same direction."""
    points, triangles = arrays(trimesh.creation.box((1.0, 1.0, 1.0)))
    points += 0.5
    kept = triangles[(points[triangles][:, :, 0] > 0).any(axis=1)]
    assert len(kept) == 10
    turned = [Rotation.from_rotvec([0, 0, np.radians(angle)]).apply(points) for angle in (0.0, 120.0, 240.0)]
    return np.concatenate(turned), np.concatenate([kept + k * len(points) for k in range(3)])


def perforated() -> tuple[np.ndarray, np.ndarray]:
    points, triangles = arrays(trimesh.creation.icosphere(3))
    return points, triangles[np.random.default_rng(3).random(len(triangles)) > 0.1]


@pytest.mark.parametrize("make", [with_hole, perforated, open_boxes_at_an_edge])
def test_closed_surfaces_have_no_boundary(make):
    points, triangles = make()
    closed = close_surface(points, triangles)
    assert closed.caps > 0
    assert_balanced(closed)
    assert trimesh.Trimesh(closed.points, closed.triangles, process=False).volume == pytest.approx(closed.volume)


def half(mesh: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    points, triangles = arrays(mesh)
    return points, triangles[points[triangles].mean(axis=1)[:, 2] > 0]


def bow_tie() -> tuple[np.ndarray, np.ndarray]:
    """A prism over a polygon that crosses itself: a third of it has the other orientation."""
    corners = np.array([[0, 0], [2, 2], [2, 0], [1, 0.6], [0, 1.2]], float)
    n = len(corners)
    points = np.concatenate([np.pad(corners, ((0, 0), (0, 1)), constant_values=z) for z in (0.0, 1.0)])
    side = [[k, (k + 1) % n, n + k] for k in range(n)] + [[(k + 1) % n, n + (k + 1) % n, n + k] for k in range(n)]
    lids = [[0, k + 1, k] for k in range(1, n - 1)] + [[n, n + k, n + k + 1] for k in range(1, n - 1)]
    return points, np.array(side + lids)


def walled() -> tuple[np.ndarray, np.ndarray]:
    """A flat box of eight boxes, with each of their faces once."""
    cube = trimesh.creation.box(bounds=[[0, 0, 0], [1, 1, 1]])
    mirrors = [np.diag([x, y, z, 1.0]) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    points, triangles = arrays(trimesh.util.concatenate([cube.copy().apply_transform(each) for each in mirrors]))
    points, place = np.unique(points + 0.0, axis=0, return_inverse=True)
    _, first = np.unique(np.sort(place[triangles], axis=1), axis=0, return_index=True)
    return points * [1.0, 1.0, 0.1], place[triangles][first]


SQUARE = (np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float), np.array([[0, 1, 2], [0, 2, 3]]))
CUBE = arrays(trimesh.creation.box((1.0, 1.0, 1.0)))

REFUSED = {
    "a sheet": (SQUARE, "is open: 4 edges in 1 hole, and closing takes 100%"),
    "a box with walls": (walled(), "walls inside it, .*: 24 edges join three or more triangles"),
    "a sheet of two sides": ((SQUARE[0], np.concatenate([SQUARE[1], SQUARE[1][:, ::-1]])), "zero thickness"),
    "a flattened cube": ((CUBE[0] * [1, 1, 0], CUBE[1]), "zero thickness"),
    "a cube flattened to less than a hair": ((CUBE[0] * [1, 1, 1e-6], CUBE[1]), "zero thickness"),
    "a bowl": (half(trimesh.creation.icosphere(3)), r"is open: .* closing takes \d\d%"),
    "a bow tie": (bow_tie(), "inside out"),
    "a line": ((CUBE[0] * [1, 0, 0], CUBE[1]), "zero thickness|degenerate|no volume"),
    "a point": ((CUBE[0] * 0, CUBE[1]), "degenerate"),
    "NaN": ((np.where(CUBE[0] > 0, np.nan, CUBE[0]), CUBE[1]), "point . is .*nan"),
    "indices out of range": ((CUBE[0], CUBE[1] + 1), "names the points .*there are 8"),
    "indices that are no whole numbers": ((CUBE[0], CUBE[1].astype(float)), "dtype float64; they must be indices"),
    "no triangles": ((CUBE[0], CUBE[1][:0]), r"shape \(0, 3\)"),
    "flat points": ((CUBE[0][:, :2], CUBE[1]), r"shape \(8, 2\)"),
    "a body of 1e30 m": ((1e30 * CUBE[0], CUBE[1]), r"1e\+30 m long; it must be"),
    "a body of 1e-12 m": ((1e-12 * CUBE[0], CUBE[1]), "1e-12 m long; it must be"),
    "a body far away": ((1e5 + CUBE[0], CUBE[1]), r"1\.02 m long and reaches 100000 m from the origin"),
    "words": ((np.array([["a", "b", "c"]]), CUBE[1]), "must be numbers"),
    "one array": (CUBE[0], "must be a file or"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_encloses_no_body_is_refused_in_one_line(what):
    surface, message = REFUSED[what]
    with pytest.raises(InputError, match=message) as raised:
        Domain.from_surface(surface)
    assert "\n" not in str(raised.value)


def test_units_and_unlikely_sizes():
    metres = Domain.from_surface(CUBE).bounds
    assert np.allclose(Domain.from_surface(CUBE, unit="cm").bounds, 0.01 * metres)
    assert np.allclose(Domain.from_surface((250 * CUBE[0], CUBE[1]), unit="mm").bounds, 0.25 * metres)
    with pytest.warns(UserWarning, match=r"300 m long.*in mm, give unit='mm'.*0\.001: 300 mm"):
        Domain.from_surface((300 * CUBE[0], CUBE[1]))
    with pytest.warns(UserWarning, match="0.3 mm long: is its unit right"):
        Domain.from_surface((3e-4 * CUBE[0], CUBE[1]))
    assert np.allclose(Domain.from_surface(CUBE, unit="inch").bounds, 0.0254 * metres)
    for unit in ("kg", "inches of rope", "-3mm", 0.0):
        with pytest.raises(InputError, match=f"unit is {unit!r}; it must be a length such as 'mm'"):
            Domain.from_surface(CUBE, unit=unit)


@pytest.mark.parametrize("suffix", [".obj", ".stl", ".ply", ".off", ".glb"])
def test_surface_files(suffix, tmp_path, rng):
    mesh = trimesh.creation.torus(0.8, 0.3, 20, 9)
    path = tmp_path / f"ring{suffix}"
    mesh.export(path)
    domain = Domain.from_surface(path)
    same(domain, Domain.from_surface(arrays(mesh)), rng, atol=1e-5)
    assert domain.up_axis == ("Y" if suffix in (".obj", ".glb") else "Z")
    said = " ".join(domain.report())
    assert ("as the file says" in said) == (suffix == ".glb")
    assert ("names no up axis" in said) == (suffix != ".glb")
    path.write_bytes(bytes(range(255, 0, -1)) * 9)
    with pytest.raises(InputError, match=rf"ring\{suffix}") as raised:
        Domain.from_surface(path)
    assert "\n" not in str(raised.value)


def test_usd_meshes_come_in_metres_placed_and_wound_as_the_stage_says(tmp_path, rng):
    stage = Usd.Stage.CreateNew(str(tmp_path / "boxes.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    UsdGeom.SetStageUpAxis(stage, "Z")
    x, y, z = np.meshgrid([-0.5, 0.5], [-0.5, 0.5], [-0.5, 0.5], indexing="ij")
    corners = np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    for k, (mirrored, left) in enumerate([(False, False), (True, False), (False, True)]):
        mesh = UsdGeom.Mesh.Define(stage, f"/box{k}")
        mesh.AddTransformOp().Set(Gf.Matrix4d().SetTranslate(Gf.Vec3d(20.0 * k, 0, 0)))
        mesh.AddScaleOp().Set(Gf.Vec3f(-10.0 if mirrored else 10.0, 10.0, 10.0))
        mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(corners.astype(np.float32)))
        mesh.CreateFaceVertexCountsAttr([4] * 6)
        mesh.CreateFaceVertexIndicesAttr((quads[:, ::-1] if left else quads).ravel().tolist())
        mesh.CreateSubdivisionSchemeAttr("none")
        if left:
            mesh.CreateOrientationAttr("leftHanded")
    stage.GetRootLayer().Save()
    domain = Domain.from_surface(tmp_path / "boxes.usda")
    boxes = [Domain.box(np.array([0.2 * k, 0, 0]) - 0.05, np.array([0.2 * k, 0, 0]) + 0.05) for k in range(3)]
    same(domain, boxes[0] | boxes[1] | boxes[2], rng)
    assert domain.up_axis == "Z"
    assert not any("turned" in line for line in domain.report())
    assert "3 separate parts" in domain.report()


def test_the_bunny_is_closed():
    """The closed bunny has the size of the real one; the file's is ten times as large."""
    bunny = Domain.from_surface("warp:bunny")
    assert "closed" in bunny.report()
    assert bunny.up_axis == "Y"
    stage = Usd.Stage.Open(f"{get_asset_directory()}/bunny.usd")
    (mesh,) = (UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh))
    size = np.ptp(np.array(mesh.GetPointsAttr().Get()), axis=0)
    assert np.allclose(np.ptp(bunny.bounds, axis=0), 0.1 * size, atol=ROUNDING)
    with pytest.raises(InputError, match="warp:lion: no such asset; it must be warp:bunny"):
        Domain.from_surface("warp:lion")
