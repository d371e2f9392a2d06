"""Recordings of bodies whose meshes follow the motion: each frame shows the current mesh, complete and on time."""

import itertools

import numpy as np
import pytest
from pxr import Usd, UsdGeom
from stages import SURFACE, TETS, assert_whole, edges_meet_in_pairs, faults, prims

import warp_corot as wc
from warp_corot.io.read.meshes import load_tets
from warp_corot.io.write.animate import record

REMESH = wc.OnlineRemesh(refine_above=1.02, simplify_below=1.005, max_level=8)
VOLUME = 4 * 0.05**3


def bar(device="cpu", x=0.0, **material):
    values = {"young": 3e4, "poisson": 0.4, "density": 1000.0} | material
    body = wc.SoftBody(wc.TetForest.box((4, 1, 1), 0.05, 5, origin=(x, 0, 0)), wc.Isotropic(**values), device=device)
    body.fix(body.mesh.points[:, 0] < x + 1e-9)
    return body


def swaying(bodies, remesh=REMESH):
    return wc.Simulation(bodies, integrator=wc.SymplecticEuler(damping=2.0), remesh=remesh)


def core(device):
    """A ball with another label in its middle."""
    inner, outer = wc.Domain.sphere(0.023, device=device), wc.Domain.sphere(0.05, device=device)
    return inner.named("core") | outer.named("shell")


def pulled_ball(domain, device):
    """A ball deformed so fast that its mesh follows."""
    mesh = wc.TetForest.from_domain(domain, 0.05, max_level=5)
    body = wc.SoftBody(mesh, wc.Isotropic(1e4, 0.4, 1e3), device=device)
    body.velocities = mesh.points * [40.0, 0.0, 0.0]
    remesh = wc.OnlineRemesh(refine_above=1.1, simplify_below=1.02, max_level=6, every=2)
    return wc.Simulation(body, gravity=(0, 0, 0), remesh=remesh)


def test_each_frame_shows_the_present_mesh(device, tmp_path):
    sim = swaying(bar(device, young=lambda x: 2e4 + 1e5 * x[:, 0]))
    times, states = [], []

    def look(frame, count):
        times.append(sim.time)
        states.append((sim.body.mesh, sim.body.positions.numpy().copy(), sim.von_mises(), sim.dt))

    done = record(sim, tmp_path / "a.usd", duration=0.3, fps=30, progress=look)
    assert faults(tmp_path / "a.usd") == []
    assert (done.frames, done.steps) == (10, sim.steps)
    assert done.simulated == sim.time
    assert done.elements == [len(mesh.tets) for mesh, *_ in states]
    assert len(set(done.elements)) > 4
    steps = [dt for *_, dt in states]
    assert max(steps) > 1.2 * min(steps)  # frames are on time at any step
    np.testing.assert_allclose(times, np.arange(10) / 30, atol=0.51 * max(steps))
    stage = Usd.Stage.Open(str(tmp_path / "a.usd"))
    primvars = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath(TETS))
    for k, (mesh, x, stress, _) in enumerate(states):
        points, rest, indices = assert_whole(stage, k, VOLUME)
        np.testing.assert_array_equal(points, x)
        np.testing.assert_array_equal(rest, mesh.points.astype(np.float32))
        np.testing.assert_array_equal(np.sort(indices, axis=1), np.sort(mesh.tets, axis=1))
        # On CUDA a node's forces are added in a different order each time.
        np.testing.assert_allclose(primvars.GetPrimvar("vonMises").Get(k), stress, rtol=1e-5)
        held = np.array(primvars.GetPrimvar("fixed").Get(k)) == 1
        np.testing.assert_array_equal(held, mesh.points[:, 0] < 1e-9)
        young = np.array(primvars.GetPrimvar("young").Get(k))
        assert young.min() > 2e4 * (1 - 1e-6)
        assert (young @ mesh.volumes) / VOLUME == pytest.approx(3e4, rel=1e-5)  # its integral does not change
    for k in range(9):
        assert_whole(stage, k + 0.5, VOLUME)
    assert len(load_tets(tmp_path / "a.usd").cells) == done.elements[0]


def test_one_of_two_bodies_is_remeshed(tmp_path):
    sim = swaying([bar(), bar(x=0.3)], [None, REMESH])
    still = sim.bodies[0]
    done = record(sim, tmp_path / "a.usd", duration=0.2, fps=20)
    assert len(set(done.elements)) > 2
    stage = Usd.Stage.Open(str(tmp_path / "a.usd"))
    for k in range(done.frames):
        points, _, indices = assert_whole(stage, k, 2 * VOLUME)
        np.testing.assert_array_equal(np.sort(indices[: still.element_count], axis=1), np.sort(still.mesh.tets, axis=1))
    np.testing.assert_array_equal(points[: still.node_count], still.positions.numpy())


