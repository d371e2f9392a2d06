"""Every example runs on every device and writes a valid animation."""

import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdGeom

#: Options that make an example short enough for a test.
SHORT = {"sweep": ["--beams", "8"]} | {key: ["--duration", "0.25"] for key in ("remesh", "cut_organ", "resume")}
#: Large packages that examples need and the tests do not install.
NEEDS = {
    "brain": "nilearn",
    "frog": "pyvista",
    "usd_scene": "newton_usd_schemas",
    "with_jax": "jax",
    "with_pytorch": "torch",
}
EXAMPLES = sorted((Path(__file__).parents[2] / "examples").glob("*.py"))


@pytest.mark.parametrize("script", EXAMPLES, ids=lambda script: script.stem)
def test_example(script, device, tmp_path, monkeypatch, capsys):
    if script.stem in NEEDS:
        pytest.importorskip(NEEDS[script.stem])
    output = tmp_path / "out.usd"
    options = ["--device", device, "-o", str(output), "--duration", "0.13", *SHORT.get(script.stem, [])]
    monkeypatch.setattr(sys, "argv", [str(script), *options])
    runpy.run_path(str(script), run_name="__main__")
    said = capsys.readouterr().out
    assert f"wrote {output}" in said
    stage = Usd.Stage.Open(str(output))
    points = UsdGeom.TetMesh.Get(stage, "/SoftBody/tetrahedra").GetPointsAttr()
    first, last = (np.array(points.Get(code)) for code in (0, stage.GetEndTimeCode()))
    assert stage.GetEndTimeCode() >= 3
    assert np.isfinite(last).all()
    if script.stem in ("remesh", "cut_organ"):
        assert len(last) > len(first)  # the mesh was refined, or cut
    else:
        assert np.abs(last - first).max() > 1e-4  # something moves
    if script.stem == "sweep":
        assert output.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    if script.stem == "resume" and device == "cpu":
        assert "differ by 0 m" in said


def test_there_are_examples():
    assert len(EXAMPLES) >= 5
    assert all(len(script.read_text(encoding="utf-8").splitlines()) <= 62 for script in EXAMPLES)
