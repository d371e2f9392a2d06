"""Mistakes of Python users: an InputError in one line that shows what would be right."""

import numpy as np
import pytest
import warp as wp

import warp_corot as wc

SOFT = wc.Isotropic(1e4, 0.4, 1e3)


@pytest.fixture(scope="module")
def mesh():
    return wc.TetForest.box((1, 1, 1), 0.1, 3)


@pytest.fixture
def body(mesh):
    return wc.SoftBody(mesh, SOFT, device="cpu")


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda mesh: wc.SoftBody(mesh, 5.0), r"material is 5\.0; .* Isotropic\(young=5\.0, poisson=0\.45"),
        (lambda mesh: wc.SoftBody(mesh, wc.Corotated()), r"material is Corotated\(.*for example Isotropic"),
        (lambda mesh: wc.SoftBody("x.msh", SOFT), r"mesh is 'x\.msh'; .*TetMesh\.load\('x\.msh'\).*from_surface"),
        (lambda mesh: wc.SoftBody(mesh.points, SOFT), r"mesh is array.*TetMesh\(points, tets\)"),
        (lambda mesh: wc.SoftBody(None, SOFT), "mesh is None"),
        (
            lambda mesh: wc.SoftBody(mesh, wc.Isotropic(np.ones(4), 0.4, 1e3), worlds=4),
            r"young has 4 entries; the mesh has 48 elements; one for each of 4 worlds is \[4, 1\]",
        ),
        (
            lambda mesh: wc.SoftBody(mesh, wc.Isotropic(np.ones((3, 1)), 0.4, 1e3), worlds=4),
            r"young has shape \(3, 1\); .*it must be \[48\], \[4, 1\] or \[4, 48\]",
        ),
        (lambda mesh: wc.TetMesh("x.msh", [[0, 1, 2, 3]]), r"points is 'x\.msh'.*TetMesh\.load"),
        (lambda mesh: wc.TetMesh(np.eye(4, 3), [[0, 1, 2, 3], [0]]), "tets has rows of different lengths"),
        (lambda mesh: wc.TetMesh.load(5), "path is 5"),
        (lambda mesh: wc.TetForest.box((1, 1, 1), "a", 3), "cell_size is 'a'"),
        (
            lambda mesh: wc.TetForest.from_domain("a.stl", 0.1),
            r"domain is 'a\.stl'; .*Domain\.from_surface\('a\.stl'\)",
        ),
        (lambda mesh: wc.SymplecticEuler("a"), "dt is 'a'"),
        (lambda mesh: wc.SymplecticEuler(None, [1]), r"damping is \[1\]"),
        (lambda mesh: wc.Simulation.load(5), "path is 5"),
    ],
)
def test_wrong_arguments_of_a_body(mesh, make, said):
    with pytest.raises(wc.InputError, match=said) as raised:
        make(mesh)
    assert "\n" not in str(raised.value)
    assert len(str(raised.value)) < 240


@pytest.mark.parametrize(
    ("use", "said"),
    [
        (lambda sim: setattr(sim.body, "positions", "x"), r"positions is 'x'; .*\[27, 3\]"),
        (lambda sim: setattr(sim.body, "velocities", [[1], [1, 2]]), r"velocities is \[\[1\], \[1, 2\]\]"),
        (lambda sim: sim.body.fix([[0], [1, 2]]), "rows of different lengths"),
        (lambda sim: sim.body.prescribe([0], times="x", displacements=[[0, 0, 0]]), "times is 'x'"),
        (lambda sim: sim.body.prescribe([0], times=[0, 1], displacements="y"), "displacements is 'y'"),
        (lambda sim: sim.advance("x"), "seconds is 'x'"),
        (lambda sim: sim.advance_until(None), "total_time is None"),
        (lambda sim: sim.advance_until(np.inf), "cannot advance until inf s"),
        (lambda sim: sim.save(5), "path is 5"),
        (lambda sim: wc.record(sim, "a.usd", duration="x"), "duration is 'x'"),
        (lambda sim: wc.record(sim, 5, duration=1.0), "path is 5"),
        (lambda sim: wc.record(sim.body, "a.usd", duration=1.0), r"sim is .*SoftBody.*Simulation\(body\)"),
    ],
)
def test_wrong_arguments_of_a_simulation(body, use, said, folder):
    with pytest.raises(wc.InputError, match=said):
        use(wc.Simulation(body))
    assert not list(folder.iterdir())


