"""An hour of tools that press and shear an organ at random."""

import numpy as np
import pytest

import warp_corot as wc

#: From one place to the next, and in the end far away [s].
EVERY, LEAVING = 0.1, 0.5


def way_of(rng, third, count):
    """Directions from above within one third of the circle, so that tools do not meet, [count, 3]."""
    angle = 2.0 * np.pi * (third + rng.uniform(0.0, 0.8, count)) / 3.0
    height = rng.uniform(0.2, 1.0, count)
    flat = np.sqrt(1.0 - height**2)
    return np.stack([np.cos(angle) * flat, np.sin(angle) * flat, height], axis=1)


@pytest.mark.filterwarnings("ignore::warp_corot.StabilityWarning")
@pytest.mark.parametrize(
    ("seconds", "seed"),
    [(1.0, 20130705)]
    + [pytest.param(6.0, seed, marks=pytest.mark.slow) for seed in range(10)]
    + [pytest.param(3600.0, 20130705, marks=pytest.mark.slow)],
)
def test_tools_at_random_leave_an_organ_whole(device, seconds, seed):
    """A ball, a rod and a square bar, 6 to 12 mm thick, move up to 16 mm deep into a ball of 60 mm and across it, at
    about 0.5 m/s, and crush some elements. The run continues, and the body is whole once they have left; until then a
    tool beside it may hold a corner by friction."""
    rng = np.random.default_rng(seed)
    mesh = wc.TetForest.from_domain(wc.Domain.sphere(0.03, device=device), target_elements=250, device=device)
    points = mesh.points
    body = wc.SoftBody(mesh, wc.Isotropic(2e4, 0.45, 1000.0), device=device)
    body.fix(np.flatnonzero(points[:, 2] < -0.012))
    tools, count = [], int(seconds / EVERY) + 1
    shapes = ((wc.Sphere(0.006), 0.006), (wc.Capsule(0.003, 0.05), 0.028), (wc.Box((0.008, 0.008, 0.05)), 0.025))
    for third, (shape, half) in enumerate(shapes):
        way = way_of(rng, third, count)
        far = half + rng.uniform(0.018, 0.05, (count, 1))
        far[[0, -1]] = half + 0.065
        tools.append(wc.Tool(shape))
        turns = np.hstack([np.cross((0.0, 0.0, 1.0), way), 1.0 + way[:, 2:]])
        times = np.append(EVERY * np.arange(count), EVERY * (count - 1) + LEAVING)
        places = np.vstack([far * way, (half + 0.3) * way[-1:]])
        tools[-1].follow(times, places, np.vstack([turns, turns[-1:]]))
    integrator = wc.SymplecticEuler(viscosity=2e-3)
    sim = wc.Simulation(
        body, obstacles=tools, contact=wc.Contact(friction=0.5), gravity=(0.0, 0.0, 0.0), integrator=integrator
    )
    felt = 0.0
    while sim.time < seconds - 1e-6:
        sim.advance(0.05)
        forces = [np.linalg.norm(tool.wrench.numpy()[0][:3]) for tool in tools]
        felt = max(felt, *map(float, forces))
        # Tools may take nodes along, but none goes farther than they do.
        assert np.linalg.norm(body.positions.numpy(), axis=1).max() < 0.13
    assert 0.1 < felt < 1e3
    sim.advance(LEAVING)
    sim.advance(1.0)  # in which vibrations fall to a tenth, and again
    assert np.linalg.norm(body.positions.numpy() - points, axis=1).max() < 1e-3
    now, rest = (
        np.linalg.det(x[mesh.tets[:, 1:]] - x[mesh.tets[:, :1]]) for x in (body.positions.numpy().astype(float), points)
    )
    assert (now / rest).min() > 0.9
