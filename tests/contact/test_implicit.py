"""Obstacles in implicit steps of 16 ms, which is a hundred times what explicit steps of the same bodies last."""

import numpy as np
import pytest
from soft_blocks import DOWN, block, force_on, weight

import warp_corot as wc

EULER = wc.BackwardEuler(dt=0.016)


def test_a_block_that_falls_comes_to_rest_with_its_weight(device):
    body, ground = block(device, origin=(0.0, 0.0, 0.01)), wc.Ground()
    sim = wc.Simulation(body, obstacles=ground, gravity=DOWN, integrator=EULER)
    for _ in range(12):
        sim.advance_steps(2)
        assert body.positions.numpy()[:, 2].min() > -1e-6
    sim.advance_steps(6)
    assert force_on(ground)[2] == pytest.approx(-weight(body), rel=1e-3)
    assert body.contact_forces.numpy()[:, 2].sum() == pytest.approx(weight(body), rel=1e-3)
    assert sum(point.force[2] for point in sim.contacts()) == pytest.approx(weight(body), rel=1e-3)
    assert np.abs(body.velocities.numpy()).max() < 1e-4


def test_nothing_passes_a_thin_plate(device):
    """Falling 80 mm in a step, onto 4 mm."""
    body, plate = block(device, origin=(0.0, 0.0, 0.02), cells=(1, 1, 1)), wc.Box((0.1, 0.1, 0.004))
    body.velocities = np.tile([0.0, 0.0, -5.0], (body.node_count, 1))
    sim = wc.Simulation(body, obstacles=plate, gravity=DOWN, integrator=EULER)
    sim.advance_steps(1)
    assert body.positions.numpy()[:, 2].min() > 0.002 - 1e-6
    sim.advance_steps(20)
    assert body.positions.numpy()[:, 2].min() > 0.002 - 1e-6
    assert force_on(plate)[2] == pytest.approx(-weight(body), rel=1e-3)


def test_forces_in_a_corner_balance(device):
    """Nodes at the edge touch both walls."""
    body, walls = block(device), [wc.Ground(), wc.Ground((1.0, 0.0, 0.0))]
    gravity = np.array([-8.0, 0.0, -9.81])
    sim = wc.Simulation(body, obstacles=walls, gravity=gravity, integrator=EULER, contact=wc.Contact(friction=0.1))
    sim.advance_steps(25)
    total = force_on(walls[0]) + force_on(walls[1])
    assert total == pytest.approx(body.masses.sum() * gravity, abs=2e-3 * weight(body))
    assert (body.positions.numpy()[:, [0, 2]] > -1e-6).all()


def test_a_plate_presses_as_in_explicit_steps(device):
    """Without friction, the force of which depends on how surfaces got where they are."""
    options = {"gravity": (0.0, 0.0, 0.0), "contact": wc.Contact(friction=0.0)}

    def pressed(integrator):
        body, plate = block(device), wc.Tool(wc.Box((0.06, 0.06, 0.01)))
        body.fix(body.mesh.points[:, 2] < 1e-9)
        plate.follow([0.0, 0.1], [(0.02, 0.02, 0.025), (0.02, 0.02, 0.022)])
        sim = wc.Simulation(body, obstacles=plate, **options, integrator=integrator)
        sim.advance(0.4)
        return force_on(plate)[2]

    explicit = pressed(wc.SymplecticEuler(damping=60.0))
    assert explicit > 1.0
    assert pressed(wc.BackwardEuler(dt=0.016)) == pytest.approx(explicit, rel=0.01)


def test_worlds_and_saved_runs(device, tmp_path):
    """A world that is reset falls again without any effect on the others; a loaded run continues bit for bit."""
    body = block(device, origin=(0.0, 0.0, 0.001), cells=(1, 1, 1), worlds=2)
    sim = wc.Simulation(body, obstacles=wc.Ground(), gravity=DOWN, integrator=EULER)
    sim.advance_steps(3)
    sim.reset(1)
    sim.advance_steps(2)
    nodes = body.node_count // 2
    lowest = body.positions.numpy().reshape(2, nodes, 3)[:, :, 2].min(axis=1)
    assert np.abs(lowest).max() < 1e-6
    sim.save(tmp_path / "state.npz")
    sim.advance_steps(3)
    later = wc.Simulation.load(tmp_path / "state.npz")
    later.advance_steps(3)
    error = np.abs(later.body.displacements.numpy() - body.displacements.numpy()).max()
    assert error <= (0.0 if body.device.is_cpu else 1e-6)


def test_rounded_positions_do_not_keep_a_stiff_rod_from_being_solved_for(device):
    """Rows are stiff, and what rounding changed in a gap each time it was found came back as a force."""
    rod = wc.SoftBody(wc.TetForest.box((1, 1, 10), 0.008, 3), wc.Isotropic(3e5, 0.3, 1000.0), device=device)
    ground = wc.Ground(offset=-0.05)
    steps = wc.BackwardEuler(1 / 60, damping=2.0)
    sim = wc.Simulation(rod, obstacles=[ground], gravity=(0, 0, -9.81), integrator=steps)
    sim.advance(0.4)
    assert sim.obstacles[0].wrench.numpy()[0][2] < 0.0
    assert sim.solves.unfinished == 0
