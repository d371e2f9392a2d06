"""Surfaces of bodies that were cut: closed, with both lips, drawn and in contact."""

import numpy as np
import pytest
from blade_cases import labelled_mesh
from bodies import ball
from cut_cases import assert_closed, assert_cut_sound
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

import warp_corot as wc

PLANE = wc.Plane((1.0, 0.3, 0.2), 0.03)


def organ(device, young=3e4):
    """A ball whose surface lies within its elements."""
    mesh = wc.TetForest.from_domain(ball(), cell_size=0.25, max_level=7, device="cpu")
    body = wc.SoftBody(mesh, wc.Isotropic(young, 0.4, 1000.0), device=device)
    body.fix("x < xmin + 0.1")
    return body


def volume(points, triangles):
    a, b, c = np.moveaxis(points[triangles].astype(float), 1, 0)
    return np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0


def components(triangles):
    """The part of each triangle, joined by points, and the number of parts."""
    used, corners = np.unique(triangles, return_inverse=True)
    corners = corners.reshape(-1, 3)
    links = coo_array(
        (np.ones(2 * len(corners)), (np.repeat(corners[:, 0], 2), corners[:, 1:].ravel())), [len(used)] * 2
    )
    count, part = connected_components(links, directed=False)
    return part[corners[:, 0]], count


def test_the_surface_of_a_cut_body_is_closed(device):
    body = organ(device)
    before = body.mesh.surface()
    sim = wc.Simulation(body, gravity=(0, 0, 0))
    area = sim.cut(PLANE)
    # The disc's area, of what is inside the body alone.
    assert area == pytest.approx(np.pi * (0.4**2 - PLANE.offset**2), rel=0.03)
    assert_cut_sound(body.changing.forest)
    surface = body.mesh.surface()
    assert_closed(surface.triangles)
    assert volume(surface.points, surface.triangles) == pytest.approx(volume(before.points, before.triangles), rel=0.01)
    assert body.pieces == 2
    # Each part of the surface is bound to one piece.
    piece = np.zeros(body.node_count, int)
    piece[body.mesh.tets] = body.mesh.pieces()[:, None]
    part, count = components(surface.triangles)
    assert count == 2
    for k in range(2):
        points = np.unique(surface.triangles[part == k])
        assert len(np.unique(piece[surface.nodes[points]][surface.weights[points] != 0.0])) == 1


def test_lips_are_as_flat_as_the_plane(device):
    """Although the faces that were separated are not: lips are drawn where the cut went."""
    for turned in (False, True):
        body = organ(device)
        body.release(np.arange(body.node_count))
        sim = wc.Simulation(body, gravity=(0, 0, 0))
        turn = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]]) if turned else np.eye(3)
        body.positions = 1.1 * body.mesh.points @ turn.T
        area = sim.cut(PLANE) * 1.1**2
        surface = body.mesh.surface()
        assert_closed(surface.triangles)
        x = surface.moved(body.displacements.numpy())
        size = 0.25 * 2.0 ** (-7 / 3)
        lips = (np.abs(x @ PLANE.normal - PLANE.offset)[surface.triangles] < 0.1 * size).all(axis=1)
        a, b, c = np.moveaxis(x[surface.triangles[lips]], 1, 0)
        found = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
        assert found == pytest.approx(2.0 * area, rel=0.06)


@pytest.mark.parametrize("seed", range(4))
def test_faces_of_cuts_are_drawn_where_planes_went(seed, device):
    """Within a tenth of an element also at the rim; and the body keeps its volume."""
    rng = np.random.default_rng(seed)
    body = organ(device)
    sim = wc.Simulation(body, gravity=(0, 0, 0))
    whole = body.mesh.surface().volume
    size = 0.25 * 2.0 ** (-7 / 3)
    first, second = rng.normal(size=(2, 3))
    second -= 0.5 * (second @ first) / (first @ first) * first  # the planes are far from parallel
    planes = [wc.Plane(first, 0.07), wc.Plane(second, -0.05)]
    for plane in planes:
        assert sim.cut(plane) > 0.0
        surface = body.mesh.surface()
        assert_closed(surface.triangles)
        assert surface.volume == pytest.approx(whole, rel=0.02)
        x = surface.points[surface.triangles[surface.is_cut]]
        away = np.stack([x @ each.normal - each.offset for each in planes], axis=2)
        if plane is planes[0]:
            away = away[..., :1]
        on_one = (np.abs(away).max(axis=1) < 0.1 * size).any(axis=1)
        # Some points at the rim are of elements that were left out of the mesh.
        assert on_one.mean() > 0.95


def test_lips_that_touch_carry_as_if_they_were_whole(device):
    """A body that is cut across its weight sags as the uncut one does."""
    sags = []
    for is_cut in (False, True):
        body = organ(device, young=2e5)
        body.release(np.arange(body.node_count))
        body.fix("y < ymin + 0.1")
        contact = wc.Contact(friction=0.5, self_contact=True)
        sim = wc.Simulation(body, gravity=(0, -9.81, 0), contact=contact, integrator=wc.SymplecticEuler(damping=20.0))
        if is_cut:
            sim.cut(wc.Plane((0.1, 1.0, 0.0), 0.0))
            assert body.pieces == 2
        sim.advance(0.12)
        sags.append(body.displacements.numpy()[body.mesh.points[:, 1] > 0.2, 1].mean())
    assert np.abs(body.contact_forces.numpy()).max() > 0.0
    assert len(body.contact_pressure) == len(body.contact_surface.triangles)
    assert_closed(body.contact_surface.triangles)
    assert sags[0] < -0.005
    assert sags[1] == pytest.approx(sags[0], rel=0.05)