#: No argument below may be one of these.
NOTHING = [
    "x",
    object(),
    float("nan"),
    10**400,
    1j,
    [[1, 2], [3]],
    np.zeros((2, 2, 2)),
    np.array(["a", "b"]),
    {"a": 1},
    b"abc",
]
VOXELS = np.pad(np.ones((2, 2, 2), int), 1)
#: Calls with right arguments, of which one is exchanged at a time.
CALLS = [
    (wc.TetForest.box, {"cells": (1, 1, 1), "cell_size": 1.0, "level": 0, "origin": (0.0, 0.0, 0.0), "up_axis": "Z"}),
    (wc.TetMesh, {"points": np.eye(4, 3, k=-1), "tets": [[0, 1, 2, 3]], "scale": 1.0, "up_axis": "Z", "labels": [0]}),
    (wc.TetMesh, {"points": np.eye(4, 3, k=-1), "tets": [[0, 1, 2, 3]], "label_names": ["a"]}),
    (wc.Domain.sphere, {"radius": 1.0, "centre": (0.0, 0.0, 0.0), "up_axis": "Z", "device": "cpu"}),
    (wc.Domain.torus, {"major": 1.0, "minor": 0.2, "axis": "Z"}),
    (wc.Domain.from_function, {"function": lambda x: x[:, 0], "bounds": [[-1] * 3, [1] * 3], "lipschitz": 1.0}),
    (wc.Domain.from_labels, {"volume": VOXELS, "spacing": (1, 1, 1), "origin": (0, 0, 0), "smoothing": 0.0}),
    (wc.Domain.from_labels, {"volume": VOXELS, "affine": np.eye(4), "labels": {"a": 1}, "unit": "cm"}),
    (wc.polar_rotation, {"F": np.eye(3), "method": "byers-xu", "iterations": 4, "device": "cpu"}),
    (wc.SymplecticEuler, {"dt": 1.0, "damping": 0.0, "viscosity": 0.0}),
    (wc.BackwardEuler, {"dt": 1.0, "damping": 0.0, "viscosity": 0.0, "tolerance": 1e-3, "preconditioner": "diagonal"}),
    (wc.Corotated, {"rotation_level": 1, "rotation": "svd", "dilatation": "auto"}),
    (wc.Corotated, {"iterations": 4, "subtrees": True}),
    (wc.EdgeStVK, {"springs": "quadratic", "dilatation": "element"}),
    (wc.Ogden, {"mu": 1.0, "alpha": 2.0}),
    (wc.Prony, {"g": 1.0, "tau": 1.0, "model": wc.Linear()}),
    (wc.OnlineRemesh, {"refine_above": 1.3, "simplify_below": 1.1, "min_level": 1, "max_level": 2, "every": 3}),
    (wc.SignedDistance, {"distance": np.pad([[[-1.0]]], 1, constant_values=1.0), "lower": (0, 0, 0), "spacing": 1.0}),
    (wc.Contact, {"friction": 0.3, "self_contact": False}),
]


@pytest.mark.parametrize(
    ("call", "right", "name"),
    [
        pytest.param(call, right, name, id=f"{call.__qualname__}-{name}")
        for call, right in CALLS
        for name in right
        if name != "affine"
    ],
)
def test_odd_values_in_every_argument(call, right, name):
    """The call raises an InputError, or gives a result if the value can be meant; it never raises an error of NumPy or
    Warp."""
    call(**right)
    said = []
    for wrong in NOTHING:
        try:
            call(**{**right, name: wrong})
        except wc.InputError as error:
            said.append(str(error))
    assert len(said) >= len(NOTHING) - 2
    assert all("\n" not in each and len(each) < 300 for each in said)


