"""Materials that vary in space and between worlds, their use, and invalid ones."""

import numpy as np
import pytest
from cases import MESHES, jittered, mixed_forest, place, random_displacement
from fibres import muscle, random_axes, simulated, wood

import warp_corot as wc

# --- values that vary ----------------------------------------------------------------------------------------------


def stiffening(points):
    return 5e3 * (1 + 10 * points[:, 2])


def circling(points):
    """Fibres around the y axis through the middle of the mesh, of lengths from zero at the axis outwards."""
    return np.cross(points - points.mean(axis=0) + 1e-9, [0, 1, 0])


def centroids(mesh):
    return mesh.points[mesh.tets].mean(axis=1)


@pytest.mark.parametrize("model", [wc.Corotated(), wc.NeoHookean(), wc.EdgeStVK(), wc.MassSpring(), wc.Linear()])
@pytest.mark.parametrize("make", [mixed_forest, jittered])
def test_isotropic_functions_of_the_rest_position(make, model, device, rng):
    """They equal arrays of their values at the elements' centroids."""
    mesh = make()
    x = centroids(mesh)
    given = wc.Isotropic(stiffening, lambda p: 0.3 + p[:, 0], lambda p: 800 + 1e4 * p[:, 1])
    by_element = wc.Isotropic(stiffening(x), 0.3 + x[:, 0], 800 + 1e4 * x[:, 1])
    u = random_displacement(mesh, rng, 0.1)
    forces, masses = [], []
    for material in (given, by_element):
        sim, body = simulated(mesh, material, device, model=model)
        place(body, u)
        forces.append(sim.forces().numpy())
        masses.append(body.masses)
    assert np.abs(forces[0] - forces[1]).max() < 1e-5 * np.abs(forces[1]).max()
    np.testing.assert_array_equal(*masses)
    assert np.ptp(by_element.young) > 0.3 * np.min(by_element.young)


def test_directions_and_constants_as_functions(device, rng):
    mesh = mixed_forest()
    x = centroids(mesh)
    soft = np.stack([stiffening(x), 0.5 * stiffening(x), 0.3 * stiffening(x)], axis=-1)
    axes = random_axes(rng, len(x))
    pairs = [
        (muscle(circling, young_along=stiffening), muscle(circling(x), young_along=stiffening(x))),
        (
            wood(lambda p: axes, young=lambda p: soft, density=stiffening),
            wood(axes, young=soft, density=stiffening(x)),
        ),
    ]
    for pair in pairs:
        u = random_displacement(mesh, rng, 0.1)
        forces = []
        for material in pair:
            sim, body = simulated(mesh, material, device)
            place(body, u)
            forces.append(sim.forces().numpy())
        assert np.abs(forces[0] - forces[1]).max() < 1e-5 * np.abs(forces[1]).max()


@pytest.mark.parametrize("name", ["level 3", "general"])
def test_worlds_of_different_materials(name, device, rng):
    """Each of three worlds behaves like a single body with its material."""
    mesh = MESHES[name]()
    count = len(mesh.tets)
    along, directions = rng.uniform(1e4, 5e4, (3, 1)), rng.standard_normal((3, count, 3))
    density, u = rng.uniform(500, 2000, (1, count)), np.stack([random_displacement(mesh, rng, 0.1) for _ in range(3)])
    sim, body = simulated(mesh, muscle(directions, young_along=along, density=density), device, worlds=3)
    body.displacements = u
    sim.advance_steps(20)
    together = body.displacements.numpy().reshape(3, -1, 3)
    energy = 0.0
    for world in range(3):
        own = muscle(directions[world], young_along=along[world, 0], density=density[0])
        alone, one = simulated(mesh, own, device)
        one.displacements = u[world]
        alone.advance_steps(20)
        energy += alone.energy().elastic
        expected = one.displacements.numpy()
        atol = 0 if alone.device.is_cpu else 1e-4 * np.abs(expected).max()
        np.testing.assert_allclose(together[world], expected, rtol=0, atol=atol)
    assert sim.energy().elastic == pytest.approx(energy, rel=1e-5)


def test_recorded_with_the_nearest_isotropic_material(tmp_path, device):
    from pxr import Usd

    sim, body = simulated(MESHES["level 3"](), muscle([0, 0, 1]), device)
    wc.record(sim, tmp_path / "muscle.usda", duration=1e-3, fps=1000)
    stage = Usd.Stage.Open(str(tmp_path / "muscle.usda"))
    found = [p.GetAttribute("primvars:young").Get() for p in stage.Traverse() if p.HasAttribute("primvars:young")]
    assert found == [pytest.approx(body.material.isotropic.young, rel=1e-6)]


# --- bad input -----------------------------------------------------------------------------------------------------

