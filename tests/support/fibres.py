"""Materials with directions that the tests of anisotropy and activation share."""

import numpy as np
import oracle

import warp_corot as wc

DENSITY = 1000.0
MUSCLE = {
    "young_along": 3e4,
    "young_across": 8e3,
    "poisson_along": 0.4,
    "poisson_across": 0.5,
    "shear_along": 4e3,
}
WOOD = {"young": [3e4, 8e3, 4e3], "poisson": [0.4, 0.3, 0.45], "shear": [6e3, 2e3, 5e3]}


def random_axes(rng, *shape):
    return oracle.polar(rng.standard_normal((*shape, 3, 3)))


def muscle(direction, **others):
    return wc.TransverselyIsotropic(**(MUSCLE | {"density": DENSITY} | others), direction=direction)


def wood(axes, **others):
    return wc.Orthotropic(**(WOOD | {"density": DENSITY} | others), axes=axes)


def muscle_tensor(directions):
    """C in rest space for each direction [T, 3]."""
    tensor = oracle.elasticity(*oracle.transverse(*MUSCLE.values()))
    first = np.asarray(directions) / np.linalg.norm(directions, axis=-1, keepdims=True)
    aside = np.roll(first, 1, axis=-1) + np.array([0.1, 0.2, 0.3])
    second = np.cross(first, aside)
    second /= np.linalg.norm(second, axis=-1, keepdims=True)
    return turned(tensor, np.stack([first, second, np.cross(first, second)], axis=-2))


def wood_tensor(axes):
    return turned(oracle.elasticity(*WOOD.values()), np.asarray(axes))


def turned(tensor, axes):
    return np.einsum("abcd,...ai,...bj,...ck,...dm->...ijkm", tensor, axes, axes, axes, axes, optimize=True)


def simulated(mesh, material, device, *, model=None, worlds=1, dt=1e-5, **options):
    body = wc.SoftBody(mesh, material, worlds=worlds, device=device)
    sim = wc.Simulation(body, model=model, integrator=wc.SymplecticEuler(dt=dt), gravity=(0, 0, 0), **options)
    return sim, body


class Bar:
    """A free bar of 1 x 1 x 2 cubes along z: statics by damped steps, at small strains."""

    EDGE = 0.1

    def __init__(self, material, device):
        self.mesh = wc.TetForest.box((1, 1, 2), self.EDGE, 3)
        self.body = wc.SoftBody(self.mesh, material, device=device)
        # Nearly critical for the slowest mode, with wave speed (E / rho)^1/2 along a bar of 0.2 m.
        self.sim = wc.Simulation(self.body, integrator=wc.SymplecticEuler(damping=60.0), gravity=(0, 0, 0))

    def pull(self, stress):
        """Tension sigma_zz = ``stress`` on both ends, distributed consistently to their nodes."""
        reference = oracle.Mesh(self.mesh.points, self.mesh.tets)
        traction = np.zeros((3, 3))
        traction[2, 2] = stress
        # A body in equilibrium with a constant stress is loaded only by its surface tractions.
        nodal = reference.assemble(np.einsum("t,ij,taj->tai", reference.volumes, traction, reference.gradients))
        self.body.load(np.arange(len(nodal)), nodal)

    def strain(self, seconds=0.6):
        """Mean of sym(du/dX) at rest [3, 3], and the largest deviation of single elements."""
        self.sim.advance(seconds)
        reference = oracle.Mesh(self.mesh.points, self.mesh.tets)
        gradients = reference.deformation_gradients(self.body.displacements.numpy().astype(float))
        strains = 0.5 * (gradients + np.swapaxes(gradients, 1, 2))
        mean = np.einsum("t,tij->ij", reference.volumes, strains) / reference.volumes.sum()
        return mean, np.abs(strains - mean).max()


def made(kind, mesh, rng):
    """A material and its tensor C, [3, 3, 3, 3] or one for each element."""
    axes = random_axes(rng, len(mesh.tets)) if "field" in kind else random_axes(rng)
    if "muscle" in kind:
        return muscle(2.5 * axes[..., 0, :]), muscle_tensor(axes[..., 0, :])
    return wood(0.1 * axes), wood_tensor(axes)
