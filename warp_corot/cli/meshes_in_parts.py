"""The meshes that several ranks make in parts: boxes, and bodies from surfaces and scans with ``--level``."""

from __future__ import annotations

import argparse

import numpy as np

from warp_corot.errors import InputError
from warp_corot.experiments import paper

from .applies import refuse_options
from .opened import offset_of, open_input
from .organs import as_options, domain_of, fineness_of
from .say import complain
from .several import bodies_in
from .subject import BOX_LEVEL, Subject, box_subject

#: The options of surfaces and scans beside those of boxes.
OF_ORGANS = {"unit", "up", "cell_size", "surface_error", "threshold", "smoothing", "join"}


def is_one_body(args: argparse.Namespace) -> bool:
    """Whether an input is one surface or scan of one material, and not several bodies."""
    opened = open_input(args.input)
    if opened.volume is not None and args.threshold is None and len(np.setdiff1d(opened.volume.values, 0)) > 1:
        return False
    return opened.kind in ("surface", "scan") and len(bodies_in(opened, args)) == 1


def box_in_parts(args: argparse.Namespace) -> Subject:
    """This rank's part of the box, and its defaults."""
    import warp_corot.distributed as wd

    scale, (x, y, z) = 1.0 if args.scale is None else args.scale, offset_of(args).tolist()
    level = BOX_LEVEL if args.level is None else args.level
    return box_subject(wd.box(paper.CELLS, paper.CELL_SIZE * scale, level, origin=(x, y, z)))


def organ_in_parts(args: argparse.Namespace) -> Subject:
    """This rank's part of the body that a surface or a scan encloses, and its defaults.

    Raises:
        InputError: It encloses no body, or an option is out of its range.
    """
    import warp_corot.distributed as wd

    opened = open_input(args.input)
    refuse_options(args, opened)
    if args.scale is not None and not args.scale > 0.0:
        raise InputError(f"scale is {args.scale:g}; it must be a positive number")
    with as_options():
        domain = domain_of(opened, args, [])
        mesh = wd.from_domain(domain, **fineness_of(args, domain))
    for note in opened.notes:
        complain(note, kind="note")
    loaded = opened.volume or opened.surface
    assert loaded is not None
    subject = Subject(mesh, loaded.name.encode(errors="replace").decode(), opened.source)
    if opened.asset:
        subject.take(opened.asset, args)
    return subject
