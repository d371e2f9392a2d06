"""Stages stepped through Newton's reader: correct motion in any units."""

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, Vt
from scene_stages import (
    CELL,
    DENSITY,
    SIM,
    YOUNG,
    StageMaker,
    StageOptions,
    StageSimulation,
    simulated,
    standing,
    written,
)
from scipy.linalg import polar

from warp_corot.mesh.topology import signed_volumes

G = 9.81
HEIGHT, AREA = 3 * CELL, (2 * CELL) ** 2


@pytest.fixture(scope="module")
def at_rest(tmp_path_factory):
    """A block that was dropped from 2 cm and has come to rest."""
    path = standing(tmp_path_factory.mktemp("stages") / "stage.usda", height=0.02)
    return simulated(path, 96, options=StageOptions(viscosity=2e-3))


class TestAtRest:
    def test_it_carries_its_weight(self, at_rest):
        """Contact is a spring at each point of the base: together they balance the weight.

        Each gives way with its point, by 1.5 dt^2 times the force over the mass.
        """
        state, model = at_rest.show(), at_rest.parts.model
        weight = DENSITY * AREA * HEIGHT * G
        assert np.abs(state.velocities[0]).max() < 1e-3
        depth = np.maximum(-state.positions[0][:, 2], 0.0)
        stiffness = 0.5 * (model.soft_contact_ke + model.shape_material_ke.numpy()[0])
        springs = 1.0 / (1.0 / stiffness + 1.5 * at_rest.dt**2 * model.particle_inv_mass.numpy())
        assert springs @ depth == pytest.approx(weight, rel=1e-3)
        assert 0.0 < depth.max() < 0.02 * CELL

    def test_stress_is_that_of_its_own_weight(self, at_rest):
        """Without Poisson's effect it is rho g (H - z) in every tetrahedron, on average half of that at the base."""
        state = at_rest.show()
        tets = at_rest.scene.tets[0].tets
        depth = HEIGHT - at_rest.parts.model.particle_q.numpy()[tets].mean(axis=1)[:, 2] + 0.02
        wanted = DENSITY * G * depth
        stress = state.von_mises[0]
        assert stress.mean() == pytest.approx(0.5 * DENSITY * G * HEIGHT, rel=0.03)
        slope = np.polyfit(depth, stress, 1)[0]
        assert slope == pytest.approx(DENSITY * G, rel=0.1)
        base = depth > HEIGHT - CELL
        assert stress[base].mean() == pytest.approx(wanted[base].mean(), rel=0.05)

    def test_it_is_shorter_by_what_its_weight_makes_it(self, at_rest):
        rest, x = (a[:, 2] for a in (at_rest.parts.model.particle_q.numpy(), at_rest.show().positions[0]))
        top, base = (x[np.abs(rest - level) < 1e-6].mean() for level in (rest.max(), rest.min()))
        sag = HEIGHT - (top - base)
        assert sag == pytest.approx(0.5 * DENSITY * G * HEIGHT**2 / YOUNG, rel=0.1)


@pytest.mark.parametrize("metres", [1.0, pytest.param(0.01, marks=pytest.mark.slow)])
def test_a_soft_body_falls_on_another(device, tmp_path, metres):
    """It stays there, in any units; without contact between them, it falls to the ground."""
    made = StageMaker(tmp_path / "stage.usda", metres=metres)
    made.material(made.block(cells=(3, 3, 1)))
    made.material(
        made.block(body="/World/Other", cells=(1, 1, 1), at=(0.07, 0.13, CELL + 0.02)), path="/Materials/Other"
    )
    made.ground()
    path = made.save()
    lowest = {}
    for touch in (True, False):
        sim = simulated(path, 12, device, options=StageOptions(viscosity=5e-3, soft_contact=touch))
        lowest[touch] = metres * sim.show().positions[1][:, 2].min()
    assert lowest[True] > 0.9 * CELL
    assert lowest[False] < 0.5 * CELL


