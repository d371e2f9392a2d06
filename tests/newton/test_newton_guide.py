"""The code in the guide for writers of solvers does what the guide says."""

import re
from pathlib import Path

import pytest

newton = pytest.importorskip("newton")

GUIDE = Path(__file__).parents[2] / "docs" / "newton_solver_guide.md"


def test_the_guides_code(tmp_path):
    """Block after block, from a file, since kernels need their source."""
    blocks = re.findall(r"```python\n(.*?)```", GUIDE.read_text(encoding="utf-8"), re.DOTALL)
    assert len(blocks) >= 6
    path = tmp_path / "guide.py"
    path.write_text("\n\n".join(blocks))
    scope = {"__name__": "guide", "__file__": str(path)}
    exec(compile(path.read_text(encoding="utf-8"), str(path), "exec"), scope)
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
