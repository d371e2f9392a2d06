"""Initial states of scenes: defaults for what a stage does not define, and warnings before anything moves."""

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, UsdShade, Vt
from scene_stages import CELL, SIM, StageMaker, StageOptions, StageSimulation, simulated, wc

from warp_corot.cli import main
from warp_corot.io.read.usd.scene import open_scene
from warp_corot.newton.stages.stage import StageModel

VOLUME = 12 * CELL**3


def parts(path, **options):
    """The model of a stage, without a solver."""
    return StageModel(open_scene(path), StageOptions(**options), "cpu")


def notes(path, **options) -> str:
    return "\n".join(parts(path, **options).notes)


def block(path, change=None, material=True, marked=True, ground=True, at=(-0.1, -0.1, 0.0), **options):
    made = StageMaker(path, **options)
    mesh = made.block(at=at, marked=marked)
    if material:
        made.material(mesh)
    if ground:
        made.ground()
    if change is not None:
        change(made, mesh)
    return made.save()


def bind(made, mesh, api=True, **values):
    """Bind a material with only some values, in the stage's units."""
    material = UsdShade.Material.Define(made.stage, "/Materials/Part").GetPrim()
    if api:
        material.AddAppliedSchema("PhysicsVolumeDeformableMaterialAPI")
    for name, value in values.items():
        material.CreateAttribute(f"physics:{name}", Sdf.ValueTypeNames.Float).Set(value)
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(UsdShade.Material(material), materialPurpose="physics")


class TestMaterials:
    @pytest.mark.parametrize("marked", [True, False])
    @pytest.mark.parametrize("form", [{}, {"metres": 0.01, "kilograms": 0.001}])
    def test_options_fill_in_what_the_stage_does_not_define(self, tmp_path, marked, form):
        """For any TetMesh, in any units; the mass is the density times the volume."""
        path = block(tmp_path / "in.usda", material=False, marked=marked, **form)
        made = parts(path, young=7e3, poisson=0.25, density=500.0)
        body = made.soft[0]
        assert (body.young, body.poisson, body.density) == pytest.approx((7e3, 0.25, 500.0), rel=1e-4)
        mass = made.model.particle_mass.numpy().astype(float).sum() * made.scene.units.kilograms
        assert mass == pytest.approx(500.0 * VOLUME, rel=1e-4)
        assert "not used" not in "\n".join(made.notes)

    @pytest.mark.parametrize(
        ("values", "said", "wanted"),
        [
            ({}, "E = 1e+06 Pa, nu = 0.3, density 1000 kg/m^3 (--young, --poisson, --density)", (1e6, 0.3, 1000.0)),
            ({"density": 500.0}, "E = 1e+06 Pa, nu = 0.3 (--young, --poisson)", (1e6, 0.3, 500.0)),
            ({"youngsModulus": 2e4}, "nu = 0.3, density 1000 kg/m^3", (2e4, 0.3, 1000.0)),
            ({"youngsModulus": 2e4, "poissonsRatio": 0.1, "density": 0.0}, "density 1000", (2e4, 0.1, 1000.0)),
        ],
    )
    def test_a_material_that_does_not_say_all(self, tmp_path, values, said, wanted):
        made = parts(block(tmp_path / "in.usda", lambda made, mesh: bind(made, mesh, **values), material=False))
        body = made.soft[0]
        assert (body.young, body.poisson, body.density) == pytest.approx(wanted, rel=1e-4)
        assert said in made.notes[0]

    def test_half_of_a_material_and_options(self, tmp_path):
        """Values of the stage are kept, missing ones are the user's."""
        path = block(
            tmp_path / "in.usda", lambda made, mesh: bind(made, mesh, poissonsRatio=0.2), material=False, metres=0.01
        )
        made = parts(path, young=3e4, poisson=0.4, density=800.0)
        body = made.soft[0]
        assert (body.young, body.poisson, body.density) == pytest.approx((3e4, 0.2, 800.0), rel=1e-4)
        assert "--poisson is not used" in "\n".join(made.notes)

    def test_a_body_s_mass_is_said(self, tmp_path):
        def weigh(made, mesh):
            bind(made, mesh, youngsModulus=1e5, poissonsRatio=0.3)
            made.stage.GetPrimAtPath("/World/Soft").CreateAttribute("physics:mass", Sdf.ValueTypeNames.Float).Set(3.0)

        made = parts(block(tmp_path / "in.usda", weigh, material=False), density=50.0)
        assert made.model.particle_mass.numpy().sum() == pytest.approx(3.0, rel=1e-5)
        assert "density" not in made.notes[0].replace("--density is not used", "")

    @pytest.mark.filterwarnings("ignore:.*treating it as unauthored")
    def test_invalid_values_count_as_missing(self, tmp_path):
        """Newton treats them as missing; the substitutes are reported."""

        def spoil(made, mesh):
            bind(made, mesh, youngsModulus=-1e5, poissonsRatio=-1.0, density=-5.0)

        made = parts(block(tmp_path / "in.usda", spoil, material=False))
        assert "E = 1e+06 Pa, nu = 0.3, density 1000 kg/m^3" in made.notes[0]


