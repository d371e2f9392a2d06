"""Blocks of soft tissue that touch obstacles, with the forces on them and their motion."""

import warp_corot as wc

SOFT = wc.Isotropic(young=2e4, poisson=0.4, density=1000.0)
DOWN = (0.0, 0.0, -9.81)


def block(device, level=3, origin=(0.0, 0.0, 0.0), cells=(2, 2, 1), material=SOFT, **options):
    mesh = wc.TetForest.box(cells=cells, cell_size=0.02, level=level, origin=origin)
    return wc.SoftBody(mesh, material, device=device, **options)


def weight(body):
    return 9.81 * body.masses.sum() / body.worlds


def force_on(obstacle, world=0):
    return obstacle.wrench.numpy()[world].astype(float)[:3]


def motion(body):
    """Displacement and velocity of the centre of mass."""
    m = body.masses / body.masses.sum()
    return m @ body.displacements.numpy().astype(float), m @ body.velocities.numpy().astype(float)