class TestNodesByPlace:
    """``fix`` and similar calls take an expression or a function of the rest position, like materials."""

    @pytest.mark.parametrize(
        "nodes", ["z < zmin + 0.01", lambda x: x[:, 2] < 0.01, [0, 1, 2, 3]], ids=["expression", "function", "indices"]
    )
    def test_they_are_fixed_and_released(self, body, nodes):
        wanted = np.isin(np.arange(27), nodes) if isinstance(nodes, list) else body.mesh.points[:, 2] < 0.01
        body.fix(nodes)
        np.testing.assert_array_equal(body.constrained, wanted)
        body.release(nodes)
        assert not body.constrained.any()

    def test_in_the_worlds_that_are_meant(self, mesh):
        body = wc.SoftBody(mesh, SOFT, worlds=3, device="cpu")
        body.fix("x > 0.09", worlds=[0, 2])
        held = body.constrained.reshape(3, -1)
        assert held.sum(axis=1).tolist() == [9, 0, 9]

    def test_they_are_loaded_and_moved(self, body):
        body.load(lambda x: x[:, 1] > 0.09, [0.0, 1.0, 0.0])
        np.testing.assert_array_equal(body.loads.numpy()[:, 1], (body.mesh.points[:, 1] > 0.09).astype(np.float32))
        body.prescribe("y < 0.01", velocity=[0.0, 0.0, 1.0])
        np.testing.assert_array_equal(body.velocities.numpy()[:, 2], (body.mesh.points[:, 1] < 0.01).astype(np.float32))

    def test_bounds_are_those_of_nodes_in_elements(self):
        points = np.concatenate([np.eye(4, 3, k=-1), [[0.0, 0.0, 9.0]]])
        body = wc.SoftBody(wc.TetMesh(points, [[0, 1, 2, 3]]), SOFT, device="cpu")
        body.fix("z == zmax")
        assert body.constrained.tolist() == [False, False, False, True, False]

    @pytest.mark.parametrize(
        ("nodes", "said"),
        [
            ("z", "the result is a number"),
            ("z < w", "'w' is not known"),
            (lambda x: x[:, 2], r"gives float64 of shape \[27\].* lambda x: x\[:, 2\] < 0\.01"),
            (lambda x: x[0, 2] < 0.01, r"gives bool of shape \[\]"),
            (lambda x: x[:, 3] < 0.01, r"fails at the rest positions \[27, 3\]: index 3"),
        ],
    )
    def test_others_are_refused(self, body, nodes, said):
        with pytest.raises(wc.InputError, match=said):
            body.fix(nodes)
        assert not body.constrained.any()


class TestTape:
    """A tape through a step would give zero gradients."""

    @pytest.mark.parametrize(
        "step",
        [lambda sim: sim.step(), lambda sim: sim.advance(0.01), lambda sim: sim.advance_steps(2)],
        ids=["step", "advance", "advance_steps"],
    )
    def test_steps_are_refused(self, body, step):
        sim = wc.Simulation(body)
        with wp.Tape() as tape:
            with pytest.raises(wc.InputError, match="steps have no adjoint"):
                step(sim)
            assert not tape.launches
        assert sim.steps == 0
        step(sim)
        assert sim.steps > 0

    def test_the_tape_goes_on(self, body):
        """Work recorded around the refused step has its gradient."""
        sim = wc.Simulation(body)
        x = wp.array([3.0], dtype=float, device="cpu", requires_grad=True)
        y = wp.empty_like(x)
        with wp.Tape() as tape:
            with pytest.raises(wc.InputError):
                sim.step()
            wp.launch(_squared, dim=1, inputs=[x], outputs=[y], device="cpu")
        y.grad.fill_(1.0)
        tape.backward()
        assert x.grad.numpy()[0] == 6.0


@wp.kernel(enable_backward=True)
def _squared(x: wp.array(dtype=float), y: wp.array(dtype=float)):
    y[wp.tid()] = x[wp.tid()] * x[wp.tid()]


@pytest.mark.parametrize("model", [wc.Corotated(), wc.MassSpring(), wc.Corotated(rotation_level=1)], ids=str)
def test_energies_of_worlds_are_those_of_single_bodies(mesh, model, device, rng):
    poisson = 0.25 if isinstance(model, wc.MassSpring) else 0.4
    young = np.array([[1e4], [2e4], [5e3]])
    moved = 1e-3 * rng.normal(size=(3, 27, 3))
    several = wc.SoftBody(mesh, wc.Isotropic(young, poisson, 1e3), worlds=3, device=device)
    several.displacements, several.velocities = moved.reshape(-1, 3), 10.0 * moved.reshape(-1, 3)
    sim = wc.Simulation(several, model=model)
    found = sim.world_energies()
    for k in range(3):
        single = wc.SoftBody(mesh, wc.Isotropic(young[k, 0], poisson, 1e3), device=device)
        single.displacements, single.velocities = moved[k], 10.0 * moved[k]
        alone = wc.Simulation(single, model=model).energy()
        assert alone.elastic > 0
        np.testing.assert_allclose([e[k] for e in found], alone, rtol=1e-5)
        np.testing.assert_allclose(found.total[k], alone.total, rtol=1e-5)
    np.testing.assert_allclose(sim.energy(), np.sum(found, axis=1), rtol=1e-12)
