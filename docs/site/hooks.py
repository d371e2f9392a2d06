"""Hooks for mkdocs: pages outside ``docs/``, and the targets of links to them.

Pages link to one another by their paths in the repository, so that links work there, too. These hooks convert the links
to those of the site.
"""

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
    "benchmarks/README.md": "figures.md",
    "benchmarks/bodies.md": "bodies.md",
}
#: Files that pages link to and a browser can show.
FILES = [
    path.relative_to(ROOT).as_posix() for folder in ("examples", "benchmarks") for path in (ROOT / folder).rglob("*.py")
]
PLACES = PAGES | {name: f"source/{name}.txt" for name in FILES}
LINK = re.compile(r"(?<=\]\()(?!\w+:|#)([^)#\s]+)(?=[)#])")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    for name, place in PLACES.items():
        files.append(File.generated(config, place, content=(ROOT / name).read_text(encoding="utf-8")))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    here = page.file.src_uri
    of_repository = {place: name for name, place in PAGES.items()}.get(here, f"docs/{here}")

    def led(match: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(posixpath.dirname(of_repository), match[1]))
        place = PLACES.get(target, target.removeprefix("docs/"))
        return posixpath.relpath(place, posixpath.dirname(here) or ".")

    return LINK.sub(led, markdown)
