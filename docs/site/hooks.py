"""Hooks for mkdocs: pages outside ``docs/``, notebooks among them, and the targets of links to them.

Pages link to one another by their paths in the repository, so that links work there, too. These hooks convert the links
to those of the site.
"""

import json
import posixpath
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[2]
#: Pages outside ``docs/``, and their paths in the site.
PAGES = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "AGENTS.md": "agents.md",
    "benchmarks/README.md": "figures.md",
    "benchmarks/bodies.md": "bodies.md",
    "benchmarks/history.md": "history.md",
} | {
    path.relative_to(ROOT).as_posix(): f"notebooks/{path.stem}.md"
    for path in (ROOT / "examples" / "notebooks").glob("*.ipynb")
}
#: Files that pages link to and a browser can show.
FILES = [
    "CITATION.cff",
    *(
        path.relative_to(ROOT).as_posix()
        for folder in ("examples", "benchmarks")
        for path in (ROOT / folder).rglob("*.py")
    ),
]
PLACES = PAGES | {name: f"source/{name}.txt" for name in FILES}
LINK = re.compile(r"(?<=\]\()(?!\w+:|#)([^)#\s]+)(?=[)#])")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    for name, place in PLACES.items():
        text = (ROOT / name).read_text(encoding="utf-8")
        files.append(File.generated(config, place, content=in_markdown(text) if name.endswith(".ipynb") else text))
    return files


def in_markdown(notebook: str) -> str:
    """The cells of a notebook as a page; code is fenced."""
    parts = []
    for cell in json.loads(notebook)["cells"]:
        text = "".join(cell["source"])
        parts.append(f"```python\n{text}\n```" if cell["cell_type"] == "code" else text)
    return "\n\n".join(parts) + "\n"


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    here = page.file.src_uri
    of_repository = {place: name for name, place in PAGES.items()}.get(here, f"docs/{here}")

    def led(match: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(posixpath.dirname(of_repository), match[1]))
        place = PLACES.get(target, target.removeprefix("docs/"))
        return posixpath.relpath(place, posixpath.dirname(here) or ".")

    return LINK.sub(led, markdown)