class TestFriction:
    @pytest.mark.parametrize(("soft", "ground"), [(0.0, 0.0), (0.2, 0.4)])
    def test_a_body_slides_by_the_mean_of_both(self, tmp_path, soft, ground):
        """Pulled sideways by s g, it gains s g - mu g a second: it slides without tipping over."""

        def change(made, mesh):
            bind(made, mesh, youngsModulus=2e5, poissonsRatio=0.0, density=1000.0, dynamicFriction=soft)
            floor = UsdShade.Material.Define(made.stage, "/Materials/Floor")
            UsdPhysics.MaterialAPI.Apply(floor.GetPrim()).CreateDynamicFrictionAttr(ground)
            prim = made.stage.GetPrimAtPath("/Ground")
            UsdShade.MaterialBindingAPI.Apply(prim).Bind(floor, materialPurpose="physics")

        path = block(tmp_path / "in.usda", change, material=False)
        options = StageOptions(gravity=(4.905, 0.0, -9.81), viscosity=5e-3)
        sim = StageSimulation(path, device="cpu", options=options)
        speeds = []
        for _ in range(12):
            sim.advance()
            masses = sim.parts.model.particle_mass.numpy()
            speeds.append(np.average(sim.show().velocities[0][:, 0], weights=masses))
        gained = (speeds[-1] - speeds[3]) * 24 / 8
        assert gained == pytest.approx((0.5 - 0.5 * (soft + ground)) * 9.81, rel=0.06)

    def test_friction_of_several_bodies_is_one(self, tmp_path):
        def change(made, mesh):
            bind(made, mesh, dynamicFriction=0.2)
            made.material(made.block(body="/World/Other", at=(0.5, 0.0, 0.0)))

        made = parts(block(tmp_path / "in.usda", change, material=False))
        assert made.model.soft_contact_mu == pytest.approx(0.2)
        assert "soft bodies have one friction, the mean of those given: 0.2" in made.notes
        assert parts(block(tmp_path / "other.usda")).model.soft_contact_mu == 0.5


class TestGravity:
    @pytest.mark.parametrize("metres", [1.0, 0.01])
    @pytest.mark.parametrize("magnitude", [-1.0, -9.81, float("-inf")])
    def test_negative_ones_are_the_earths(self, tmp_path, metres, magnitude):
        """As defined in UsdPhysics."""

        def change(made, _):
            scene = UsdPhysics.Scene.Get(made.stage, "/physicsScene")
            scene.GetGravityMagnitudeAttr().Set(magnitude)

        made = parts(block(tmp_path / "in.usda", change, metres=metres))
        np.testing.assert_allclose(made.model.gravity.numpy()[-1] * metres, [0.0, 0.0, -9.81], rtol=1e-5)

    def test_a_direction_of_any_length(self, tmp_path):
        def change(made, _):
            scene = UsdPhysics.Scene.Get(made.stage, "/physicsScene")
            scene.GetGravityDirectionAttr().Set(Gf.Vec3f(3.0, 0.0, 4.0))
            scene.GetGravityMagnitudeAttr().Set(2.0)

        made = parts(block(tmp_path / "in.usda", change))
        np.testing.assert_allclose(made.model.gravity.numpy()[-1], [1.2, 0.0, 1.6], rtol=1e-5)

    def test_the_first_scene_counts(self, tmp_path):
        def change(made, _):
            UsdPhysics.Scene.Define(made.stage, "/another").CreateGravityMagnitudeAttr(1.0)

        made = parts(block(tmp_path / "in.usda", change))
        assert made.model.gravity.numpy()[-1][2] == pytest.approx(-9.81)
        assert "gravity is from the first of 2 physics scenes, /physicsScene" in "\n".join(made.notes)