def test_stresses_are_those_of_the_positions(device, tmp_path):
    """Hooke's stress of the strain without the rotation, by SciPy's polar decomposition."""
    made = StageMaker(tmp_path / "stage.usda", metres=0.01)
    young = 4e4
    made.material(made.block(), young=young, poisson=0.3)
    made.box(at=(0.15, 0.1, 0.45), mass=4.0)
    made.ground()
    sim = simulated(made.save(), 5, device)
    state, tets = sim.show(), sim.scene.tets[0].tets
    rest, x = (a.astype(float)[tets] for a in (sim.parts.model.particle_q.numpy(), state.positions[0]))
    edges = [np.swapaxes(a[:, 1:] - a[:, :1], 1, 2) for a in (rest, x)]
    f = edges[1] @ np.linalg.inv(edges[0])
    mu, lam = young / 2.6, young * 0.3 / (1.3 * 0.4)
    wanted = []
    for one in f:
        strain = polar(one)[1] - np.eye(3)
        stress = 2 * mu * strain + lam * np.trace(strain) * np.eye(3)
        deviator = stress - np.trace(stress) / 3 * np.eye(3)
        wanted.append(np.sqrt(1.5) * np.linalg.norm(deviator))
    assert np.abs(f - np.eye(3)).max() > 0.05
    np.testing.assert_allclose(state.von_mises[0], wanted, rtol=2e-3, atol=2e-3 * max(wanted))


@pytest.mark.parametrize(
    "form",
    [
        *(pytest.param(form, marks=pytest.mark.slow) for form in ({"metres": 0.01}, {"up": "Y"})),
        {"metres": 0.001, "kilograms": 0.001, "up": "Y"},
    ],
)
def test_units_and_axes_are_those_of_the_stage(device, tmp_path, form):
    """A block that is dropped and hit by a box moves the same in any units of the stage."""
    ends = []
    for name, options in (("one.usda", {}), ("other.usda", form)):
        made = StageMaker(tmp_path / name, **options)
        made.material(made.block(at=(-0.1, -0.1, 0.02)))
        made.box(at=(0.02, 0.0, 0.5))
        made.ground()
        sim = simulated(made.save(), 12, device)
        state = sim.show()
        assert len(state.bodies) == 1
        back = [2, 0, 1] if options.get("up") == "Y" else [0, 1, 2]
        x, box = (sim.scene.units.metres * a[:, back] for a in (state.positions[0], state.bodies[:, 3, :3]))
        ends.append((x, box, state.von_mises[0]))
    (x, box, stress), (other_x, other_box, other_stress) = ends
    assert x[:, 2].max() < HEIGHT + 0.01
    assert box[0, 2] < 0.45
    np.testing.assert_allclose(other_x, x, atol=1e-4)
    np.testing.assert_allclose(other_box, box, atol=1e-4)
    np.testing.assert_allclose(other_stress, stress, atol=0.02 * stress.max())


def test_a_fall_is_free(device, tmp_path):
    """Viscosity does not slow a fall: frames show g t^2 / 2, and the velocity g t."""
    sim = simulated(standing(tmp_path / "stage.usda", height=1.0), 6, device)
    state, t = sim.show(), sim.time
    assert t == pytest.approx(0.25)
    fallen = sim.parts.model.particle_q.numpy()[:, 2] - state.positions[0][:, 2]
    np.testing.assert_allclose(fallen, 0.5 * G * t * (t + sim.dt), rtol=1e-3)
    np.testing.assert_allclose(state.velocities[0][:, 2], -G * t, rtol=1e-3)
    assert state.von_mises[0].max() < 1e-3 * YOUNG


def test_gravity_of_the_scene_and_of_the_user(tmp_path):
    made = StageMaker(tmp_path / "moon.usda")
    made.material(made.block(at=(0.0, 0.0, 1.0)))
    made.ground()
    made.stage.GetPrimAtPath("/physicsScene").GetAttribute("physics:gravityMagnitude").Set(1.62)
    path = made.save()
    assert simulated(path, 2).show().velocities[0][0, 2] == pytest.approx(-1.62 / 12, rel=1e-3)
    sim = simulated(path, 2, options=StageOptions(gravity=(0.0, 3.0, 0.0)))
    np.testing.assert_allclose(sim.show().velocities[0], [[0.0, 0.25, 0.0]] * 36, atol=1e-4)


