"""The options of ``warp-corot view``."""

from __future__ import annotations

import argparse

from warp_corot.cli.parsing import COMMANDS
from warp_corot.cli.quantities import whole_number

from .bodies import add_body_options
from .motion import add_motion_options
from .simulate import add_device, add_input, add_options


def add_parser(subparsers: argparse._SubParsersAction) -> argparse.ArgumentParser:
    """Add the command to ``warp-corot``."""
    parser = subparsers.add_parser(
        "view",
        help=COMMANDS["view"],
        description="Opens a page in which a soft body moves and can be dragged, pressed, held and cut with the mouse. "
        'Needs websockets: pip install "warp-corot[view]".',
        epilog="""examples:
  warp-corot view warp:bear
  warp-corot view liver.stl --unit mm --young 5kPa --tets 20000
  warp-corot view box --remesh --port 9000
  warp-corot view run.toml --host 0.0.0.0 --token secret

options and run files are those of simulate. Without --host only browsers on this computer can open the page; where
others can, they need a token, which is part of the address that the command prints.

exit status:
  0    the page was closed (Ctrl-C)
  2    the input or an option was wrong; no page was opened
  143  terminated (SIGTERM)""",
    )
    add_input(parser)
    page = parser.add_argument_group("the page")
    page.add_argument(
        "--host", default="127.0.0.1", metavar="ADDRESS", help="address to listen at (default: 127.0.0.1)"
    )
    page.add_argument("--port", type=whole_number, default=8080, metavar="N", help="port; 0: any free one (8080)")
    page.add_argument(
        "--token",
        metavar="WORD",
        help="word that visitors need, as in http://ADDRESS:N/?token=WORD (default: none on this computer; a random "
        "word where others can reach the address)",
    )
    add_body_options(parser)
    add_motion_options(parser)
    add_device(parser)
    # There are no options here for the files that simulate writes; a run file may still name them.
    whole = argparse.ArgumentParser()
    add_options(whole)
    there = {action.dest for action in parser._actions}
    parser.set_defaults(**{a.dest: a.default for a in whole._actions if a.dest not in there | {"help"}})
    return parser
