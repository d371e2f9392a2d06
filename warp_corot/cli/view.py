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

from .patches import press_patches, ramp_of
from .run_file import bodies_of, write_run
from .run_setup import RunSetup, set_up
from .simulate import names_of
from .terminal import interrupt_status

if TYPE_CHECKING:
    from warp_corot.simulation.simulation import Simulation


def run(args: argparse.Namespace) -> int:
    """Run the command; returns the exit status.

    Raises:
        InputError: Bad options, or a page that cannot be opened.
    """
    from warp_corot.viewing.server import check_port, library
    from warp_corot.viewing.view import View

    library()
    check_port(args.host, args.port)
    asked = bodies_of(args)
    ready = set_up(asked, touches=True)
    page = View(
        ready.sim,
        host=args.host,
        port=args.port,
        token=args.token,
        own=[body.subject.drawn() for body in ready.bodies],
        made=lambda sim: _carry_over(ready, asked[0], sim),
        run_file=lambda sim: run_text(asked, sim),
        title=names_of(ready.bodies),  # stiffness and weight may change on the page
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


def _carry_over(ready: RunSetup, shared: argparse.Namespace, sim: Simulation) -> None:
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
        if not any(sim.gravity):
            now.gravity = [0.0, 0.0, 0.0]
        material = sim.bodies[0].material
        if len(sim.bodies) == 1 and type(material) is Isotropic and np.ndim(material.young) == 0:
            now.young, now.poisson = float(material.young), float(material.poisson)
            now.density = float(np.mean(material.density))
        if os.path.exists(now.input):
            now.input = os.path.abspath(now.input)
        found.append(now)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.toml"
        write_run(path, found)
        return path.read_bytes()
