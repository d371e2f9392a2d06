"""The options of ``warp-corot simulate``."""

from __future__ import annotations

import argparse
from pathlib import Path

from warp_corot.cli.parsing import COMMANDS
from warp_corot.cli.say import EXIT_CODES

from .bodies import add_body_options
from .defaults import LABEL, VIEWS
from .motion import add_motion_options

PATCHES = """patches, for --fix, --pull, --press, --twist and --probe, are expressions:
  names      bottom top (tenths of the height), flat (the largest flat region), surface, all, none; labels of a scan;
             regions and sets of nodes of the file (*NSET, groups of points and surfaces, point data); those of --patch
  regions    sphere(x, y, z, radius), box(x, y, z, x, y, z), nearest(x, y, z), nearest(x, y, z, n): the n nearest nodes
  numbers    x y z (rest coordinates [m], after --scale), xmin xmax ymin ymax zmin zmax, pi
  operators  + - * / // % **   < <= > >= == !=   and or not   ( )
  functions  abs sqrt exp log sin cos tan atan2 hypot min max"""

RUN_FILES = """a run file (.toml) has the options' names as keys: several values are a list, an option without a value
is true. Options on the command line are added to all its bodies; paths are relative to the file:
  input = "liver.stl"
  unit = "mm"
  fix = ["bottom"]
  pull = [{ patch = "top", by = [0, 0, 0.02], times = [0, 1, 2], shares = [0, 1, 0] }]
several bodies are tables [[body]], each with an input and its own options, for example offset = [0, 0, "5cm"]"""


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

{PATCHES}

{RUN_FILES}

a label in --labels and --materials is {LABEL}: a name and the
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
    add_body_options(parser)
    add_motion_options(parser)
    more = parser.add_argument_group("more results")
    _add_preview_options(more)
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


def _add_preview_options(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--preview",
        type=Path,
        metavar="FILE",
        help="also draw the last frame (.png), or a film of all frames (.gif, .mp4)",
    )
    group.add_argument(
        "--preview-frames",
        metavar="LIST",
        help="draw these frames side by side into the .png, counted from 0, or back from -1, for example 0,12,-1",
    )
    group.add_argument(
        "--preview-views",
        metavar="LIST",
        help=f"draw from these sides: {', '.join(VIEWS)}, or AZIMUTH:ELEVATION [°], for example front,left,35:14 "
        "(default: corner)",
    )


def add_device(parser: argparse.ArgumentParser) -> None:
    """Add the option --device."""
    parser.add_argument("--device", help='where to compute: "cpu", "cuda:0", ... (default: a GPU if there is one)')
