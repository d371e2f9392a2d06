"""The options of ``warp-corot view``."""

from __future__ import annotations

from dataclasses import dataclass

from warp_corot.cli.quantities import WholeNumber

from .run import (
    BodyOptions,
    ContactOptions,
    DeviceOptions,
    InputOptions,
    MotionOptions,
    OrganOptions,
    RemeshOptions,
    RunOptions,
)

DESCRIPTION = """Opens a page in which a soft body moves and can be dragged, pressed, held and cut with the mouse. \
Needs websockets: pip install "warp-corot[view]"."""
EPILOG = """examples:
  warp-corot view warp:bear
  warp-corot view liver.stl --unit mm --young 5kPa --tets 20000
  warp-corot view box --remesh --port 9000
  warp-corot view run.toml --host 0.0.0.0 --token secret

options and run files are those of simulate. Without --host only browsers on this computer can open the page; where
others can, they need a token, which is part of the address that the command prints.

exit status:
  0    the page was closed (Ctrl-C)
  2    the input or an option was wrong; no page was opened
  143  terminated (SIGTERM)"""


@dataclass(kw_only=True)
class PageOptions:
    """The page.

    Attributes:
        host (ADDRESS): address to listen at (default: 127.0.0.1)
        port (N): port; 0: any free one (8080)
        token (WORD): word that visitors need, as in http://ADDRESS:N/?token=WORD (default: none on this computer; a
            random word where others can reach the address)
    """

    TITLE = "the page"

    host: str = "127.0.0.1"
    port: WholeNumber = 8080
    token: str | None = None


@dataclass(kw_only=True)
class ViewOptions(
    DeviceOptions, RemeshOptions, ContactOptions, MotionOptions, OrganOptions, BodyOptions, PageOptions, InputOptions
):
    """A page in place of the files that ``simulate`` writes, which a run file may still name."""


OPTIONS, FILES = ViewOptions, RunOptions
