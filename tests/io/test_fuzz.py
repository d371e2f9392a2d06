"""Damaged files and random option lists: a body, or one line and status 2; no traceback, crash, hang or touched file.

A short run has some of each; ``-m slow`` has ten thousand. Each case is identified by its format and number:
``python tests/support/fuzzing.py FOLDER FORMAT NUMBER NUMBER+1`` makes it again.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import fuzz_damage
import fuzzing
import numpy as np
import pytest

SCRIPT = Path(fuzzing.__file__)
FEW, MANY = 10, 10_000
#: Formats whose reader is tested by another format in the short run.
LONG_ONLY = {
    *("ply-text", "off", "stl-text", "usdz", "usda-tets", "scene", "nii", "mgh", "nrrd-gz", "mhd", "checkpoint"),
    *("msh-2", "msh-2-binary", "meshb", "vol", "med", "avs", "f3grid", "su2"),
    *("vtk", "vtk-text", "vtk-image", "vtu-text", "vtu-meshio", "vts", "vtr"),
}
SHORT = [form for form in fuzzing.SEEDS if form not in LONG_ONLY]
#: Tests of the short run, which run in parallel; each takes seconds to begin.
PARTS = 2


def cases(folder: Path, forms: list[str], count: int) -> list[dict]:
    """The results of this many cases of each format."""
    path = os.pathsep.join([str(SCRIPT.parent), *filter(None, sys.path)])
    command = [sys.executable, str(SCRIPT), str(folder), ",".join(forms), "0", str(count)]
    environment = os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, errors="replace")
    assert done.returncode == 0, done.stderr[-3000:]
    return [json.loads(line) for line in (folder / "cases").read_text(encoding="utf-8").splitlines()]


def check(folder: Path, forms: list[str], count: int) -> None:
    """No case failed; many were refused, a hundredth of each format's at least."""
    said = cases(folder, forms, count)
    wrong = [f"{each['form']} {each['case']}: {each['wrong']}" for each in said if "wrong" in each]
    assert not wrong, "\n".join(wrong[:5])
    for form in forms:
        done = [each for each in said if each["form"] == form and "seconds" in each]
        ended = [each for each in said if each["form"] == form and "ended" in each]
        assert len(done) + len(ended) == count
        assert sum(not each["taken"] for each in done) >= count // 100
    assert sum(not each.get("taken", True) for each in said) > len(forms)


@pytest.mark.parametrize("part", range(PARTS))
def test_a_body_or_one_line(part, tmp_path):
    check(tmp_path, [*SHORT, "options"][part::PARTS], FEW)


@pytest.mark.slow
@pytest.mark.parametrize("form", [*fuzzing.SEEDS, "options"])
def test_a_body_or_one_line_of_many(form, tmp_path):
    check(tmp_path, [form], MANY)


@pytest.mark.parametrize("form", ["ply", "usdc", "nii", "checkpoint"])
def test_damage_is_damage(form, tmp_path):
    """Few of the damaged files equal the originals, and the same number gives the same file."""
    good = fuzzing.SEEDS[form](tmp_path).read_bytes()
    made = [fuzz_damage.damaged(good, np.random.default_rng(k)) for k in range(40)]
    assert sum(data == good for data in made) < 8
    assert made == [fuzz_damage.damaged(good, np.random.default_rng(k)) for k in range(40)]
