"""Damaged files and random option lists: a body, or one line and status 2; no traceback, crash, hang or touched file.

A short run has thirty cases of a format, each 2 to 5 ms, and fewer where they take longer; ``-m slow`` has ten
thousand. Each case is identified by its format and number: ``python tests/support/fuzzing.py FOLDER FORMAT NUMBER
NUMBER+1`` makes it again.
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import fuzz_damage
import fuzzing
import numpy as np
import pytest

SCRIPT = Path(fuzzing.__file__)
SOME, MANY = 30, 10_000
#: Formats with fewer in the short run. A series of ten files and some surfaces of VTK ask for gigabytes (200, 15 ms),
#: and bodies are made (10 ms).
FEWER = {"dicom": 1, "vtp": 25, "checkpoint-remesh": 20}
#: OpenUSD reads binary stages in the command's own process, which fewer than one in so many of them end.
ENDS_ONE_IN = {"usdc": 1000, "usdc-tets": 1000}
#: Formats whose reader is tested by another format in the short run.
LONG_ONLY = {"usda-tets", "scene", "nii", "checkpoint", "meshb", "vol", "med", "su2"}
SHORT = [form for form in fuzzing.SEEDS if form not in LONG_ONLY]
#: Tests of the short run, which run in parallel; each takes seconds to begin, and the last one imports Newton, too.
PARTS = 2
#: A folder in memory: on disk, a case waits for its damaged file to be written.
MEMORY, ROOM = Path("/dev/shm"), 1 << 30


@pytest.fixture
def folder(tmp_path):
    if not os.access(MEMORY, os.W_OK) or shutil.disk_usage(MEMORY).free < ROOM:
        yield tmp_path
        return
    with tempfile.TemporaryDirectory(dir=MEMORY) as path:
        yield Path(path)


def cases(folder: Path, forms: dict[str, int]) -> list[dict]:
    """The results of so many cases of each format."""
    path = os.pathsep.join([str(SCRIPT.parent), *filter(None, sys.path)])
    counts = ",".join(f"{form}:{count}" for form, count in forms.items())
    command = [sys.executable, str(SCRIPT), str(folder), counts, "0", "0"]
    environment = os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, errors="replace")
    assert done.returncode == 0, done.stderr[-3000:]
    return [json.loads(line) for line in (folder / "cases").read_text(encoding="utf-8").splitlines()]


def check(folder: Path, forms: dict[str, int]) -> None:
    """No case failed; many were refused, a hundredth of each format's at least."""
    said = cases(folder, forms)
    crashed = [each for each in said if each["form"] in ENDS_ONE_IN and "ended with" in each.get("wrong", "")]
    for form, many in ENDS_ONE_IN.items():
        assert sum(each["form"] == form for each in crashed) <= forms.get(form, 0) / many
    wrong = [
        f"{each['form']} {each['case']}: {each['wrong']}" for each in said if "wrong" in each and each not in crashed
    ]
    assert not wrong, "\n".join(wrong[:5])
    for form, count in forms.items():
        done = [each for each in said if each["form"] == form and "seconds" in each]
        ended = [each for each in said if each["form"] == form and "ended" in each]
        assert len(done) + len(ended) + sum(each["form"] == form for each in crashed) == count
        assert sum(not each["taken"] for each in done) >= count // 50
    assert sum(not each.get("taken", True) for each in said) > len(forms)


@pytest.mark.parametrize("part", range(PARTS))
def test_a_body_or_one_line(part, folder):
    forms = SHORT[part::PARTS] + ["options"] * (part == PARTS - 1)
    check(folder, {form: FEWER.get(form, SOME) for form in forms})


@pytest.mark.slow
@pytest.mark.parametrize("form", [*fuzzing.SEEDS, "options"])
def test_a_body_or_one_line_of_many(form, folder):
    check(folder, {form: MANY})


@pytest.mark.parametrize("form", ["ply", "usdc", "nii", "checkpoint"])
def test_damage_is_damage(form, tmp_path):
    """Few of the damaged files equal the originals, and the same number gives the same file."""
    good = fuzzing.SEEDS[form](tmp_path).read_bytes()
    made = [fuzz_damage.damaged(good, np.random.default_rng(k)) for k in range(40)]
    assert sum(data == good for data in made) < 8
    assert made == [fuzz_damage.damaged(good, np.random.default_rng(k)) for k in range(40)]
