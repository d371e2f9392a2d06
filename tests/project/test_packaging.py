"""The source archive and the wheel are complete, and the installed wheel runs from any folder."""

import os
import shutil
import subprocess
import sys
import tarfile
from pathlib import Path

import pytest
from pages import PROJECT, ROOT

SCRIPT = """
import pathlib
import numpy as np
import warp_corot as wc
import warp_corot.kernels.elements.elements as elements
for module in (wc, elements):
    assert pathlib.Path(module.__file__).is_relative_to({site!r}), module.__file__
mesh = wc.TetForest.box(level=2)
body = wc.SoftBody(mesh, wc.Isotropic(1e4, 0.3, 1000.0), device="cpu")
body.displacements = 0.1 * mesh.points
forces = wc.NeoHookean().bind(body).elastic_forces(body.state.displacements).numpy()
assert np.isfinite(forces).all()
print("forces", np.abs(forces).max() > 0.0)
"""


def files(folder: Path, under: str) -> set[str]:
    """All files of a package in the repository, as the wheel names them."""
    paths = (path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
    return {f"{under}/{path.as_posix()}" for path in paths if "__pycache__" not in path.parts}


EXPECTED = files(ROOT / "warp_corot", "warp_corot") | files(ROOT / "kernels", "warp_corot/kernels")


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> Path:
    """A folder with both archives, and with ``site``, into which the wheel has been installed."""
    folder = tmp_path_factory.mktemp("built")
    source = folder / "source"  # a copy, since a build leaves its own folders behind
    for part in ("warp_corot", "kernels"):
        shutil.copytree(ROOT / part, source / part, ignore=shutil.ignore_patterns("__pycache__"))
    for part in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / part, source)
    run(folder, "-m", "build", "--no-isolation", "--outdir", folder, source)  # the wheel is made of the source archive
    (wheel,) = folder.glob("*.whl")
    pip = ["-m", "pip", "--quiet", "--disable-pip-version-check"]
    run(folder, *pip, "install", "--no-deps", "--no-compile", "--target", folder / "site", wheel)
    return folder


def run(folder: Path, *words: object, path: Path | None = None) -> str:
    """What Python prints, started in a folder and without the repository on its path."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment |= {"PYTHONPATH": str(path)} if path else {}
    command = [sys.executable, *map(str, words)]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_the_archives_hold_every_file_of_the_packages(built):
    site = built / "site"
    assert any(name.endswith(".h") for name in EXPECTED)
    installed = {path.relative_to(site).as_posix() for path in site.rglob("*") if path.is_file()}
    assert {name for name in installed if not name.startswith((f"{built_name()}.dist-info/", "bin/"))} == EXPECTED
    with tarfile.open(built / f"{built_name()}.tar.gz") as archive:
        packed = {name.partition("/")[2] for name in archive.getnames()}
    assert {name.replace("warp_corot/kernels/", "kernels/") for name in EXPECTED} <= packed


def test_the_installed_command_and_package_work_from_another_folder(built, tmp_path):
    site = built / "site"
    command = site / "bin" / "warp-corot"
    assert run(tmp_path, command, "--version", path=site).split()[1] == PROJECT["version"]
    script = tmp_path / "script.py"
    script.write_text(SCRIPT.format(site=str(site)))
    assert run(tmp_path, script, path=site).splitlines()[-1] == "forces True"


def built_name() -> str:
    return f"{PROJECT['name'].replace('-', '_')}-{PROJECT['version']}"


def test_the_citation_names_this_version():
    assert f"\nversion: {PROJECT['version']}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