def test_materials_of_older_schemas(tmp_path):
    made = StageMaker(tmp_path / "stage.usda")
    mesh = made.block(marked=False)
    made.ground()
    made.material(mesh)
    material = made.stage.GetPrimAtPath("/Materials/Soft")
    for name, value in (("youngsModulus", 7e4), ("poissonsRatio", 0.25), ("density", 700.0)):
        material.RemoveProperty(f"physics:{name}")
        material.CreateAttribute(f"omniphysics:{name}", Sdf.ValueTypeNames.Float).Set(value)
    body = StageSimulation(made.save(), device="cpu").parts.soft[0]
    assert body.given
    assert (body.young, body.poisson, body.density) == pytest.approx((7e4, 0.25, 700.0), rel=1e-4)


def test_missing_values_are_chosen_and_reported(tmp_path):
    made = StageMaker(tmp_path / "stage.usda", scene=False, metres=0.01)
    made.block(marked=False)
    sim = simulated(made.save(), 24)
    body, notes = sim.parts.soft[0], " ".join(sim.parts.notes)
    assert not body.given
    assert body.density == pytest.approx(1000.0, rel=1e-4)
    assert body.poisson == pytest.approx(0.45, rel=1e-4)
    assert body.young == pytest.approx(20 * 1000.0 * 9.81 * HEIGHT, rel=0.02)
    assert "no physics material" in notes
    assert "E = 59000 Pa" in notes
    assert "there is a ground at z = 0 m" in notes
    x = sim.show().positions[0][:, 2]
    assert -0.02 * HEIGHT < 0.01 * x.min() < 0.0


@pytest.mark.parametrize(("kinematic", "height"), [(False, -0.3), (True, None)])
def test_there_is_a_ground_unless_a_collider_stays(tmp_path, kinematic, height):
    """A block on a falling box needs a ground below the box; a fixed box supports it."""
    made = StageMaker(tmp_path / "stage.usda", metres=0.01, up="Y")
    made.material(made.block(at=(-0.1, -0.1, 0.0)))
    cube = made.box(at=(0.0, 0.0, -0.2))
    UsdPhysics.RigidBodyAPI(cube.GetPrim()).CreateKinematicEnabledAttr(kinematic)
    sim = StageSimulation(made.save(), device="cpu")
    if height is None:
        assert sim.parts.ground is None
    else:
        np.testing.assert_allclose(0.01 * sim.parts.ground[:, 1], height, atol=1e-6)


def test_a_box_on_joints_stays(tmp_path):
    made = StageMaker(tmp_path / "stage.usda")
    made.material(made.block(at=(-0.1, -0.1, 0.0)))
    cube = made.box(at=(0.0, 0.0, -0.2))
    joint = UsdPhysics.FixedJoint.Define(made.stage, "/World/Joint")
    joint.CreateBody1Rel().SetTargets([cube.GetPath()])
    assert StageSimulation(made.save(), device="cpu").parts.ground is None


def test_an_expression_that_holds_nothing_is_reported(tmp_path):
    path = standing(tmp_path / "stage.usda")
    notes = [
        StageSimulation(path, device="cpu", options=StageOptions(fix=f)).parts.notes for f in ("z > 9", "z < 0.01")
    ]
    assert "no point is held by 'z > 9'" in " ".join(notes[0])
    assert "no point" not in " ".join(notes[1])


