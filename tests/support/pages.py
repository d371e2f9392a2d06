"""README and docs for tests: their blocks of code, run in a reader's order."""

from __future__ import annotations

import ast
import json
import re
import shlex
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "examples" / "notebooks").glob("*.ipynb"))
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "AGENTS.md")),
    *sorted((ROOT / "docs").rglob("*.md")),
    *NOTEBOOKS,
]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS = PROJECT["optional-dependencies"]
#: Languages of blocks; a text does not run.
LANGUAGES = ("python", "sh", "text")


@dataclass(frozen=True)
class Block:
    """A fenced block.

    Attributes:
        language: One of ``LANGUAGES``.
        line: The first line of its code, from 1.
        code: What is between the fences.
    """

    language: str
    line: int
    code: str


def blocks_of(page: Path) -> list[Block]:
    """The blocks of a page, in order; the cells of a notebook's code.

    Raises:
        ValueError: A fence that is not closed, or a block without a language.
    """
    found, start, language = [], 0, ""
    if page.suffix == ".ipynb":
        for cell in json.loads(page.read_text(encoding="utf-8"))["cells"]:
            if cell["cell_type"] == "code":
                found.append(Block("python", start + 1, "".join(cell["source"]) + "\n"))
            start += len(cell["source"])
        return found
    lines = page.read_text(encoding="utf-8").splitlines()
    for number, line in enumerate(lines, start=1):
        if not line.startswith("```"):
            continue
        if start:
            found.append(Block(language, start, "\n".join(lines[start - 1 : number - 1]) + "\n"))
            start = 0
        else:
            start, language = number + 1, line[3:].strip()
            if language not in LANGUAGES:
                raise ValueError(f"{page.name}:{number}: a block of {language or 'no language'}")
    if start:
        raise ValueError(f"{page.name}:{start - 1}: a fence that is not closed")
    return found


class Session:
    """The Python of one page: all blocks share their names, and Warp finds the source of kernels.

    Args:
        page: The page.
        folder: Folder for its source, with each block on its lines in the page.
    """

    def __init__(self, page: Path, folder: Path):
        self._blocks = [block for block in blocks_of(page) if block.language == "python"]
        self._file = folder / f"{page.stem}_{page.suffix[1:]}.py"
        lines: list[str] = []
        for block in self._blocks:
            lines += [""] * (block.line - 1 - len(lines)) + block.code.splitlines()
        self._file.write_text("\n".join(lines) + "\n", encoding="utf-8")
        self.scope: dict[str, Any] = {"__name__": self._file.stem, "__file__": str(self._file)}

    def run(self, block: Block) -> None:
        """Run a block, unless an extra that it imports is not installed."""
        if missing_extras(block.code):
            return
        code = "\n" * (block.line - 1) + block.code
        exec(compile(code, str(self._file), "exec", dont_inherit=True), self.scope)


def run_python(page: Path, folder: Path) -> dict[str, Any]:
    """The names that the Python blocks of a page define."""
    session = Session(page, folder)
    for block in blocks_of(page):
        if block.language == "python":
            session.run(block)
    return session.scope


def missing_extras(code: str) -> list[str]:
    """Packages that some code imports at its top, that an extra of the project installs, and that are missing."""
    imported = set()
    for node in ast.parse(code).body:
        if isinstance(node, ast.Import):
            imported |= {name.name.partition(".")[0] for name in node.names}
        elif isinstance(node, ast.ImportFrom):
            imported.add((node.module or "").partition(".")[0])
    if "warp_corot.distributed" in code:
        imported.add("mpi4py")
    optional = {re.split(r"[\[>=<]", need)[0] for needs in EXTRAS.values() for need in needs}
    return [name for name in sorted(imported & optional) if find_spec(name) is None]


def commands_of(code: str) -> Iterator[list[str]]:
    """The commands of a shell block, word by word; those joined by ``&&`` one by one."""
    for line in code.replace("\\\n", " ").splitlines():
        words = shlex.split(line, comments=True)
        while "&&" in words:
            place = words.index("&&")
            yield words[:place]
            words = words[place + 1 :]
        if words:
            yield words
