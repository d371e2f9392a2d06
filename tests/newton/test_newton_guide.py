"""The code in the solver guide does what the guide says."""

import pytest
from pages import ROOT, run_python

newton = pytest.importorskip("newton")


def test_the_guides_code(tmp_path):
    scope = run_python(ROOT / "docs" / "newton_solver_guide.md", tmp_path)
    height = scope["state_0"].particle_q.numpy()[0, 2]
    # Symplectic Euler: g dt^2 n (n + 1) / 2 below.
    assert height == pytest.approx(1.0 - 9.81 * 1e-6 * 100 * 101 / 2, abs=1e-5)
    assert isinstance(scope["others"], newton.solvers.SolverSemiImplicit)
    builder = newton.ModelBuilder()
    scope["SolverWithMemory"].register_custom_attributes(builder)
    for corner in ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)):
        builder.add_particle(corner, (0, 0, 0), 1.0)
    builder.add_tetrahedron(0, 1, 2, 3)
    assert builder.finalize().state().my_solver.rotation.numpy().tolist() == [[0.0, 0.0, 0.0, 1.0]]
