"""A soft organ that falls over on the ground, with one call of ``collide`` and one step a frame: nodes get below the
ground before Newton has listed them, and light nodes meet stiff contacts."""

import numpy as np
import pytest
from newton_scenes import builder, contact_parameters, newton, stepped, wc, wn

RADIUS, GAP, FRAMES = 0.002, 0.01, 22


def organ_above_ground(device):
    """A ring of 5 kPa, its tube 3 cm thick, 2 cm above the ground."""
    forest = wc.TetForest.from_domain(wc.Domain.torus(0.035, 0.015), target_elements=1500, device="cpu")
    made = builder()
    made.add_ground_plane()
    tissue = wc.Isotropic(young=5e3, poisson=0.44, density=1000.0)
    slant = (np.sin(0.7), 0.0, 0.0, np.cos(0.7))
    wn.add_mesh(made, wc.TetMesh(forest.points, forest.tets), tissue, rot=slant, k_damp=2.0, particle_radius=RADIUS)
    lowest = min(q[2] for q in made.particle_q)
    made.particle_q = [(x, y, z + 0.02 + RADIUS - lowest) for x, y, z in made.particle_q]
    model = made.finalize(device=device)
    contact_parameters(model, ke=1e4, kd=0.0, kf=1e3, mu=0.3)
    return model


@pytest.mark.parametrize("options", [{}, {"integrator": "implicit", "substeps": 2}], ids=["explicit", "implicit"])
def test_it_stands_and_throws_nothing(device, options):
    """No node goes deeper than the pipeline's gap, or twice as fast as in free fall from the top."""
    model = organ_above_ground(device)
    bound = 2.0 * np.sqrt(2.0 * 9.81 * model.particle_q.numpy()[:, 2].max())
    solver, pipeline = wn.SolverCorotated(model, **options), newton.CollisionPipeline(model, soft_contact_gap=GAP)
    lowest, fastest = [], []
    for now in stepped(solver, model, FRAMES, 1 / 60, pipeline=pipeline):
        lowest.append(now.particle_q.numpy()[:, 2].min())
        fastest.append(np.linalg.norm(now.particle_qd.numpy(), axis=1).max())
    assert min(lowest) > -GAP
    assert lowest[-1] > 0.0
    assert max(fastest) < bound