class TestLyingInOneAnother:
    @pytest.mark.parametrize(("form", "axis"), [({}, "z"), ({"metres": 0.001, "up": "Y"}, "y")])
    @pytest.mark.parametrize("height", [0.15, 0.5])
    def test_a_ground_that_cuts_a_body(self, tmp_path, form, axis, height):
        """It is refused, with the highest valid value; and that value is accepted."""
        path = block(tmp_path / "in.usda", ground=False, at=(-0.1, -0.1, 0.02), **form)
        with pytest.raises(wc.InputError, match=rf"ground is {height:g} m; {SIM} .* {axis} = 0\.02 m.*at most 0\.02"):
            parts(path, ground=height)
        # A ground slightly too high for the edge of a tetrahedron is also refused.
        assert all(parts(path, ground=free).ground is not None for free in (0.02, 0.024))
        with pytest.raises(wc.InputError, match=r"at most -0\.03, or"):
            parts(path, ground=0.0, radius=0.05)

    def test_points_that_are_held_may_be_below(self, tmp_path):
        path = block(tmp_path / "in.usda", ground=False)
        assert parts(path, ground=0.05, fix="z < 0.06").ground is not None

    @pytest.mark.parametrize("what", ["ground", "box"])
    def test_a_body_in_a_collider(self, tmp_path, what):
        """The warning names it and the depth of its deepest point; mere contact is not reported."""

        def change(made, _):
            # Rotated and moved, so that contacts have their own frame.
            cube = made.box(at=(0.05, -0.1, 0.3), size=0.28, mass=50.0)
            UsdGeom.Xformable(cube).SetXformOpOrder([])
            cube.ClearXformOpOrder()
            cube.AddTranslateOp(opSuffix="its").Set(Gf.Vec3d(0.1, 0.0, 0.3))
            cube.AddRotateZOp().Set(90.0)
            cube.AddScaleOp(opSuffix="its").Set(Gf.Vec3f(0.14))

        if what == "ground":
            path, match = block(tmp_path / "in.usda", at=(-0.1, -0.1, -0.15)), r"0\.15 m deep in /Ground,"
        else:
            path, match = block(tmp_path / "in.usda", change), r"0\.14 m deep in /World/Box,"
        with pytest.warns(UserWarning, match=rf"{SIM} begins {match} and contact will throw it out"):
            StageSimulation(path, device="cpu")

    @pytest.mark.filterwarnings("error:.*deep in")
    def test_mere_contact_is_not_reported(self, tmp_path):
        sim = simulated(block(tmp_path / "in.usda"), 1)
        assert "deep" not in "\n".join(sim.parts.notes)

    def test_bodies_with_a_radius_rest_at_that_distance(self, tmp_path):
        """The sag of the springs at the base is less than a fiftieth of an edge."""
        path = block(tmp_path / "in.usda", ground=False)
        sim = simulated(path, 36, options=StageOptions(radius=0.04, viscosity=5e-3))
        assert sim.parts.ground[0, 2] == pytest.approx(-0.04, abs=1e-6)
        assert -0.02 * CELL < sim.show().positions[0][:, 2].min() < 0.0


