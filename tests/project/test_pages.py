"""README, docs and notebooks: every block of code runs, every command is valid, every named file exists.

Rules apply to commands by their program: those of this project are parsed by its own parser, and run if they are
cheap; those that install or check are compared with pyproject.toml. A command without a rule fails.
"""

import ast
import json
import os
import re
import shutil
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import command_line
import pytest
import warp as wp
from pages import EXTRAS, NOTEBOOKS, PAGES, ROOT, Session, blocks_of, commands_of, missing_extras

import warp_corot as wc
from warp_corot.cli import make_parser

#: Inputs that run in a second or two.
CHEAP = ("box", "warp:bear")
#: Programs of the extra ``dev`` that pages call.
TOOLS = {"pytest", "ruff", "mypy", "mkdocs", "mike", "pre-commit"}
#: Names in backticks that are files of this repository.
FILE = re.compile(r"`((?:warp_corot|kernels|tests|benchmarks|examples|docs)/[\w./-]*)`")


def run_warp_corot(words):
    """Parse a command of this project, and run it if that is cheap."""
    options = make_parser().parse_args(words)
    if options.command != "simulate":
        return
    given = str(options.input)
    if given in CHEAP or Path(given).exists():
        assert command_line.run(*words, *command_line.SHORT) == 0, words  # the last of repeated options is used


def check_install(words):
    """Requested extras must exist."""
    named = re.findall(r"\[([\w,]+)\]", " ".join(words))
    asked = {extra for names in named for extra in names.split(",")}
    assert asked <= set(EXTRAS), f"no such extra: {asked - set(EXTRAS)}"


def check_tool(words):
    """The program must come with the extra ``dev``."""
    assert words[0] in TOOLS, words


def check_python(words):
    """A script or a module must exist; a virtual environment and archives may be made."""
    if words[1] == "-m":
        if words[2] in ("venv", "build"):
            return
        path = ROOT / (words[2].replace(".", "/") + ".py")
    else:
        path = ROOT / words[1]
    assert path.is_file(), f"{path} is not there"


RULES = {
    "warp-corot": lambda words: run_warp_corot(words[1:]),
    "pip": check_install,
    "python": check_python,
    "python3": check_python,
    **dict.fromkeys(TOOLS, check_tool),
}


@pytest.fixture(autouse=True)
def closed_figures():
    """Notebooks leave their figures open."""
    yield
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_blocks_run(page, folder, tmp_path_factory, monkeypatch):
    if page in NOTEBOOKS and (missing := missing_extras("".join(block.code for block in blocks_of(page)))):
        pytest.skip(f"{page.name} needs {', '.join(missing)}")
    monkeypatch.setenv("MPLBACKEND", "agg")
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)  # which notebooks change
    session = Session(page, tmp_path_factory.mktemp("source"))
    with wp.ScopedDevice("cpu"):
        for block in blocks_of(page):
            if block.language == "python":
                session.run(block)
            elif block.language == "sh":
                for words in commands_of(block.code):
                    program = words[0].removeprefix(".venv/bin/")
                    assert program in RULES, f"{page.name}:{block.line}: no rule knows {' '.join(words)}"
                    RULES[program]([program, *words[1:]])


@pytest.mark.parametrize("page", NOTEBOOKS, ids=lambda page: page.stem)
def test_notebooks_are_kept_without_outputs(page):
    cells = json.loads(page.read_text(encoding="utf-8"))["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert code
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in code)
    assert len({cell["id"] for cell in cells}) == len(cells)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_named_files_are_there(page):
    for name in FILE.findall(page.read_text(encoding="utf-8")):
        assert (ROOT / name).exists(), f"{page.name} names {name}"


def test_a_file_format_is_added_as_the_recipe_says(tmp_path):
    """The recipe is applied to a copy of the package, which another process then runs."""
    for part in ("warp_corot", "kernels"):
        ignored = shutil.ignore_patterns("__pycache__", "kernels") if part == "warp_corot" else None
        place = tmp_path / "warp_corot" / ("" if part == "warp_corot" else part)
        shutil.copytree(ROOT / part, place, ignore=ignored)
    blocks = blocks_of(ROOT / "docs" / "recipes" / "file_format.md")
    (module,) = (block.code for block in blocks if "def read(path" in block.code)
    (line,) = (block.code for block in blocks if block.language == "text")
    readers = tmp_path / "warp_corot" / "io" / "read"
    (readers / "febio.py").write_text(module, encoding="utf-8")
    listed = (readers / "filemesh.py").read_text(encoding="utf-8")
    head = "READERS: dict[str, tuple[Reader, ...]] = {\n"
    assert head in listed
    (readers / "filemesh.py").write_text(listed.replace(head, head + line), encoding="utf-8")
    (example,) = (block.code for block in blocks if "write_text" in block.code)
    (tmp_path / "block.feb").write_text(re.search(r'"""(.*?)"""', example, re.DOTALL)[1], encoding="utf-8")
    options = ["--materials", "fat=20kPa:0.45,muscle=50kPa:0.45", "--fix", "bottom", "-o", "block.usd"]
    command = [sys.executable, "-m", "warp_corot", "simulate", "block.feb", "--unit", "mm", *options]
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    done = subprocess.run(
        [*command, *command_line.SHORT], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "block.usd").exists()
    assert "muscle" in done.stdout


def test_pictures_are_shown_and_thumbnails_are_small():
    folder = ROOT / "docs" / "images"
    text = "".join(page.read_text(encoding="utf-8") for page in (*PAGES, ROOT / "benchmarks" / "README.md"))
    pictures = [path for path in folder.rglob("*") if path.suffix in (".png", ".gif")]
    assert [path.name for path in pictures if f"images/{path.relative_to(folder).as_posix()})" not in text] == []
    assert all(path.stat().st_size <= 60_000 for path in pictures if path.parent.name == "gallery")


@pytest.mark.parametrize("script", sorted((ROOT / "docs" / "images").glob("*.py")), ids=lambda script: script.stem)
def test_scripts_that_draw_find_what_they_import(script):
    lines = ast.walk(ast.parse(script.read_text(encoding="utf-8")))
    for line in lines:
        if isinstance(line, ast.ImportFrom) and line.module.startswith("warp_corot"):
            assert all(hasattr(import_module(line.module), each.name) for each in line.names), ast.unparse(line)


def test_the_reference_has_every_public_name():
    pages = (ROOT / "docs" / "reference").glob("*.md")
    named = set(re.findall(r"^::: (.+)$", "\n".join(page.read_text(encoding="utf-8") for page in pages), re.MULTILINE))
    public = {f"warp_corot.{name}" for name in wc.__all__}
    for module in ("newton", "distributed"):
        tree = ast.parse((ROOT / "warp_corot" / module / "__init__.py").read_text(encoding="utf-8"))
        (names,) = (ast.literal_eval(node.value) for node in tree.body if assigned(node) == "__all__")
        public |= {f"warp_corot.{module}.{name}" for name in names}
    # Of modules their members.
    assert {
        name for name in public if name not in named and not any(each.startswith(f"{name}.") for each in named)
    } == set()


def assigned(node):
    return node.targets[0].id if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name) else ""


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 150