REFUSED = {
    "negative modulus": (lambda: muscle([1, 0, 0], young_across=-1.0), "young_across is -1 Pa; it must be above 0"),
    "NaN in a field": (
        lambda: muscle([1, 0, 0], shear_along=[1.0, np.nan]),
        "shear_along of element 1 is nan Pa; it must be above 0",
    ),
    "infinite ratio": (lambda: muscle([1, 0, 0], poisson_along=np.inf), "poisson_along is inf; it must be finite"),
    "no length": (lambda: muscle([[1, 0, 0], [0, 0, 0]]), "direction of element 1 has length zero"),
    "NaN direction": (lambda: muscle([0, np.nan, 1]), "direction is nan; it must be finite"),
    "flat direction": (lambda: muscle([1, 0]), r"direction has shape \(2,\); it must be \[3\]"),
    "no number": (lambda: muscle("up"), "direction is 'up'; it must be a number or an array"),
    "indefinite": (
        lambda: muscle([1, 0, 0], poisson_along=1.5),
        r"is not positive definite: 1 - poisson_across - 2 poisson_along\^2 .* is -0.7; it must be above zero",
    ),
    "indefinite element": (
        lambda: muscle([1, 0, 0], poisson_across=[0.2, 0.95]),
        "stiffness of element 1 is not positive definite",
    ),
    "indefinite pair": (
        lambda: wood(np.eye(3), poisson=[2.0, 0, 0]),
        "not positive definite: the least of .* is -0.0667",
    ),
    "indefinite triple": (lambda: wood(np.eye(3), poisson=[1.0, 1.0, 1.0]), "not positive definite"),
    "two moduli": (lambda: wood(np.eye(3), young=[1.0, 2.0]), r"young has shape \(2,\); it must be \[3\]"),
    "skew axes": (
        lambda: wood([[1, 0, 0], [0.1, 1, 0], [0, 0, 1]]),
        "axes are not at right angles: the cosine of two is 0.0995",
    ),
    "axis of no length": (lambda: wood([[1, 0, 0], [0, 0, 0], [0, 0, 1]]), "axes has length zero"),
    "two axes": (lambda: wood([[1, 0, 0], [0, 1, 0]]), r"axes has shape \(2, 3\)"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_materials_that_are_refused(case):
    make, message = REFUSED[case]
    with pytest.raises(wc.InputError, match=message):
        make()


REFUSED_BY_BODY = {
    "wrong length": (lambda: muscle(np.ones((7, 3))), "direction has 7 entries; the mesh has 48 elements"),
    "wrong worlds": (lambda: muscle(np.ones((2, 1, 3))), r"direction has shape \(2, 1, 3\); there are 1 worlds of 48"),
    "function of one value": (
        lambda: wc.Isotropic(lambda p: 5.0, 0.3, 1.0),
        r"young gives shape \(\) at 48 rest positions; it must be \[48\]",
    ),
    "function of too few": (
        lambda: muscle(lambda p: p[1:]),
        r"direction gives shape \(47, 3\) at 48 rest positions; it must be \[48, 3\]",
    ),
    "function of words": (lambda: wc.Isotropic(lambda p: "soft", 0.3, 1.0), "young gives 'soft' at 48 rest positions"),
    "function with NaN": (
        lambda: wc.Isotropic(lambda p: np.where(np.arange(48) == 5, np.nan, 1.0), 0.3, 1.0),
        "young of element 5 is nan Pa; it must be above 0",
    ),
    "function out of range": (
        lambda: wc.Isotropic(1.0, lambda p: 0 * p[:, 0] + 0.5, 1.0),
        "poisson of element 0 is 0.5",
    ),
    "function of zeros": (lambda: muscle(lambda p: 0 * p), "direction of element 0 has length zero"),
    "indefinite function": (
        lambda: muscle([1, 0, 0], poisson_along=lambda p: 0 * p[:, 0] + 1.5),
        "not positive definite",
    ),
    "beyond float32": (lambda: muscle([1, 0, 0], young_along=1e41), "float32"),
}


@pytest.mark.parametrize("case", REFUSED_BY_BODY)
def test_materials_that_a_body_refuses(case):
    make, message = REFUSED_BY_BODY[case]
    with pytest.raises(wc.InputError, match=message):
        wc.SoftBody(MESHES["level 3"](), make(), device="cpu")


REFUSED_MODELS = {
    "NeoHookean": wc.NeoHookean(),
    "Linear": wc.Linear(),
    "MassSpring": wc.MassSpring(),
    "EdgeStVK": wc.EdgeStVK(),
    "rotation_level is 0": wc.Corotated(rotation_level=0),
}


@pytest.mark.parametrize("case", REFUSED_MODELS)
def test_models_without_directions_refuse_them(case):
    with pytest.raises(
        wc.InputError, match=case if " is " in case else "TransverselyIsotropic; only the model Corotated"
    ):
        simulated(MESHES["level 3"](), muscle([0, 0, 1]), "cpu", model=REFUSED_MODELS[case])
