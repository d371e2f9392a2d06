"""The options of ``warp-corot simulate``."""

from __future__ import annotations

import argparse
from pathlib import Path

from warp_corot.elasticity import MODELS
from warp_corot.elasticity.dilatation import ELEMENT, SHARED

from . import patches, run_file
from .implicit import IMPLICIT_DT, STEPPING
from .label_materials import FORM
from .loading import add_load_options
from .organs import CUBES_OF_LEVEL, MAX_LEVEL_FOR_ERROR
from .parsing import COMMANDS
from .previews import add_preview_options
from .quantities import (
    acceleration,
    density,
    metres,
    number,
    per_second,
    pressure,
    rotation_level,
    seconds,
    unit_of_length,
    value_range,
    whole_number,
)
from .remesh import add_remesh_options
from .say import EXIT_CODES
from .several import TETS
from .subject import BOX_LEVEL, STIFFNESS_PER_WEIGHT
from .touching import add_touch_options

FPS = 24.0

#: Models that the command line has options for.
CHOICES = [name for name in MODELS if name not in ("holzapfel-gasser-ogden", "prestressed", "prony")]


def add_parser(subparsers: argparse._SubParsersAction) -> argparse.ArgumentParser:
    """Add the command to ``warp-corot``."""
    parser = subparsers.add_parser(
        "simulate",
        help=COMMANDS["simulate"],
        description="Lets a soft body sag and sway under gravity and writes a USD animation, coloured by stress.",
        epilog=f"""examples:
  warp-corot simulate warp:bunny -o bunny.usd --preview bunny.gif
  warp-corot simulate warp:bear -o bear.usd
  warp-corot simulate liver.msh --unit mm --young 5kPa --fix "z < zmin + 0.01" -o liver.usd --preview liver.png
  warp-corot simulate liver.stl --unit mm --tets 50000 -o liver.usd
  warp-corot simulate scan.nii.gz --labels liver=3kPa:0.45,vessel=30kPa:0.45 -o scan.usd
  warp-corot simulate knee.vtu --materials bone=1GPa:0.3,cartilage=5MPa --also knee.pvd -o knee.usd
  warp-corot simulate ct_folder --threshold 200 --tets 50000 -o bones.usd
  warp-corot simulate box --model linear -o beam.usd
  warp-corot simulate box --remesh --refine-above 1.03 --simplify-below 1.01 -o beam.usd
  warp-corot simulate liver.stl --unit mm --fix bottom --pull "nearest(0.1, 0, 0.05, 20)" 0 0 0.03 -o liver.usd
  warp-corot simulate box --fix "z == zmin" --twist "z == zmax" 90 --probe "z == zmax" --csv beam.csv -o beam.usd
  warp-corot simulate liver.stl --unit mm --static --fix bottom -o sag.usd
  warp-corot simulate liver.stl --unit mm --integrator backward-euler --dt 16ms -o liver.usd
  warp-corot simulate warp:bunny --drop 5cm -o falls.usd --preview falls.gif
  warp-corot simulate liver.stl --unit mm --tool capsule:r=4mm,l=100mm --tool-path path.csv --csv force.csv -o liver.usd
  warp-corot simulate run.toml -o out.usd

{patches.HELP}

{run_file.HELP}

a label in --labels and --materials is {FORM}: a name and the
numbers of its voxels or region, or a number for both; names without numbers are
the file's regions, or a volume's labels in ascending order.

quantities are in SI units or have a unit: 5kPa, 1.06g/cm3, 500ms, 0.2inch.

warp:bear, warp:bunny and box have their own defaults for body and motion.

{EXIT_CODES}""",
    )
    add_options(parser)
    return parser


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the command's options to a parser."""
    add_input(parser)
    _add_outputs(parser)
    parser.add_argument(
        "--static",
        action="store_true",
        help="find where the body is at rest in place of its motion: one frame, or with --pull, --twist or --press a "
        "state of rest for each frame",
    )
    add_scene_options(parser)
    more = parser.add_argument_group("more results")
    add_preview_options(more)
    more.add_argument(
        "--probe",
        action="append",
        metavar="POINT|PATCH",
        help='record this point, "X Y Z" [m], or patch in --csv; can be given several times',
    )
    more.add_argument(
        "--csv",
        type=Path,
        metavar="FILE.csv",
        help="write displacement, velocity and reaction of each probe, the forces on ground and tools, and the "
        "energies, of every frame",
    )
    more.add_argument("--write-run", type=Path, metavar="RUN.toml", help="save these options as a run file")
    add_device(parser)


