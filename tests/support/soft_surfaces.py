"""Soft blocks, bodies with crossing edges, and bodies with arms that meet; and the forces on them."""

import numpy as np

import warp_corot as wc

SOFT = wc.Isotropic(young=2e4, poisson=0.4, density=1000.0)
DOWN = (0.0, 0.0, -9.81)


def block(device, z, cells=(2, 2, 1), level=3, at=0.0, **options):
    mesh = wc.TetForest.box(cells=cells, cell_size=0.02, level=level, origin=(at, at, z))
    return wc.SoftBody(mesh, SOFT, device=device, **options)


def weight(body):
    return 9.81 * body.masses.sum() / body.worlds


def force_on(body):
    return body.contact_forces.numpy().astype(float).sum(axis=0)


def roof(device, along, z):
    """A square beam that lies on one of its edges."""
    cells = (4, 1, 1) if along == 0 else (1, 4, 1)
    mesh = wc.TetForest.box(cells=cells, cell_size=0.01, level=3)
    points = mesh.points - mesh.points.mean(axis=0)
    c = np.sqrt(0.5)
    turn = np.array([[1, 0, 0], [0, c, -c], [0, c, c]]) if along == 0 else np.array([[c, 0, c], [0, 1, 0], [-c, 0, c]])
    points = points @ turn.T
    points[:, 2] += z - points[:, 2].min()
    return wc.SoftBody(wc.TetMesh(points, mesh.tets), wc.Isotropic(5e4, 0.3, 1000.0), device=device)


def horseshoe(device):
    mesh = wc.TetForest.box(cells=(5, 1, 4), cell_size=0.01, level=3)
    centres = mesh.points[mesh.tets].mean(axis=1)
    inside = ~((centres[:, 0] > 0.02) & (centres[:, 0] < 0.03) & (centres[:, 2] > 0.01))
    used, tets = np.unique(mesh.tets[inside], return_inverse=True)
    return wc.SoftBody(
        wc.TetMesh(mesh.points[used], tets.reshape(-1, 4)),
        wc.Isotropic(young=2e4, poisson=0.4, density=1000.0),
        device=device,
    )


def folded(device, integrator, *, itself=True):
    """A horseshoe whose arms are bent together by more than the gap between them: its simulation, the nodes that bend
    it, and a function for how far the arms have crossed [m]."""
    body = horseshoe(device)
    x = body.mesh.points
    arms = [np.flatnonzero((np.abs(x[:, 0] - side) < 1e-6) & (x[:, 2] > 0.03)) for side in (0.0, 0.05)]
    for nodes, sign in zip(arms, (1.0, -1.0), strict=True):
        body.prescribe(nodes, times=[0.0, 0.1], displacements=[(0, 0, 0), (sign * 0.007, 0, 0)])
    contact = wc.Contact(self_contact=itself)
    sim = wc.Simulation(body, contact=contact, gravity=(0.0, 0.0, 0.0), integrator=integrator)
    left, right = (np.flatnonzero((np.abs(x[:, 0] - side) < 1e-6) & (x[:, 2] > 0.015)) for side in (0.02, 0.03))

    def crossing():
        now = body.positions.numpy()[:, 0].astype(float)
        return now[left].max() - now[right].min()

    return sim, np.concatenate(arms), crossing