def test_surfaces_that_would_stay_in_one_piece_are_refused(device, tmp_path):
    """A user's own surface does not follow a cut: that is one line, and nothing is drawn wrongly."""
    mesh = wc.TetForest.box((2, 1, 1), 0.2, 3)
    material = wc.Isotropic(3e4, 0.4, 1000.0)
    x = np.array([[0.1, 0.1, 0.1], [0.3, 0.1, 0.1], [0.1, 0.15, 0.1]])
    bound = wc.SoftBody(mesh, material, device=device)
    bound.bind(x, [[0, 1, 2]])
    sim = wc.Simulation(bound)
    with pytest.raises(wc.InputError, match="does not come apart where it is cut"):
        sim.cut(wc.Plane((1, 0, 0), 0.2))
    sim.advance_steps(1)
    body = wc.SoftBody(mesh, material, device=device)
    sim = wc.Simulation(body, cuts=[])
    body.bind(x)
    with pytest.raises(wc.InputError, match="does not come apart where it is cut"):
        body.bind(x, [[0, 1, 2]])
    surface = mesh.bind(x, [[0, 1, 2]])
    with pytest.raises(wc.InputError, match="a surface is given, but the body can be cut"):
        wc.record(sim, tmp_path / "a.usda", duration=0.1, surface=surface)


def test_labelled_bodies_are_cut(device, tmp_path):
    """Labels, materials and the surface follow; surfaces between labels are refused."""
    mesh = labelled_mesh()
    body = wc.SoftBody(mesh, wc.Isotropic(np.where(mesh.labels == 1, 2e4, 6e4), 0.4, 1000.0), device=device)
    shares = np.bincount(mesh.labels, mesh.volumes)
    sim = wc.Simulation(body, gravity=(0, 0, 0), cuts=[])
    middle = mesh.points[mesh.tets[mesh.labels == 2]].mean(axis=(0, 1))
    sim.cut(wc.Plane((0.1, 1.0, 0.2), point=middle))
    assert body.pieces == 2
    np.testing.assert_allclose(np.bincount(body.mesh.labels, body.mesh.volumes), shares, rtol=1e-9)
    surface = body.mesh.surface()
    assert_closed(surface.triangles)
    assert surface.volume == pytest.approx(mesh.surface().volume, rel=0.02)
    with pytest.raises(wc.InputError, match="surfaces between labels do not come apart"):
        body.mesh.separating_surface()
    with pytest.raises(wc.InputError, match="labels are drawn, but the body can be cut"):
        wc.record(sim, tmp_path / "a.usda", duration=0.1, labels=True)


@pytest.mark.parametrize("make", [organ, None])
def test_recordings_show_the_cut(make, device, tmp_path):
    from pxr import Usd, UsdGeom, UsdShade

    pytest.importorskip("meshio")
    if make is None:
        body = wc.SoftBody(wc.TetForest.box((2, 1, 1), 0.2, 5), wc.Isotropic(3e4, 0.4, 1000.0), device=device)
        body.fix("x == xmin")
    else:
        body = make(device)
    sim = wc.Simulation(body, gravity=(0, -9.81, 0), integrator=wc.SymplecticEuler(damping=5.0), cuts=[])
    plane = PLANE if make else wc.Plane((1.0, 0.3, 0.1), 0.2)
    sim.on_step(lambda sim: sim.cut(plane) if sim.body.pieces == 1 and sim.time > 0.1 else None)
    path = tmp_path / "cut.usda"
    wc.record(sim, path, duration=0.25, fps=12, also=[tmp_path / "cut.pvd"])
    assert body.pieces == 2
    stage = Usd.Stage.Open(str(path))
    mesh = UsdGeom.Mesh.Get(stage, "/SoftBody/surface")
    parts = []
    for code in range(int(stage.GetEndTimeCode()) + 1):
        triangles = np.array(mesh.GetFaceVertexIndicesAttr().Get(code)).reshape(-1, 3)
        points = np.array(mesh.GetPointsAttr().Get(code))
        assert triangles.max() < len(points)
        assert_closed(triangles)
        parts.append(components(triangles)[1])
    assert parts[0] == 1
    assert parts[-1] == 2
    # The faces of the cut have their own material.
    (subset,) = UsdShade.MaterialBindingAPI(mesh).GetMaterialBindSubsets()
    material, _ = UsdShade.MaterialBindingAPI(subset).ComputeBoundMaterial()
    assert material.ComputeSurfaceSource()[0].GetShaderId() == "UsdPreviewSurface"
    assert UsdGeom.Subset.ValidateFamily(mesh, UsdGeom.Tokens.face, UsdShade.Tokens.materialBind)[0]
    assert len(subset.GetIndicesAttr().Get(0)) == 0
    a, b, c = np.moveaxis(points[triangles[np.array(subset.GetIndicesAttr().Get(code))]], 1, 0)
    inside = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    assert inside == pytest.approx(2.0 * body.cut_area, rel=0.1)