def test_a_recording_continues_after_the_mesh_has_changed(tmp_path):
    sim = swaying(bar())
    surface = sim.body.mesh.surface()
    sim.advance(0.1)
    count, steps = sim.body.element_count, sim.steps
    assert count != 4 * 6 << 5
    done = record(sim, tmp_path / "a.usd", duration=0.1, fps=20)
    assert done.elements[0] == count
    assert done.steps == sim.steps - steps
    # A surface that was bound to a former mesh is bound to the current one.
    record(sim, tmp_path / "b.usd", duration=0.05, fps=20, surface=surface)
    stage = Usd.Stage.Open(str(tmp_path / "b.usd"))
    drawn = UsdGeom.Mesh.Get(stage, SURFACE)
    own = {tuple(x) for x in sim.body.positions.numpy()}
    corners = surface.points[:, 0] > 0.2 - 1e-9
    corners &= np.isin(surface.points[:, 1:], (0.0, 0.05)).all(axis=1)
    assert corners.sum() == 4
    assert {tuple(x) for x in np.array(drawn.GetPointsAttr().Get(1))[corners]} <= own


@pytest.mark.parametrize("labels", [False, True], ids=["whole", "labels"])
def test_smooth_surfaces_stay_whole(device, tmp_path, labels):
    domain = core(device)
    sim = pulled_ball(domain, device)
    body = sim.body
    first = {"core": None, "shell": None} if labels else {"surface": body.mesh.surface()}
    done = record(sim, tmp_path / "a.usd", duration=0.03, fps=400, labels=labels)
    assert len(set(done.elements)) > 2
    assert faults(tmp_path / "a.usd") == []
    stage = Usd.Stage.Open(str(tmp_path / "a.usd"))
    assert sorted(path.split("/")[-1] for path in prims(stage)) == sorted(first)
    for name in first:
        drawn = UsdGeom.Mesh.Get(stage, f"/SoftBody/{name}")
        assert drawn.GetFaceVertexIndicesAttr().GetTimeSamples() == []
        triangles = np.array(drawn.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
        assert edges_meet_in_pairs(triangles)
        frames = [np.array(drawn.GetPointsAttr().Get(k), float) for k in range(done.frames)]
        assert {len(x) for x in frames} == {triangles.max() + 1}
        for x in frames:
            assert np.isfinite(x).all()
        # No point jumps when the mesh changes: none moves much faster than the fastest end at first, 2 m/s.
        for before, after in itertools.pairwise(frames):
            assert np.linalg.norm(after - before, axis=1).max() < 1.2 * 2.0 / 400
        volumes = [np.linalg.det(x[triangles]).sum() / 6.0 for x in frames]
        assert min(volumes) > 0.5 * volumes[0]


def test_contact_is_in_every_frame_of_a_mesh_that_changes(device, tmp_path):
    """Forces on the nodes of two bodies add up to what the ball and the ground feel, whatever the mesh is."""
    low, high = (
        wc.SoftBody(
            wc.TetForest.box((2, 2, 1), 0.02, 3, origin=(0.0, 0.0, z)), wc.Isotropic(5e3, 0.4, 1e3), device=device
        )
        for z in (0.0, 0.0205)
    )
    ball = wc.Tool(wc.Sphere(0.012))
    ball.follow([0.0, 0.1], [(0.02, 0.02, 0.0526), (0.02, 0.02, 0.046)])
    sim = wc.Simulation(
        [low, high],
        obstacles=[wc.Tool(wc.Ground()), ball],
        gravity=(0.0, 0.0, -9.81),
        integrator=wc.SymplecticEuler(damping=20.0, viscosity=2e-3),
        remesh=wc.OnlineRemesh(every=32, max_level=5, refine_above=1.02, simplify_below=1.005),
    )
    done = wc.record(sim, tmp_path / "a.usda", duration=0.12, fps=50)
    assert len(set(done.elements)) > 1
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    primvars = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/SoftBody/tetrahedra"))
    felt = [stage.GetPrimAtPath(f"/SoftBody/obstacles/tool_{k}").GetAttribute("contact:force") for k in (1, 2)]
    for code in range(done.frames):
        forces = np.array(primvars.GetPrimvar("contactForce").Get(code), float)
        points = UsdGeom.TetMesh(primvars.GetPrim()).GetPointsAttr().Get(code)
        assert len(forces) == len(points) == len(primvars.GetPrimvar("contactPressure").Get(code))
        total = forces.sum(axis=0) + sum(np.array(each.Get(code)) for each in felt)
        np.testing.assert_allclose(total, 0.0, atol=1e-4)
    assert np.abs(forces).max() > 0.01
