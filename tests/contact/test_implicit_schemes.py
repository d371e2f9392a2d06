"""Obstacles in the implicit integrators besides backward Euler with one linear solve a step."""

import numpy as np
import pytest
from soft_blocks import DOWN, block, force_on, motion, weight

import warp_corot as wc

DT = 0.016
SCHEMES = {
    "BackwardEuler": wc.BackwardEuler(dt=DT, tolerance=1e-4),
    "BDF2": wc.BDF2(dt=DT),
    "GeneralizedAlpha": wc.GeneralizedAlpha(dt=DT, spectral_radius=0.0),
}


@pytest.fixture(params=list(SCHEMES))
def scheme(request):
    return SCHEMES[request.param]


def test_a_block_that_falls_comes_to_rest(device, scheme):
    """An impact that steps do not resolve hardly throws it back, and contact takes the weight's momentum."""
    body, ground = block(device, origin=(0.0, 0.0, 0.01)), wc.Ground()
    body.velocities = np.tile([0.3, 0.0, 0.0], (body.node_count, 1))
    sim = wc.Simulation(body, obstacles=ground, gravity=DOWN, integrator=scheme, contact=wc.Contact(friction=0.3))
    given = body.masses.sum() * np.array([0.3, 0.0, 0.0])
    felt, highest = np.zeros(3), 0.0
    for _ in range(30):
        sim.advance_steps(1)
        felt -= DT * force_on(ground)
        given += DT * body.masses.sum() * np.array(DOWN)
        highest = max(highest, motion(body)[1][2])
        assert body.positions.numpy()[:, 2].min() > -1e-6
    assert highest < 0.1
    assert force_on(ground)[2] == pytest.approx(-weight(body), rel=1e-3)
    assert np.abs(body.velocities.numpy()).max() < 1e-4
    np.testing.assert_allclose(felt, -given, atol=0.03 * np.linalg.norm(given))
    assert sim.solves.unfinished == 0


#: Schemes that keep vibrations, and the share by which these may change a force.
LIVELY = {
    "Newmark": (wc.Newmark(dt=DT), 3e-3),
    "balanced before the end": (wc.GeneralizedAlpha(dt=DT, spectral_radius=0.5), 1e-3),
    "no damping": (wc.GeneralizedAlpha(dt=DT, spectral_radius=1.0), 1e-3),
}


@pytest.mark.parametrize("name", [*SCHEMES, "QuasiStatic", *LIVELY])
def test_a_plate_presses_as_in_explicit_steps(device, name):
    def pressed(integrator):
        body, plate = block(device), wc.Tool(wc.Box((0.06, 0.06, 0.01)))
        body.fix(body.mesh.points[:, 2] < 1e-9)
        plate.follow([0.0, 0.1], [(0.02, 0.02, 0.025), (0.02, 0.02, 0.017)])
        options = {"gravity": (0.0, 0.0, 0.0), "contact": wc.Contact(friction=0.0)}
        sim = wc.Simulation(body, obstacles=plate, **options, integrator=integrator)
        sim.advance(0.4)
        assert sim.solves is None or sim.solves.unfinished == 0
        return force_on(plate)[2]

    explicit = pressed(wc.SymplecticEuler(damping=60.0))
    assert explicit > 10.0
    scheme, error = LIVELY.get(name) or (SCHEMES.get(name, wc.QuasiStatic(dt=0.02)), 1e-3)
    assert pressed(scheme) == pytest.approx(explicit, rel=error)


def test_a_saved_run_goes_on(device, tmp_path):
    body = block(device, origin=(0.0, 0.0, 0.001), cells=(1, 1, 1), worlds=2)
    sim = wc.Simulation(body, obstacles=wc.Ground(), gravity=DOWN, integrator=wc.BDF2(dt=DT))
    sim.advance_steps(4)
    sim.save(tmp_path / "state.npz")
    sim.advance_steps(3)
    later = wc.Simulation.load(tmp_path / "state.npz")
    later.advance_steps(3)
    error = np.abs(later.body.displacements.numpy() - body.displacements.numpy()).max()
    assert error <= (0.0 if body.device.is_cpu else 1e-6)


