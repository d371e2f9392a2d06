"""One of Newton's viewers for an example, on machines with and without a display."""

from __future__ import annotations

import argparse
import os
import sys
from importlib.util import find_spec
from typing import Any

from .library import examples

#: Packages that viewers need besides Newton.
NEEDS = {"gl": "pyglet", "rerun": "rerun", "viser": "viser", "usd": "pxr"}


def has_display() -> bool:
    """Whether a window can be opened: on Linux, a display server must be named."""
    return not sys.platform.startswith("linux") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def open_viewer(name: str, parser: argparse.ArgumentParser | None = None) -> tuple[Any, argparse.Namespace]:
    """The viewer that the command line names, as ``newton.examples.init`` makes it, and the command line's arguments.

    If it names none and there is no display, or no package for a window, the frames go to a USD file, and a line says
    so. ``--viewer gl`` without a display draws off screen.

    Args:
        name: Name of the example; the file is NAME.usd unless ``--output-path`` names another.
        parser: A parser with the example's own options; None: Newton's.

    Raises:
        SystemExit: A package is missing, or the viewer cannot start; one line says so.
    """
    try:
        newtons = examples()
    except ImportError as error:
        raise SystemExit(f"Newton's examples need a package that is missing: {error}") from None
    parser = newtons.create_parser() if parser is None else parser
    parser.set_defaults(output_path=f"{name}.usd")
    window = has_display() and find_spec(NEEDS["gl"]) is not None
    if not window:
        parser.set_defaults(viewer="usd")
    given = parser.parse_known_args()[0]
    named = any(word.startswith("--viewer") for word in sys.argv[1:])
    if not window and not named:
        why = "no display" if not has_display() else f"no {NEEDS['gl']} for a window"
        print(f"there is {why}: frames go to {given.output_path} (--viewer names another viewer)", file=sys.stderr)
    missing = NEEDS.get(given.viewer)
    if missing is not None and find_spec(missing) is None:
        raise SystemExit(f'--viewer {given.viewer} needs {missing}: pip install "warp-corot[viewers]"')
    if given.viewer == "gl" and not has_display():
        os.environ.setdefault("PYGLET_HEADLESS", "1")  # read when pyglet is imported
        parser.set_defaults(headless=True)
    try:
        return newtons.init(parser)
    except Exception as error:
        raise SystemExit(f"--viewer {given.viewer} cannot start: {' '.join(str(error).split())[:200]}") from None
