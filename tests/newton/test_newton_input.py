"""Bad input of ``add_forest``, ``add_mesh`` and, through Newton's own builder, of the solver: one clear line."""

import numpy as np
import pytest
import warp as wp
from newton_scenes import add_grid, builder, wc, wn
from scipy.spatial.transform import Rotation

NAN = float("nan")
TISSUE = wc.Isotropic(1e4, 0.3, 1000.0)


def forest():
    return wc.TetForest.box((2, 1, 1), 0.2, 1)


def mesh():
    one = forest()
    return wc.TetMesh(one.points, one.tets)


ADDING = [(wn.add_forest, forest), (wn.add_mesh, mesh)]
BAD = [
    ({"rot": (0, 0, 0, 0)}, "rot is .*of length 0; it must be a unit quaternion"),
    ({"rot": (0, 0, 1, 1)}, r"rot is .*of length 1\.414"),
    ({"rot": (0, 0, 0)}, r"rot is \(0, 0, 0\).*; it must be a unit quaternion"),
    ({"rot": (0, 0, NAN, 1)}, "rot is .*of length nan; it must be a unit quaternion"),
    ({"rot": "upright"}, r"rot is 'upright'; it must be numbers, \[4\]"),
    ({"pos": (0, NAN, 0)}, "pos is .*three finite numbers"),
    ({"pos": (0, float("inf"), 0)}, "pos is .*three finite numbers"),
    ({"pos": 1.0}, r"pos is 1.0; it must be three finite numbers \[m\]"),
    ({"pos": None}, "pos is None"),
    ({"pos": [(0, 0), 0]}, "pos is .*three finite numbers"),
    ({"pos": (0, 0, 1e7)}, "pos is .*1 m apart in float32, too coarse"),
    ({"vel": (NAN, 0, 0)}, r"vel is .*three finite numbers \[m/s\]"),
    ({"vel": "fast"}, "vel is 'fast'"),
    ({"k_damp": -1.0}, "k_damp is -1 .*; it must be zero or positive"),
    ({"k_damp": NAN}, "k_damp is nan .*; it must be zero or positive"),
    ({"k_damp": "much"}, "k_damp is 'much'; it must be numbers"),
    ({"k_damp": [1.0, 2.0, 3.0]}, r"k_damp is of shape \(3,\); it must be zero or positive"),
    ({"k_damp": [1.0] * 23 + [-2.0]}, "k_damp is -2 in 23; it must be zero or positive"),
    ({"particle_radius": -0.1}, "particle_radius is -0.1; it must be zero or a positive number"),
    ({"particle_radius": NAN}, "particle_radius is nan"),
    ({"particle_radius": "small"}, "particle_radius is 'small'"),
    ({"particle_radius": [0.1, 0.2]}, "particle_radius is"),
    ({"fixed": [99]}, "node"),
    ({"fixed": [0.5]}, "node"),
]


@pytest.mark.parametrize(("add", "made"), ADDING)
@pytest.mark.parametrize(("options", "message"), BAD)
def test_bad_arguments_are_one_line_and_add_nothing(add, made, options, message):
    to = builder()
    with pytest.raises(wc.InputError, match=message) as said:
        add(to, made(), TISSUE, **options)
    assert "\n" not in str(said.value)
    assert to.particle_count == to.tet_count == to.tri_count == 0


@pytest.mark.parametrize(("add", "made"), ADDING)
def test_what_is_added_is_where_it_is_put(add, made):
    """Against SciPy's rotation of the same quaternion; Warp's types work like tuples."""
    turn, there = Rotation.from_rotvec([0.3, -0.5, 0.8]), np.array([1.0, -2.0, 0.5])
    quaternion = wp.quat(*turn.as_quat().tolist())
    to = builder()
    one = made()
    options = {"vel": wp.vec3(0.0, 1.0, 2.0), "particle_radius": 0, "k_damp": np.arange(24.0)}
    added = add(to, one, TISSUE, pos=wp.vec3(*there.tolist()), rot=quaternion, **options)
    model = to.finalize(device="cpu")
    np.testing.assert_allclose(model.particle_q.numpy(), turn.apply(one.points) + there, atol=1e-6)
    np.testing.assert_array_equal(model.particle_qd.numpy(), [[0.0, 1.0, 2.0]] * len(added.particles))
    np.testing.assert_array_equal(model.particle_radius.numpy(), 0.0)
    np.testing.assert_array_equal(model.tet_materials.numpy().reshape(-1, 3)[:, 2], np.arange(24.0))


def soft_mesh(to, points, tets, label=None):
    to.add_soft_mesh(
        pos=wp.vec3(), rot=wp.quat_identity(), scale=1.0, vel=wp.vec3(), vertices=points.tolist(),
        indices=tets.ravel().tolist(), density=1000.0, k_mu=1e4, k_lambda=1e4, label=label,
    )  # fmt: skip


class TestWhatTheBuilderLeftOut:
    def test_all_tetrahedra(self, device):
        """All are wrongly wound: Newton's builder drops them, and the error names the body and the remedy."""
        one = mesh()
        to = builder()
        soft_mesh(to, one.points, one.tets[:, [1, 0, 2, 3]], "liver")
        model = to.finalize(device=device)
        assert model.tet_count == 0
        with pytest.raises(
            wc.InputError, match=r"1 soft body \(liver\): .*wrongly wound; build with .*add_mesh\("
        ) as said:
            wn.SolverCorotated(model)
        assert "\n" not in str(said.value)
        to = builder()
        wn.add_mesh(to, wc.TetMesh(one.points, np.ascontiguousarray(one.tets[:, [1, 0, 2, 3]])), TISSUE)
        assert wn.SolverCorotated(to.finalize(device=device)).model.tet_count == len(one.tets)

    def test_a_model_without_soft_bodies(self, device):
        to = builder()
        to.add_particle((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 1.0)
        with pytest.raises(wc.InputError, match="the model has no tetrahedra; add some with add_soft_mesh"):
            wn.SolverCorotated(to.finalize(device=device))

    @pytest.mark.filterwarnings("error")
    def test_points_that_no_tetrahedron_has(self, device):
        """They are not reported as lost."""
        one = mesh()
        to = builder()
        soft_mesh(to, np.concatenate([one.points, [[9.0, 9.0, 9.0]]]), one.tets)
        model = to.finalize(device=device)
        assert wn.SolverCorotated(model).stable_dt > 0.0


def test_a_step_of_years_is_refused():
    made = builder()
    add_grid(made, dims=(1, 1, 1))
    model = made.finalize(device="cpu")
    with pytest.raises(wc.InputError, match=r"dt is 1e\+09 s, which takes .* substeps of .* s; take a step"):
        wn.SolverCorotated(model).step(model.state(), model.state(), None, None, 1e9)
