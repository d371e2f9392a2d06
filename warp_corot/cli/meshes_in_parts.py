"""The meshes that several ranks make in parts: boxes, and bodies from surfaces and scans with ``--level``."""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

from warp_corot.errors import InputError
from warp_corot.io.read.volumes import LoadedVolume
from warp_corot.materials.isotropic import Isotropic

from .input_file import bodies_in, offset_of, open_input, refuse_options, with_unit
from .input_mesh import (
    ARGUMENTS,
    CELL_SIZE,
    CELLS,
    InputMesh,
    LabelMaterial,
    box_subject,
    covers_all,
    domain_of,
    fineness_of,
    label_material,
    numbers_by_name,
    parse_labels,
)
from .options import BOX_LEVEL
from .summary import values_line
from .terminal import as_options, complain

#: The options of surfaces and scans beside those of boxes.
OF_ORGANS = {"unit", "up", "cell_size", "surface_error", "threshold", "smoothing", "join", "labels", "materials"}


def is_one_body(args: argparse.Namespace) -> bool:
    """Whether an input is one surface or scan, and not several bodies."""
    opened = open_input(args.input)
    return opened.kind in ("surface", "scan") and len(bodies_in(opened, args)) == 1


def needs_young(args: argparse.Namespace) -> bool:
    """Whether a part of the body has no stiffness if ``--young`` is not given."""
    if args.labels is not None:
        return False
    if args.materials is None or not isinstance(volume := open_input(args.input).loaded, LoadedVolume):
        return True
    named, _ = numbers_by_name(parse_labels(args.materials, "--materials"), volume)
    return bool(len(np.setdiff1d(volume.values, [0, *(number for of_name in named.values() for number in of_name)])))


def box_in_parts(args: argparse.Namespace) -> InputMesh:
    """This rank's part of the box, and its defaults."""
    import warp_corot.distributed as wd

    scale, (x, y, z) = 1.0 if args.scale is None else args.scale, offset_of(args).tolist()
    level = BOX_LEVEL if args.level is None else args.level
    return box_subject(wd.box(CELLS, CELL_SIZE * scale, level, origin=(x, y, z)))


def organ_in_parts(args: argparse.Namespace) -> InputMesh:
    """This rank's part of the body that a surface or a scan encloses, and its defaults.

    Raises:
        InputError: It encloses no body, or an option is out of its range.
    """
    import warp_corot.distributed as wd

    opened = open_input(args.input)
    refuse_options(args, opened)
    opened = with_unit(opened, args)
    entries: list[LabelMaterial] = []
    with as_options(ARGUMENTS):
        domain = domain_of(opened, args, entries)
        mesh = wd.from_domain(domain, **fineness_of(args, domain))
    for note in opened.notes:
        complain(note, kind="note")
    loaded = opened.loaded
    assert loaded is not None
    subject = InputMesh(mesh, loaded.name.encode(errors="replace").decode(), opened.source, labels=entries)
    if opened.asset:
        subject.take(opened.asset, args)
    return subject


def material_in_parts(args: argparse.Namespace, subject: InputMesh, comm: Any) -> Isotropic:
    """The material of this rank's part; all ranks must call this.

    Raises:
        InputError: A value is out of its range, or ``--young`` is given for labels that all have their own.
    """
    given = {name: getattr(args, name) for name in ("young", "poisson", "density")}
    given = {name: getattr(subject, name) if value is None else value for name, value in given.items()}
    if not subject.labels:
        return Isotropic(**given)
    if all(comm.allgather(covers_all(subject.mesh, subject.labels))):
        if args.young is not None:
            raise InputError("--young is given, but --materials gives each label its own")
        given["young"] = subject.labels[0].young  # of no element
    return label_material(subject.mesh, subject.labels, **given)


def material_lines(args: argparse.Namespace, subject: InputMesh) -> list[tuple[str, str]]:
    """The lines of the summary about the material."""
    given = {name: getattr(args, name) for name in ("young", "poisson", "density")}
    given = {name: getattr(subject, name) if value is None else value for name, value in given.items()}
    if not subject.labels:
        return [("material", values_line(**given))]
    lines = []
    for entry in subject.labels:
        own = {name: getattr(entry, name) for name in given}
        own = {name: given[name] if value is None else value for name, value in own.items()}
        lines.append(f"{entry.name}: {values_line(**own)}")
    if given["young"] is not None:
        lines.append(f"all others: {values_line(**given)}")
    return [("" if number else "material", line) for number, line in enumerate(lines)]
