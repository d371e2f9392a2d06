"""A user's values reach the kernels through few files; ``tests/support/walks.py`` prints the files."""

import re

import pytest
from imports import ROOT
from walks import files_and_returns, walks

#: Kernels that get each word, or what was made of it; a body's parts go to them, not the body.
KERNELS = {
    "young": "kernels/elements/lanes.py",
    "dt": "kernels/stepping/integrate.py",
    "rotation_level": "kernels/plan/lists.py",
    "body": None,
}


@pytest.mark.parametrize(
    "word", [*(pytest.param(word, marks=pytest.mark.slow) for word in ("young", "dt")), "rotation_level", "body"]
)
def test_ways_are_no_longer_than_the_page_says(word):
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    files, returns = files_and_returns(walks([word])[word])
    assert KERNELS[word] is None or KERNELS[word] in files
    said = re.search(rf"^\| `{word}` \| (\d+) \| (\d+) \|", page, re.MULTILINE)
    assert len(files) <= int(said[1]), files
    assert returns <= int(said[2]), files