class TestNotes:
    def test_units_that_are_not_given(self, tmp_path):
        path = block(tmp_path / "in.usda", lambda made, _: made.stage.ClearMetadata("metersPerUnit"))
        assert "no metersPerUnit: by USD's default its unit is a centimetre" in notes(path)
        assert "metersPerUnit" not in notes(block(tmp_path / "other.usda"))

    def test_animation_that_is_stopped(self, tmp_path):
        def animate(made, mesh):
            cube = made.box(at=(0.0, 0.0, 0.6))
            UsdPhysics.RigidBodyAPI(cube.GetPrim()).CreateKinematicEnabledAttr(True)
            camera = UsdGeom.Camera.Define(made.stage, "/Camera")
            camera.AddTranslateOp()
            for prim in (cube, camera):
                move = prim.GetOrderedXformOps()[0]
                for frame in (1, 9):
                    move.Set(Gf.Vec3d(0.0, 0.0, 0.6 + frame), frame)
            points = mesh.GetPointsAttr()
            rest = points.Get()
            points.Clear()
            for frame in (3, 6):
                points.Set(Vt.Vec3fArray([p + Gf.Vec3f(0.0, 0.0, 0.1 * frame) for p in rest]), frame)

        made = parts(block(tmp_path / "in.usda", animate))
        assert "bodies and colliders do not follow the stage's animation, which is stopped: " in "\n".join(made.notes)
        assert sorted(made.scene.stopped) == ["/World/Box", SIM]
        assert made.model.particle_q.numpy()[:, 2].min() == pytest.approx(0.3, abs=1e-6)

    def test_patterns_of_point_instancers(self, tmp_path):
        def change(made, _):
            instancer = UsdGeom.PointInstancer.Define(made.stage, "/World/Many")
            made.block(body="/World/Many/Pattern", at=(1.0, 0.0, 0.0))
            instancer.CreatePrototypesRel().SetTargets(["/World/Many/Pattern"])
            instancer.CreatePositionsAttr([(0, 0, 2)])
            instancer.CreateProtoIndicesAttr([0])

        made = parts(block(tmp_path / "in.usda", change))
        assert [body.prim.path for body in made.soft] == [SIM]
        assert made.model.tet_count == 72
        assert "prototypes of point instancers are not simulated: /World/Many/Pattern/sim" in made.notes

    @pytest.mark.filterwarnings("error:.*in no tetrahedron")
    def test_points_in_no_tetrahedron(self, tmp_path):
        """They do not lower the ground, and are not reported as dropped by Newton."""

        def change(_, mesh):
            mesh.GetPointsAttr().Set(Vt.Vec3fArray([*mesh.GetPointsAttr().Get(), Gf.Vec3f(0.0, 0.0, -9.0)]))

        sim = simulated(block(tmp_path / "in.usda", change, ground=False), 2)
        assert sim.parts.ground[0, 2] == pytest.approx(0.0, abs=1e-6)
        assert f"{SIM}: points in no tetrahedron, which stay where they are: 1" in sim.parts.notes
        np.testing.assert_array_equal(sim.show().positions[0][36], sim.parts.model.particle_q.numpy()[36])

    def test_soft_bodies_that_do_not_touch_one_another(self, tmp_path):
        def change(made, _):
            made.material(made.block(body="/World/Other", at=(0.5, 0.0, 0.1)))

        two = block(tmp_path / "in.usda", change)
        assert "not one another" not in notes(two)
        assert "not one another" in notes(two, soft_contact=False)
        assert "not one another" not in notes(block(tmp_path / "other.usda"), soft_contact=False)

    def test_collision_that_cannot_be_disabled(self, tmp_path):
        def change(_, mesh):
            mesh.GetPrim().CreateAttribute("physics:collisionEnabled", Sdf.ValueTypeNames.Bool).Set(False)

        assert f"{SIM} collides, though its collision is disabled" in notes(block(tmp_path / "in.usda", change))
        assert "disabled" not in notes(block(tmp_path / "other.usda"))

    def test_rigid_bodies_that_are_disabled_stay(self, tmp_path):
        def change(made, _):
            cube = made.box(at=(0.0, 0.0, -0.2))
            UsdPhysics.RigidBodyAPI(cube.GetPrim()).CreateRigidBodyEnabledAttr(False)

        made = parts(block(tmp_path / "in.usda", change, ground=False))
        assert not made.rigid
        assert made.model.body_count == 0
        assert made.ground is None


def test_a_value_of_an_unknown_type_is_refused(tmp_path):
    made = StageMaker(tmp_path / "in.usda")
    made.material(made.block(at=(-0.1, -0.1, 0.02)))
    made.box(at=(0.02, 0.0, 0.5))
    text = made.save().read_text()
    assert "float physics:mass" in text
    damaged = tmp_path / "damaged.usda"
    damaged.write_text(text.replace("float physics:mass", "oat physics:mass"))
    with pytest.raises(wc.InputError, match=r"damaged\.usda: Newton cannot read it: must be real number"):
        parts(damaged)


def test_no_file_that_the_input_is_made_of_is_written_over(tmp_path, capsys):
    below = block(tmp_path / "below.usda")
    kept = below.read_bytes()
    top = Usd.Stage.CreateNew(str(tmp_path / "top.usda"))
    UsdGeom.SetStageMetersPerUnit(top, 1.0)
    UsdGeom.SetStageUpAxis(top, "Z")
    top.DefinePrim("/World").GetReferences().AddReference("./below.usda")
    top.Save()
    assert main(["scene", str(tmp_path / "top.usda"), "-o", str(below), "--device", "cpu"]) == 2
    err = capsys.readouterr().err
    assert "below.usda: is part of the input" in err
    assert "error" in err.splitlines()[-1]
    assert below.read_bytes() == kept
    assert sorted(file.name for file in tmp_path.iterdir()) == ["below.usda", "top.usda"]
