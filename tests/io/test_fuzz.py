"""Damaged files and random option lists: a body, or one line and status 2; no traceback, crash, hang or touched file.

Some of each in a short run, ten thousand with ``-m slow``. Each case is known by its format and number:
``python tests/support/fuzzing.py FOLDER FORMAT NUMBER NUMBER+1`` makes it again.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import fuzzing
import pytest

SCRIPT = Path(fuzzing.__file__)
FEW, MANY = 60, 10_000
#: In whose place another format stands in the short run: both go to the same reader, or another test has them too.
LONG_ONLY = {"stl-text", "off", "msh", "msh-text", "vtk-text", "vtu", "inp", "mesh", "nrrd-gz", "usda-tets"}
ALL = [*fuzzing.SEEDS, "options"]


def failures(folder: Path, forms: list[str], count: int) -> list[dict]:
    """What is wrong with so many cases of each format; a case that ends the process is wrong, too."""
    cases = folder / "cases"
    path = os.pathsep.join([str(SCRIPT.parent), *filter(None, sys.path)])
    first, crashed, lines = 0, [], []
    while forms:
        command = [sys.executable, str(SCRIPT), str(folder), ",".join(forms), str(first), str(count)]
        done = subprocess.run(command, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True)
        lines = [json.loads(line) for line in cases.read_text(encoding="utf-8").splitlines()] if cases.exists() else []
        if done.returncode == 0:
            break
        assert lines, done.stderr
        last = lines[-1]
        if "reads" not in last:  # such a reader has a process of its own to crash in
            crashed.append({**last, "wrong": f"ended with status {done.returncode}", "said": done.stderr[-2000:]})
        for file in (folder / last["form"]).iterdir():
            file.unlink()
        forms, first = forms[forms.index(last["form"]) :], last["case"] + 1
        if first >= count:
            forms, first = forms[1:], 0
    return crashed + [line for line in lines if "wrong" in line]


def in_words(found: list[dict]) -> str:
    return "\n".join(f"{each['form']} {each['case']}: {each['wrong']} {each.get('said', '')}" for each in found[:5])


def test_a_body_or_one_line(tmp_path):
    found = failures(tmp_path, [form for form in ALL if form not in LONG_ONLY], FEW)
    assert not found, in_words(found)


@pytest.mark.slow
@pytest.mark.parametrize("form", ALL)
def test_a_body_or_one_line_of_many(form, tmp_path):
    found = failures(tmp_path, [form], MANY)
    assert not found, in_words(found)


@pytest.mark.parametrize("form", ["ply", "usdc", "nii", "checkpoint"])
def test_damage_is_damage(form, tmp_path, rng):
    """Few of the damaged files are as they were, and the same number gives the same file."""
    good = fuzzing.SEEDS[form](tmp_path).read_bytes()
    made = [fuzzing.damaged(good, fuzzing.np.random.default_rng(k)) for k in range(40)]
    assert sum(data == good for data in made) < 8
    assert made == [fuzzing.damaged(good, fuzzing.np.random.default_rng(k)) for k in range(40)]