def test_options_where_a_stage_says_nothing(tmp_path):
    made = StageMaker(tmp_path / "stage.usda")
    made.block(marked=False)
    options = StageOptions(young=3e4, poisson=0.2, density=500.0, ground="none", fix="z > zmax - 1e-6")
    sim = simulated(made.save(), 6, options=options)
    body = sim.parts.soft[0]
    assert (body.young, body.poisson, body.density) == pytest.approx((3e4, 0.2, 500.0), rel=1e-4)
    rest, x = sim.parts.model.particle_q.numpy(), sim.show().positions[0]
    held = rest[:, 2] > HEIGHT - 1e-6
    assert held.sum() == 9
    np.testing.assert_array_equal(x[held], rest[held])
    assert x[~held, 2].min() < -1e-3


def test_wrongly_wound_tetrahedra_are_turned_round(tmp_path):
    ends = []
    for name in ("right.usda", "wrong.usda"):
        made = StageMaker(tmp_path / name)
        mesh = made.block()
        made.material(mesh)
        made.ground()
        if name == "wrong.usda":
            tets = np.array(mesh.GetTetVertexIndicesAttr().Get())
            tets[:5] = tets[:5][:, [1, 0, 2, 3]]
            mesh.GetTetVertexIndicesAttr().Set(Vt.Vec4iArray.FromNumpy(tets))
            with pytest.warns(UserWarning, match="5 tetrahedra are wound wrongly and have been repaired"):
                sim = written(made.save(), tmp_path / "out.usda", 6)
        else:
            sim = simulated(made.save(), 6)
        ends.append(sim.show())
    np.testing.assert_allclose(ends[1].positions[0], ends[0].positions[0], atol=1e-6)
    assert len(ends[1].von_mises[0]) == 72
    stage = Usd.Stage.Open(str(tmp_path / "out.usda"))
    drawn = UsdGeom.TetMesh.Get(stage, SIM)
    points, tets = (np.array(a.Get()) for a in (drawn.GetPointsAttr(), drawn.GetTetVertexIndicesAttr()))
    assert signed_volumes(points, tets).min() > 0


@pytest.mark.parametrize("mirror", ["orientation", "transform"])
def test_mirrored_prims_stay_as_they_are(tmp_path, mirror):
    """Left-handed tetrahedra, and right-handed ones under a mirroring transform, need no repair."""
    made = StageMaker(tmp_path / "stage.usda")
    mesh = made.block(at=(0.0, 0.0, 0.0))
    made.material(mesh)
    made.ground()
    if mirror == "orientation":
        tets = np.array(mesh.GetTetVertexIndicesAttr().Get())[:, [0, 1, 3, 2]]
        mesh.GetTetVertexIndicesAttr().Set(Vt.Vec4iArray.FromNumpy(np.ascontiguousarray(tets)))
        mesh.CreateOrientationAttr(UsdGeom.Tokens.leftHanded)
    else:
        UsdGeom.Xformable(mesh).AddScaleOp().Set(Gf.Vec3f(-1.0, 1.0, 1.0))
    sim = simulated(made.save(), 6)
    assert sim.scene.tets[0].repaired == 0
    assert sim.parts.model.tet_count == 72
    x = sim.show().positions[0]
    assert x[:, 2].max() - x[:, 2].min() == pytest.approx(HEIGHT, rel=0.03)


def _attach(made, to, points):
    prim = made.stage.DefinePrim("/World/attachment", "PhysicsAttachment")
    types = Sdf.ValueTypeNames
    prim.CreateRelationship("physics:src0").SetTargets([SIM])
    prim.CreateRelationship("physics:src1").SetTargets([to])
    prim.CreateAttribute("physics:type0", types.Token).Set("point")
    prim.CreateAttribute("physics:type1", types.Token).Set("xform")
    prim.CreateAttribute("physics:indices0", types.IntArray).Set([int(p) for p in points])
    matrix = UsdGeom.XformCache().GetLocalToWorldTransform(made.stage.GetPrimAtPath(to)).GetInverse()
    mesh = UsdGeom.TetMesh.Get(made.stage, SIM)
    world = UsdGeom.XformCache().GetLocalToWorldTransform(mesh.GetPrim())
    coords = [Gf.Vec3f(matrix.Transform(world.Transform(Gf.Vec3d(p)))) for p in mesh.GetPointsAttr().Get()]
    prim.CreateAttribute("physics:coords1", types.Vector3fArray).Set([coords[p] for p in points])


