"""Static answers of scikit-fem on the same mesh: another program's assembly and solver, in float64."""

import numpy as np
import oracle
import pytest
from cases import jittered

import warp_corot as wc

skfem = pytest.importorskip("skfem")

YOUNG, POISSON, DENSITY, GRAVITY = 500.0, 0.4, 10.0, np.array([0.0, -9.81, 0.0])
MU, LAM = (float(value) for value in oracle.lame(YOUNG, POISSON))
MESHES = {"forest": lambda: wc.TetForest.box((1, 1, 2), 0.064, 3), "general": lambda: jittered(level=3)}


def lowest(mesh):
    return mesh.points[:, 2] < 0.01


class Peer:
    """The same tetrahedra in scikit-fem, with the lowest nodes held."""

    def __init__(self, mesh):
        self.mesh = mesh
        self.basis = skfem.Basis(skfem.MeshTet(mesh.points.T, mesh.tets.T), skfem.ElementVector(skfem.ElementTetP1()))
        self.dofs = self.basis.nodal_dofs.T
        self.held = self.dofs[lowest(mesh)].ravel()
        # Lumped masses are those of a quarter of each element at its nodes, which a constant load has as well.
        self.load = skfem.LinearForm(lambda v, w: DENSITY * np.einsum("i,i...->...", GRAVITY, v)).assemble(self.basis)

    def linear(self):
        from skfem.models.elasticity import linear_elasticity

        K = linear_elasticity(Lambda=LAM, Mu=MU).assemble(self.basis)
        return skfem.solve(*skfem.condense(K, self.load, D=self.held))[self.dofs]

    def neo_hookean(self):
        """Newton's method from rest, under a growing load."""

        def gradient(w):
            F = w["u"].grad + np.eye(3)[:, :, None, None]
            inverse = np.moveaxis(np.linalg.inv(np.moveaxis(F, (0, 1), (-2, -1))), (-2, -1), (1, 0))  # F^-T
            return F, inverse, np.log(np.linalg.det(np.moveaxis(F, (0, 1), (-2, -1))))

        @skfem.LinearForm
        def work(v, w):
            F, inverse, log = gradient(w)
            return np.einsum("ij...,ij...->...", MU * (F - inverse) + LAM * log * inverse, v.grad)

        @skfem.BilinearForm
        def stiffness(u, v, w):
            _, inverse, log = gradient(w)
            turned = np.einsum("ik...,lk...,lj...->ij...", inverse, u.grad, inverse)
            dP = MU * u.grad + (MU - LAM * log) * turned
            dP = dP + LAM * np.einsum("ij...,ij...->...", inverse, u.grad) * inverse
            return np.einsum("ij...,ij...->...", dP, v.grad)

        u = np.zeros(self.basis.N)
        for share in (0.25, 0.5, 0.75, 1.0):
            for _ in range(12):
                there = self.basis.interpolate(u)
                residual = share * self.load - work.assemble(self.basis, u=there)
                step = skfem.solve(*skfem.condense(stiffness.assemble(self.basis, u=there), residual, D=self.held))
                u += step
                if np.abs(step).max() < 1e-12:
                    break
            else:
                raise AssertionError("the reference did not converge")
        return u[self.dofs]


@pytest.mark.parametrize("case", MESHES)
@pytest.mark.parametrize("law", ["linear", "neo_hookean"])
def test_static_answer_equals_scikit_fem(law, case, device):
    mesh = MESHES[case]()
    peer = Peer(mesh)
    expected = getattr(peer, law)()
    body = wc.SoftBody(mesh, wc.Isotropic(YOUNG, POISSON, DENSITY), device=device)
    body.fix(lowest(mesh))
    model = {"linear": wc.Linear, "neo_hookean": wc.NeoHookean}[law](dilatation="element")
    assert wc.solve_static(body, model=model, gravity=GRAVITY).converged
    error = np.abs(body.displacements.numpy() - expected).max() / np.abs(expected).max()
    print(f"{error:.1e} of the largest displacement, {np.abs(expected).max():.3g} m")
    assert error < 1e-5
