"""``warp-corot view``: a soft body on a page in a browser, where the mouse can drag it."""

from __future__ import annotations

import argparse
import copy
import os
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from warp_corot.elasticity import MODELS
from warp_corot.elasticity.dilatation import AUTO
from warp_corot.errors import InputError
from warp_corot.materials.isotropic import Isotropic

from . import options
from .loading import ramp_of
from .parsing import COMMANDS
from .prepared import Run, prepared
from .pressing import press_patches
from .quantities import whole_number
from .run_file import bodies_of, write_run
from .say import interrupt_status
from .summary import title_of

if TYPE_CHECKING:
    from warp_corot.simulation.simulation import Simulation

__all__ = ["add_parser", "run"]


def add_parser(subparsers: argparse._SubParsersAction) -> argparse.ArgumentParser:
    """Add the command to ``warp-corot``."""
    parser = subparsers.add_parser(
        "view",
        help=COMMANDS["view"],
        description="Opens a page in which a soft body moves and can be dragged, pressed, held and cut with the mouse. "
        'Needs viser: pip install "warp-corot[view]".',
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
    options.add_input(parser)
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
    options.add_scene_options(parser)
    options.add_device(parser)
    # There are no options here for the files that simulate writes; a run file may still name them.
    whole = argparse.ArgumentParser()
    options.add_options(whole)
    there = {action.dest for action in parser._actions}
    parser.set_defaults(**{a.dest: a.default for a in whole._actions if a.dest not in there | {"help"}})
    return parser


def run(args: argparse.Namespace) -> int:
    """Run the command; returns the exit status.

    Raises:
        InputError: Bad options, or a page that cannot be opened.
    """
    from warp_corot.viewing.gate import check_port
    from warp_corot.viewing.server import library
    from warp_corot.viewing.view import View

    library()
    check_port(args.host, args.port)
    asked = bodies_of(args)
    ready = prepared(asked)
    page = View(
        ready.sim,
        host=args.host,
        port=args.port,
        token=args.token,
        own=[body.subject.skin or body.subject.surface for body in ready.bodies],
        made=lambda sim: _carry_over(ready, asked[0], sim),
        run_file=lambda sim: run_text(asked, sim),
        title=title_of(ready.bodies),
    )
    try:
        print(f"the page is at {page.address} (Ctrl-C ends it)", flush=True)
        page.run()
    except KeyboardInterrupt as signalled:
        status = interrupt_status(signalled)
        return 0 if status == 130 else status
    finally:
        with suppress(KeyboardInterrupt):
            page.close()
    return 0


def _carry_over(ready: Run, shared: argparse.Namespace, sim: Simulation) -> None:
    """Press the patches of the new bodies.

    Raises:
        InputError: A pressed body has a new mesh, for which the pressed patches are not known.
    """
    for body, soft in zip(ready.bodies, sim.bodies, strict=True):
        if any(load.kind == "press" for load in body.loads) and soft.mesh is not body.subject.mesh:
            raise InputError("a body that is pressed and has been remeshed cannot be switched")
    for body, soft in zip(ready.bodies, sim.bodies, strict=True):
        body.soft = soft
        press_patches(sim, soft, body.loads, body.patches, ramp_of(shared, ready.duration))


def run_text(asked: Sequence[argparse.Namespace], sim: Simulation) -> bytes:
    """The run on the page as a run file for ``simulate``: the given options, with the present law and remeshing.

    A uniform material is the present one; regions and labels keep the given materials.
    """
    found = []
    for args in asked:
        now = copy.copy(args)
        model, remesh = sim.models[0], sim.remesh[0]
        now.model = next(name for name, kind in MODELS.items() if type(model) is kind)
        now.rotation_level = getattr(model, "rotation_level", None)
        dilatation = getattr(model, "dilatation", AUTO)
        now.dilatation = None if dilatation == AUTO else dilatation
        now.remesh = remesh is not None
        if not now.remesh:
            now.refine_above = now.simplify_below = now.remesh_levels = now.remesh_every = now.capacity = None
        material = sim.bodies[0].material
        if len(sim.bodies) == 1 and type(material) is Isotropic and np.ndim(material.young) == 0:
            now.young, now.poisson = float(material.young), float(material.poisson)
        if os.path.exists(now.input):
            now.input = os.path.abspath(now.input)
        found.append(now)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.toml"
        write_run(path, found)
        return path.read_bytes()