def _top(made):
    points = np.array(UsdGeom.TetMesh.Get(made.stage, SIM).GetPointsAttr().Get())
    return np.flatnonzero(points[:, 2] > points[:, 2].max() - 1e-6)


def test_attachments_to_the_world_hold_points(tmp_path):
    made = StageMaker(tmp_path / "stage.usda")
    made.material(made.block(at=(0.0, 0.0, 1.0)))
    top = _top(made)
    UsdGeom.Xform.Define(made.stage, "/World/Hook")
    _attach(made, "/World/Hook", top)
    sim = simulated(made.save(), 48)
    rest, x = sim.parts.model.particle_q.numpy(), sim.show().positions[0]
    np.testing.assert_array_equal(x[top], rest[top])
    assert sim.parts.ground is None
    lowest = rest[:, 2].min() - x[:, 2].min()
    assert lowest == pytest.approx(0.5 * DENSITY * G * HEIGHT**2 / YOUNG, rel=0.3)


def test_a_hanging_bar_lengthens_by_its_weight(tmp_path):
    """rho g L^2 / (2 E), exact for linear tetrahedra at zero Poisson's ratio."""
    made = StageMaker(tmp_path / "stage.usda", metres=0.01)
    made.material(made.block(cells=(1, 1, 6), at=(0.0, 0.0, 1.0)), young=2e6)
    options = StageOptions(fix="z > zmax - 1e-4", viscosity=0.01)
    sim = simulated(made.save(), 36, options=options)
    rest, x = (0.01 * a[:, 2].astype(float) for a in (sim.parts.model.particle_q.numpy(), sim.show().positions[0]))
    lowest = rest < rest.min() + 1e-6
    length = 6 * CELL
    assert (rest - x)[lowest].mean() == pytest.approx(0.5 * DENSITY * G * length**2 / 2e6, rel=0.02)
    assert sim.show().von_mises[0].mean() == pytest.approx(0.5 * DENSITY * G * length, rel=0.02)


def test_attachments_to_a_rigid_body_carry_it(tmp_path):
    """A box hangs from a block that hangs from the world: the stress is the box's weight over the area."""
    made = StageMaker(tmp_path / "stage.usda")
    made.material(made.block(at=(0.0, 0.0, 1.0)))
    made.box(at=(0.1, 0.1, 0.9), mass=20.0)
    points = np.array(UsdGeom.TetMesh.Get(made.stage, SIM).GetPointsAttr().Get())
    _attach(made, "/World/Box", np.flatnonzero(points[:, 2] < points[:, 2].min() + 1e-6))
    options = StageOptions(fix="z > zmax - 1e-6", viscosity=5e-3)
    sim = simulated(made.save(), 72, options=options)
    state = sim.show()
    drop = 0.9 - state.bodies[0, 3, 2]
    weight = 20.0 * G + 0.5 * DENSITY * AREA * HEIGHT * G
    assert drop > weight * HEIGHT / (YOUNG * AREA)
    assert drop < 2.0 * weight * HEIGHT / (YOUNG * AREA)
    assert state.von_mises[0].mean() == pytest.approx(weight / AREA, rel=0.1)


def test_implicit_steps_take_a_stage_to_rest(tmp_path):
    sim = simulated(standing(tmp_path / "stage.usda", height=0.02), 48, integrator="implicit")
    state, model = sim.show(), sim.parts.model
    assert sim.dt == pytest.approx(1 / 72)  # 24 frames a second
    assert sim.solver.solves.unfinished == 0
    assert np.abs(state.velocities[0]).max() < 1e-3
    depth = np.maximum(-state.positions[0][:, 2], 0.0)
    stiffness = 0.5 * (model.soft_contact_ke + model.shape_material_ke.numpy()[0])
    assert stiffness * depth.sum() == pytest.approx(DENSITY * AREA * HEIGHT * G, rel=1e-3)
