"""Bodies from surfaces and scans, recorded: the drawing is the body's surface."""

import numpy as np
import pytest
import trimesh
from pxr import Gf, UsdGeom
from stages import SURFACE, TETS, drawn, faults, prims, still

import warp_corot as wc
from warp_corot.domain import Domain

CORE = 0.023


def ball(device="cpu", radius=0.05, **options) -> wc.TetForest:
    return wc.TetForest.from_domain(Domain.sphere(radius, device=device), 0.05, max_level=4, **options)


def core(device="cpu") -> wc.TetForest:
    """A ball with another label in its middle."""
    inner, outer = Domain.sphere(CORE, device=device), Domain.sphere(0.05, device=device)
    return wc.TetForest.from_domain(inner.named("core") | outer.named("soft tissue"), 0.05, max_level=6)


def simulated(mesh, device="cpu", young=1e4) -> wc.Simulation:
    return wc.Simulation(wc.SoftBody(mesh, wc.Isotropic(young, 0.4, 1e3), device=device), gravity=(0, 0, 0))


def rotation() -> np.ndarray:
    q = Gf.Rotation(Gf.Vec3d(1, 2, 3), 50)
    return np.array(Gf.Matrix3d(q)).T


def test_the_smooth_surface_follows_the_body(device, tmp_path):
    """An affine motion moves every point exactly, a rotation rotates the normals, a uniform strain is one stress."""
    mesh = ball(device)
    sim = simulated(mesh, device)
    rest = mesh.surface()
    turned, stretch = rotation(), np.diag([1.05, 1.0, 1.0])
    for name, motion, stress in (("turned.usd", turned, 0.0), ("stretched.usd", stretch, 0.05 * 1e4 / 1.4)):
        sim.body.displacements = mesh.points @ (motion.T - np.eye(3))
        stage = still(sim, tmp_path / name)
        assert prims(stage) == [SURFACE]
        surface = drawn(stage)
        np.testing.assert_allclose(surface.vertices, rest.points @ motion.T, atol=2e-8)
        extent = UsdGeom.Mesh.Get(stage, SURFACE).GetExtentAttr().Get(0)
        np.testing.assert_allclose(extent, surface.bounds, atol=1e-8)
        assert surface.is_watertight
        assert surface.is_winding_consistent
        assert surface.volume == pytest.approx(np.linalg.det(motion) * mesh_volume(mesh), rel=1e-4)
        primvars = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath(SURFACE))
        # sigma = lambda tr + 2 mu eps: the deviator of a uniaxial strain is 2 mu eps = E eps / (1 + nu).
        shown = np.array(primvars.GetPrimvar("vonMises").Get(0))
        np.testing.assert_allclose(shown, stress, rtol=1e-3, atol=0.5)
        assert len(primvars.GetPrimvar("displayColor").ComputeFlattened(0)) == len(shown)
        if motion is turned:
            normals = np.array(UsdGeom.Mesh.Get(stage, SURFACE).GetNormalsAttr().Get(0))
            np.testing.assert_allclose(normals, rest.normals @ turned.T, atol=1e-4)
            outward = surface.vertices / np.linalg.norm(surface.vertices, axis=1, keepdims=True)
            assert (np.einsum("ij,ij->i", normals, outward) > 0.95).all()
        assert faults(tmp_path / name) == []


def mesh_volume(mesh: wc.TetForest) -> float:
    return float((mesh.fill * mesh.volumes).sum())


def test_tetrahedra_on_request(tmp_path):
    mesh = ball()
    sim = simulated(mesh)
    stage = still(sim, tmp_path / "a.usd", tets=True)
    assert prims(stage) == [TETS, SURFACE]
    # Viewers do not draw tetrahedra.
    assert not UsdGeom.PrimvarsAPI(stage.GetPrimAtPath(TETS)).GetPrimvar("displayColor").HasAuthoredValue()
    assert len(UsdGeom.TetMesh.Get(stage, TETS).GetTetVertexIndicesAttr().Get()) == len(mesh.tets)
    assert drawn(stage).volume == pytest.approx(mesh_volume(mesh), rel=1e-6)
    box = wc.TetForest.box((1, 1, 2), 0.05, 3)
    assert prims(still(simulated(box), tmp_path / "b.usd")) == [TETS, SURFACE]
    boundary = still(simulated(box), tmp_path / "c.usd", tets=False)
    assert prims(boundary) == [SURFACE]
    assert drawn(boundary).is_watertight
    assert drawn(boundary).volume == pytest.approx(0.05**2 * 0.1, rel=1e-6)


