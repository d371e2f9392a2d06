"""A wheel installs completely and leaves nothing else behind."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).parents[2]

SCRIPT = """
import pathlib
import numpy as np
import warp_corot as wc
import warp_corot.kernels.elements.elements as elements
assert not pathlib.Path(wc.__file__).is_relative_to({checkout!r}), wc.__file__
assert not pathlib.Path(elements.__file__).is_relative_to({checkout!r}), elements.__file__
mesh = wc.TetForest.box(level=2)
body = wc.SoftBody(mesh, wc.Isotropic(1e4, 0.3, 1000.0), device="cpu")
body.fix(mesh.points[:, 0] == 0)
sim = wc.Simulation(body)
sim.advance_steps(3)
assert np.isfinite(body.positions.numpy()).all()
print("stepped", sim.steps)
"""


def files(folder: Path, under: str = "") -> set[Path]:
    """Sources of a package below a folder."""
    found = (path for pattern in ("*.py", "native/*.h") for path in folder.rglob(pattern))
    return {under / path.relative_to(folder) for path in found}


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """A folder into which the wheel has been installed."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"  # a copy, since a build leaves its own folders behind
    for part in ("warp_corot", "kernels"):
        shutil.copytree(CHECKOUT / part, source / part, ignore=shutil.ignore_patterns("__pycache__"))
    for part in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(CHECKOUT / part, source)
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    build = [*pip, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", str(folder), str(source)]
    subprocess.run(build, check=True)
    (wheel,) = folder.glob("*.whl")
    subprocess.run([*pip, "install", "--no-deps", "--target", str(folder / "site"), str(wheel)], check=True)
    return folder / "site"


def test_the_wheel_works_from_another_folder(site, tmp_path):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT.format(checkout=str(CHECKOUT)))
    environment = {**os.environ, "PYTHONPATH": str(site)}
    done = subprocess.run(
        [sys.executable, str(script)], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "stepped 3"


def test_the_wheel_installs_one_package(site):
    assert {path.name for path in site.iterdir() if not path.name.endswith(".dist-info")} <= {"warp_corot", "bin"}
    assert files(site / "warp_corot") == files(CHECKOUT / "warp_corot") | files(CHECKOUT / "kernels", "kernels")
    assert (site / "warp_corot" / "py.typed").exists()