def test_grasps_at_the_stage_are_refused(device):
    """Their springs are those of the stage, where the tool is not."""
    body, plate = block(device), wc.Tool(wc.Box((0.06, 0.06, 0.01)))
    plate.follow([0.0, 0.1], [(0.02, 0.02, 0.025), (0.02, 0.02, 0.03)])
    sim = wc.Simulation(body, obstacles=plate, integrator=wc.GeneralizedAlpha(dt=DT))
    wc.Grasp(body, "z == zmax", tool=plate)
    with pytest.raises(wc.InputError, match="grasps only with spectral_radius=0"):
        sim.advance_steps(1)


def test_held_nodes_carry_a_block_to_the_ground(device):
    """Contact is that of the end of the step: the nodes below stop on the ground, not a share of a step off it."""
    body, ground = block(device, origin=(0.0, 0.0, 0.002)), wc.Ground()
    body.prescribe("z == zmax", velocity=(0.0, 0.0, -0.05))
    scheme = wc.GeneralizedAlpha(dt=DT, spectral_radius=0.8)
    sim = wc.Simulation(body, obstacles=ground, gravity=(0.0, 0.0, 0.0), integrator=scheme)
    sim.advance_steps(6)
    x, low = body.positions.numpy()[:, 2], body.mesh.points[:, 2] < 0.0021
    assert np.abs(x[low]).max() < 1e-6
    assert x.max() == pytest.approx(body.mesh.points[:, 2].max() - 6 * DT * 0.05, abs=1e-7)
    assert -force_on(ground)[2] > 1.0


@pytest.mark.parametrize("name", LIVELY)
def test_a_block_that_falls_vibrates_about_its_weight(device, name):
    """These schemes keep the vibrations of the body, and nodes that touch the ground stay on it. No step adds energy
    by more than a hundredth of that of the fall, and the run does not end with more than it had at rest."""
    body, ground = block(device, origin=(0.0, 0.0, 0.01)), wc.Ground()
    sim = wc.Simulation(body, obstacles=ground, gravity=DOWN, integrator=LIVELY[name][0])
    felt, energies, down = [], [], np.array(DOWN)
    masses = body.masses[:, None]
    for _ in range(36):
        sim.advance_steps(1)
        felt.append(-force_on(ground)[2] / weight(body))
        assert body.positions.numpy()[:, 2].min() > -1e-6
        assert motion(body)[1][2] < 0.15
        moving = 0.5 * np.sum(masses * body.velocities.numpy().astype(float) ** 2)
        fallen = np.sum(masses * body.displacements.numpy().astype(float) * down)
        energies.append(sim.fields[0].elastic_energy(body.state.displacements) + moving - fallen)
    fall = 0.01 * weight(body)
    assert np.diff(energies, prepend=0.0).max() < 0.02 * fall
    assert energies[-1] < -0.95 * fall
    assert np.mean(felt[16:]) == pytest.approx(1.0, rel=0.02)
    assert np.abs(np.array(felt[16:]) - 1.0).max() < 0.3
    assert sim.solves.unfinished == 0


def test_a_saved_run_of_a_remeshed_body_goes_on(device, tmp_path):
    """To the tolerance of the solves."""
    body = block(device, origin=(0.0, 0.0, 0.001), material=wc.Isotropic(500.0, 0.4, 1000.0))
    remesh = wc.OnlineRemesh(every=3, refine_above=1.003, simplify_below=1.001, max_level=6)
    sim = wc.Simulation(body, obstacles=wc.Ground(), gravity=DOWN, integrator=wc.BDF2(dt=DT), remesh=remesh)
    before = body.node_count
    sim.advance_steps(10)
    assert body.node_count > before
    sim.save(tmp_path / "state.npz")
    sim.advance_steps(3)
    later = wc.Simulation.load(tmp_path / "state.npz")
    later.advance_steps(3)
    # Passes of remeshing on CUDA number nodes in any order.
    found = [each.displacements.numpy()[np.lexsort(each.mesh.points.T)] for each in (body, later.body)]
    assert np.abs(found[1] - found[0]).max() < 1e-6