def add_input(parser: argparse.ArgumentParser) -> None:
    """Add the argument INPUT."""
    parser.add_argument(
        "input",
        metavar="INPUT",
        help="what to simulate. A mesh with volume, whose other cells are split into tetrahedra: a USD file with a "
        "TetMesh, or a Mesh with tetraIndices; .vtk, .vtu, .vtm, .msh of Gmsh, .inp of Abaqus, .mesh, .node, "
        ".ele, .vol and others; warp:bear, a toy bear; or box, the beam of Tagawa et al. 2013. A closed "
        "surface: .obj, .stl, .ply, .off, .glb, .vtp, a USD file with only Mesh prims, one of the other "
        "files with only triangles; or warp:bunny. A segmented scan: .nii, .nii.gz, .mgz, .mha, .mhd, .nrrd, "
        ".vti, or a folder with a DICOM series. Or a run file, .toml",
    )


def _add_outputs(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "-o", "--output", type=Path, metavar="OUT.usd", help="animation to write (.usd, .usdc or .usda)"
    )
    parser.add_argument(
        "--also",
        type=Path,
        action="append",
        metavar="OUT.pvd",
        help="also write for ParaView, with displacement, velocity, strain and stress: .pvd or .xdmf with all "
        "frames, or .vtu with the last; can be given several times",
    )


def add_scene_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that describe bodies and their motion, which ``simulate`` and ``view`` share."""
    body = parser.add_argument_group("the body")
    body.add_argument(
        "--unit",
        type=unit_of_length,
        metavar="LENGTH",
        help="unit of the file's coordinates: mm, inch, 3.2cm, ... (default: the file's own; if it has none, mm "
        "for a length of 50 to 2500, else m)",
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
        "(default: what the body stands on, if that supports it, else its largest flat region or a broad side)",
    )

    _add_organ_options(parser.add_argument_group("a body from a surface or a scan"))

    motion = parser.add_argument_group("the motion")
    motion.add_argument(
        "--gravity",
        type=acceleration,
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="gravity [m/s^2] (default: 9.81 down the up axis, z if a file has none)",
    )
    add_load_options(motion)
    motion.add_argument("--damping", type=per_second, metavar="C", help="mass-proportional damping [1/s] (default: 2)")
    motion.add_argument(
        "--viscosity",
        type=seconds,
        metavar="S",
        help="stiffness-proportional damping: viscous over elastic stress at one strain [s]; a vibration of angular "
        "frequency w decays by S w^2 / 2 (default: 0)",
    )
    motion.add_argument("--duration", type=seconds, metavar="T", help="simulated time [s] (default: 4)")
    motion.add_argument("--fps", type=number, default=FPS, metavar="F", help=f"frames per second (default: {FPS:g})")
    motion.add_argument(
        "--dt",
        type=seconds,
        help="time step [s], shortened so that a whole number of them makes a frame (default: the step follows the "
        f"state; {1e3 * IMPLICIT_DT:g} ms with an implicit --integrator)",
    )
    motion.add_argument(
        "--integrator",
        choices=STEPPING,
        help="explicit, symplectic-euler, whose steps are bound by the smallest element, or an implicit one for steps "
        "of any length (default: symplectic-euler)",
    )

    add_touch_options(parser.add_argument_group("contact"))
    add_remesh_options(parser.add_argument_group("a mesh that follows the motion, of box, surfaces and scans"))


def add_device(parser: argparse.ArgumentParser) -> None:
    """Add the option --device."""
    parser.add_argument("--device", help='where to compute: "cpu", "cuda:0", ... (default: a GPU if there is one)')


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
