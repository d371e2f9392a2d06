"""The work of contact, friction and grasps in the balance of energy, whatever steps follow one another."""

import numpy as np
import pytest

import warp_corot as wc

SOFT = wc.Isotropic(young=2e4, poisson=0.4, density=1000.0)
TOP, RADIUS = 0.02, 0.01


def block(device, level, **options):
    return wc.SoftBody(wc.TetForest.box((2, 2, 1), TOP, level), SOFT, device=device, **options)


def work_of_contact(sim):
    return sum(float(account.numpy()[0].sum()) for account in sim.system.accounts)


def recorded(sim, body, steps, at):
    """Velocities, contact forces, reactions, elastic energy and work after each of the given steps [s]."""
    found = []
    for number, dt in enumerate(steps):
        if number in at:
            at[number]()
        sim.advance(dt)
        nodal = (array.numpy().astype(float) for array in (body.velocities, body.contact_forces, body.reactions))
        support = float(sim.system.support_work.numpy()[0])
        found.append((*nodal, sim.energy().elastic, work_of_contact(sim), support))
    assert sim.steps == len(steps)
    return [np.array(each) for each in zip(*found, strict=True)]


@pytest.mark.parametrize("below", ["free", "prescribed"])
def test_all_energy_comes_from_somewhere(device, below):
    """The lengths of steps differ by up to a factor of twenty. With a linear law, the energy of a step, with velocities
    half a step behind and ahead, grows to rounding by the work of contact, friction, grasp and supports, and by what a
    change of the step adds where nothing touches."""
    body = block(device, 1)
    if below == "prescribed":
        body.prescribe("z == zmin", times=[0.0, 0.01, 0.02], displacements=[(0, 0, 0), (0, 5e-4, -5e-4), (0, 0, 0)])
    ground = wc.Ground(normal=(0, 0, 1), offset=-5e-4)
    probe = wc.Tool(wc.Sphere(RADIUS))
    probe.follow([0.0, 0.02], [(0.018, 0.02, TOP + RADIUS - 1e-4), (0.024, 0.022, TOP + RADIUS - 2e-3)])
    pincers = wc.Tool(wc.Sphere(1e-3))
    pincers.follow([0.0, 0.005, 0.02], [(0, 0, 0.05), (1e-3, 0, 0.052), (-1e-3, 0, 0.049)])
    obstacles, contact = [ground, probe, pincers], wc.Contact(friction=0.5)
    sim = wc.Simulation(body, model=wc.Linear(), obstacles=obstacles, contact=contact, gravity=(0, 0, 0))
    grasp = wc.Grasp(body, "(z == zmax) & (x == xmin)", tool=pincers)
    steps = 10.0 ** np.random.default_rng(1).uniform(-5.2, -3.9, 300)
    v, c, reactions, elastic, work, support = recorded(sim, body, steps, {150: grasp.release})
    assert np.any(c[150:] != 0.0)
    assert work[-1] > 1e-6

    free, mass = ~body.constrained, body.masses[:, None]
    before = np.concatenate([steps[:1], steps[:-1]])
    earlier = np.concatenate([np.zeros_like(v[:1]), v[:-1]])
    kicks = 0.5 * (before + steps)[:, None, None]
    # Elastic forces at the beginning of each step, from the motion and from reactions.
    others = np.where(free[:, None], mass * (v - earlier) / kicks, -reactions) - c
    untouched = free & ~np.any(c != 0.0, axis=2)
    changes = 0.25 * (before - steps) * np.einsum("sni,sni,sn->s", others, v - earlier, untouched)
    for last in (100, 200, 299):
        moving = 0.5 * np.sum(mass[free] * earlier[last, free] ** 2)
        ahead = 0.5 * before[last] * np.sum(earlier[last] * others[last])
        energy = moving + ahead + elastic[last - 1]
        given = work[last - 1] + support[last - 1] + changes[:last].sum()
        assert energy == pytest.approx(given, abs=1e-5 * np.abs(work).max())


def test_a_tool_that_comes_late_does_its_work(device):
    """The hand stops for a moment; then the tool catches up at 1 m/s and hits a block of few elements. The first step
    after that is many times shorter than the one before."""
    body = block(device, 0)
    body.fix("z == zmin")
    probe = wc.Tool(wc.Sphere(RADIUS, position=(0.02, 0.02, TOP + RADIUS)), speed=1.0)
    sim = wc.Simulation(body, obstacles=[probe], gravity=(0, 0, 0), integrator=wc.SymplecticEuler(viscosity=1e-3))
    sim.advance(0.02)
    for k in range(50):
        depth = 3e-3 * np.sin(1.4e-3 * np.pi * k) ** 2 if k < 30 else 5e-4
        angle = 1.2e-3 * np.pi * min(k, 30) + (0.4 if k >= 30 else 0.0)
        probe.move((0.02 + 0.005 * np.sin(angle), 0.025 - 0.005 * np.cos(angle), TOP + RADIUS - depth))
        sim.advance(0.002)
    assert probe.wrench.numpy()[0][2] > 0.0