def test_several_bodies_are_one_surface(tmp_path):
    sphere, box = ball(), wc.TetForest.box((1, 1, 1), 0.05, 3, origin=(0.2, 0.0, 0.0))
    bodies = [wc.SoftBody(mesh, wc.Isotropic(1e4, 0.4, 1e3), device="cpu") for mesh in (sphere, box)]
    sim = wc.Simulation(bodies, gravity=(0, 0, 0))
    bodies[1].displacements = np.tile([0.0, 0.1, 0.0], (len(box.points), 1))
    parts = drawn(still(sim, tmp_path / "a.usd")).split()
    assert sorted(part.volume for part in parts) == pytest.approx(sorted([mesh_volume(sphere), 0.05**3]), rel=1e-5)
    cube = min(parts, key=lambda part: part.volume)
    np.testing.assert_allclose(cube.bounds, [[0.2, 0.1, 0.0], [0.25, 0.15, 0.05]], atol=1e-7)
    given = [None, sphere_of(0.01, [0.22, 0.02, 0.02], box)]
    parts = drawn(still(sim, tmp_path / "b.usd", surface=given)).split()
    np.testing.assert_allclose(min(parts, key=lambda part: part.volume).centroid, [0.22, 0.12, 0.02], atol=1e-6)


def sphere_of(radius, centre, mesh):
    shape = trimesh.creation.icosphere(2, radius)
    return mesh.bind(shape.vertices + np.asarray(centre), shape.faces)


def test_labels_are_closed_surfaces_that_fill_the_body(tmp_path):
    mesh = core()
    stage = still(simulated(mesh), tmp_path / "a.usd", labels=True)
    assert prims(stage) == ["/SoftBody/core", "/SoftBody/soft_tissue"]
    assert stage.GetPrimAtPath("/SoftBody/soft_tissue").GetDisplayName() == "soft tissue"
    inner, shell = (drawn(stage, path) for path in prims(stage))
    assert inner.is_watertight
    assert shell.is_watertight
    assert inner.volume == pytest.approx(4 / 3 * np.pi * CORE**3, rel=0.1)
    whole = drawn(still(simulated(mesh), tmp_path / "b.usd"))
    assert inner.volume + shell.volume == pytest.approx(whole.volume, rel=1e-5)
    with pytest.raises(wc.InputError, match="labels is True, but the mesh has none"):
        still(simulated(ball()), tmp_path / "c.usd", labels=True)


def test_a_users_surface_goes_along(device, tmp_path):
    """It is finer than the mesh's own, partly outside its tetrahedra; an affine motion is exact on it."""
    mesh = ball(device)
    sim = simulated(mesh, device)
    motion = rotation() @ np.diag([1.1, 0.9, 1.0])
    sim.body.displacements = mesh.points @ (motion.T - np.eye(3))
    shape = trimesh.creation.icosphere(4, 0.0505)
    stage = still(sim, tmp_path / "a.usd", surface=mesh.bind(shape.vertices, shape.faces))
    np.testing.assert_allclose(drawn(stage).vertices, shape.vertices @ motion.T, atol=3e-8)
    small = simulated(wc.TetForest.box((1, 1, 1), 0.05, 0))
    with pytest.raises(wc.InputError, match="bound to nodes 0 to"):
        still(small, tmp_path / "b.usd", surface=ball().surface())
    with pytest.raises(wc.InputError, match="names 2 surfaces"):
        still(sim, tmp_path / "b.usd", surface=[None, None])
    with pytest.raises(wc.InputError, match="surface is a int"):
        still(sim, tmp_path / "b.usd", surface=3)
    assert not (tmp_path / "b.usd").exists()
