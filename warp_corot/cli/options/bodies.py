"""Options that describe bodies, which ``simulate`` and ``view`` share."""

from __future__ import annotations

import argparse

from warp_corot.cli.quantities import (
    density,
    metres,
    number,
    pressure,
    rotation_level,
    unit_of_length,
    value_range,
    whole_number,
)
from warp_corot.inputs.choices import ELEMENT, MODELS, SHARED

from .defaults import BOX_LEVEL, CUBES_OF_LEVEL, MAX_LEVEL_FOR_ERROR, STIFFNESS_PER_WEIGHT, TETS

#: Models that the command line has options for.
CHOICES = [name for name in MODELS if name not in ("holzapfel-gasser-ogden", "prestressed", "prony")]


def add_body_options(parser: argparse.ArgumentParser) -> None:
    """Add the options to a parser."""
    body = parser.add_argument_group("the body")
    body.add_argument(
        "--unit",
        type=unit_of_length,
        metavar="LENGTH",
        help="unit of the file's coordinates: mm, inch, 3.2cm, ... (default: the file's own; if it has none, m "
        "for up to 3 units, else mm, or cm for bodies of up to 10)",
    )
    body.add_argument(
        "--join",
        action="store_true",
        help="make everything in the file one body, and merge coincident nodes of tetrahedra "
        "(default: closed surfaces, and prims, blocks and instances of tetrahedra, are separate bodies)",
    )
    body.add_argument(
        "--level",
        type=whole_number,
        metavar="L",
        help=f"number of bisections of the cubes of the box; three halve the edge (default: {BOX_LEVEL}). For surfaces "
        f"and scans, in place of --tets: of the cubes at the surface, {CUBES_OF_LEVEL} along the longest side if "
        "--cell-size is not given; several ranks then make the mesh in parts if --fix and --young are given",
    )
    body.add_argument("--scale", type=number, metavar="S", help="multiply the coordinates by this, after --unit")
    body.add_argument(
        "--offset",
        type=metres,
        nargs=3,
        metavar=("DX", "DY", "DZ"),
        help="move the body by this much before the run starts [m], after --scale; this places the bodies of a run "
        "file",
    )
    body.add_argument(
        "--up",
        type=str.upper,
        choices=("Y", "Z"),
        metavar="AXIS",
        help="axis that points up, y or z (default: the file's, or the convention of its format)",
    )
    body.add_argument(
        "--young",
        type=pressure,
        metavar="E",
        help=f"Young's modulus [Pa] (default: {STIFFNESS_PER_WEIGHT:g} times density, gravity and height, so that a "
        f"body sags visibly and stands)",
    )
    body.add_argument("--poisson", type=number, metavar="NU", help="Poisson's ratio (default: 0.45)")
    body.add_argument("--density", type=density, metavar="RHO", help="mass density [kg/m^3] (default: 1000)")
    body.add_argument(
        "--materials",
        metavar="LIST",
        help="materials of the file's regions (physical groups, sets or cell data) or of a scan's labels, for example "
        "liver=3kPa:0.45,vessel@4=30kPa; everything else has --young, --poisson and --density",
    )
    body.add_argument(
        "--regions-by", metavar="ARRAY", help="array of the file that numbers its regions (default: the likeliest one)"
    )
    body.add_argument("--model", choices=CHOICES, default="corotated", help="elastic model (default: corotated)")
    body.add_argument(
        "--rotation-level",
        type=rotation_level,
        metavar="L",
        help="share rotations among elements, on the mesh of box, a surface or a scan: at the tree's level L; or, "
        "with auto or a tolerance in radians, where they are similar (default: each element has its own)",
    )
    body.add_argument(
        "--dilatation",
        choices=(ELEMENT, SHARED),
        help="whether elements share their change of volume: shared does not lock where Poisson's ratio is near 1/2, "
        "and is slower (default: shared where it is 0.45 or more, else element)",
    )
    body.add_argument(
        "--region",
        nargs=2,
        action="append",
        metavar=("PATCH", "VALUES"),
        help="another material for the tetrahedra whose centre is in a patch: YOUNG[:POISSON[:DENSITY]], for example "
        "30kPa:0.45; can be given several times; where patches overlap the last one is used",
    )
    body.add_argument(
        "--patch",
        action="append",
        metavar="NAME=EXPR",
        help="name a patch, for other options and for later patches",
    )
    body.add_argument(
        "--fix",
        action="append",
        metavar="PATCH",
        help='fix these nodes, for example bottom or "z < 0.01"; none fixes nothing; can be given several times '
        "(default: what the body stands on, if that is flat and supports it; else nothing, and it lies on a ground)",
    )

    _add_organ_options(parser.add_argument_group("a body from a surface or a scan"))


def _add_organ_options(organ: argparse._ArgumentGroup) -> None:
    organ.add_argument(
        "--tets",
        type=whole_number,
        metavar="N",
        help=f"largest number of tetrahedra; the mesh has nearly as many (default: {TETS}, unless --max-level or "
        f"--surface-error is given)",
    )
    organ.add_argument(
        "--min-layers",
        type=number,
        metavar="K",
        help="tetrahedra through the thickness of thin parts, where --tets allows (default: 2)",
    )
    organ.add_argument(
        "--cell-size", type=metres, metavar="M", help="edge of the coarsest cubes [m] (default: chosen to suit --tets)"
    )
    organ.add_argument(
        "--max-level",
        type=whole_number,
        metavar="L",
        help=f"maximum number of bisections of a cube; three halve the edge (default: chosen to suit --tets; "
        f"{MAX_LEVEL_FOR_ERROR} with --surface-error)",
    )
    organ.add_argument(
        "--surface-error",
        type=metres,
        metavar="M",
        help="largest distance of the mesh's surface from the input's [m] (default: as small as the other options "
        "allow)",
    )
    organ.add_argument(
        "--labels",
        metavar="LIST",
        help="for a scan: the labels that make up the body, and their materials, for example "
        "liver=3kPa:0.45,vessel@4=30kPa:0.45 (default: all labels, one material)",
    )
    organ.add_argument(
        "--smoothing", type=metres, metavar="M", help="smooth away the steps of voxels, over this length [m]"
    )
    organ.add_argument(
        "--threshold",
        type=value_range,
        metavar="LOW[:HIGH]",
        help="for a scan without labels: voxels with these values make up the body, for example 200 or -200:300",
    )
    organ.add_argument(
        "--skin",
        choices=("input", "marched"),
        help="surface to draw: the input's own, with its texture coordinates, names and materials, or the marched "
        "surface of the tetrahedra (default: input)",
    )
    organ.add_argument("--draw-tets", action="store_true", help="write the tetrahedra as well as the surface")
    organ.add_argument("--draw-labels", action="store_true", help="write a closed surface for each label")
