"""The options of ``warp-corot simulate``."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..elasticity import MODELS
from .label_materials import FORM
from .organs import MAX_LEVEL_FOR_ERROR, TETS
from .remesh import add_remesh_options
from .say import EXIT_CODES
from .subject import STIFFNESS_PER_WEIGHT

FPS = 24.0


def add_parser(subparsers: argparse._SubParsersAction) -> argparse.ArgumentParser:
    """Add the command to ``warp-corot``."""
    parser = subparsers.add_parser(
        "simulate",
        help="let a soft body move and write it as a USD animation",
        description="Lets a soft body sag and sway under gravity and writes a USD animation, coloured by stress.",
        epilog=f"""examples:
  warp-corot simulate warp:bear -o bear.usd
  warp-corot simulate liver.msh --scale 0.001 --young 5000 --fix "z < zmin + 0.01" -o liver.usd --preview liver.png
  warp-corot simulate liver.stl --unit mm --tets 50000 -o liver.usd
  warp-corot simulate scan.nii.gz --labels liver=3kPa:0.45,vessel=30kPa:0.45 -o scan.usd
  warp-corot simulate box --model linear -o beam.usd
  warp-corot simulate box --remesh --refine-above 1.03 --simplify-below 1.01 -o beam.usd

expressions for --fix:
  names      x y z (rest coordinates [m], after --scale), xmin xmax ymin ymax zmin zmax, pi, all, none
  operators  + - * / // % **   < <= > >= == !=   and or not   ( )
  functions  abs sqrt exp log sin cos tan atan2 hypot min max

a label in --labels is {FORM}: a name and the numbers of its voxels,
or a number for both; names alone are the volume's labels in ascending order.

warp:bear, warp:bunny and box have defaults of their own for body and motion.

{EXIT_CODES}""",
    )
    parser.add_argument(
        "input",
        metavar="INPUT",
        help="tetrahedra: a USD file with a TetMesh, or a Mesh with tetraIndices; a file that meshio reads (.msh, "
        ".vtk, .vtu, ...); warp:bear, a toy bear; or box, the beam of Tagawa et al. 2013. A closed surface: .obj, "
        ".stl, .ply, .off, .glb, a USD file with Mesh prims alone; or warp:bunny. A segmented scan: .nii, .nii.gz, "
        ".mha, .mhd, .nrrd or .vti",
    )
    parser.add_argument(
        "-o", "--output", required=True, type=Path, metavar="OUT.usd", help="animation to write (.usd, .usdc or .usda)"
    )

    body = parser.add_argument_group("the body")
    body.add_argument("--scale", type=float, metavar="S", help="factor on the coordinates, e.g. 0.001 for a mesh in mm")
    body.add_argument(
        "--young",
        type=float,
        metavar="E",
        help=f"Young's modulus [Pa] (default: {STIFFNESS_PER_WEIGHT:g} times density, gravity and height, with which "
        "a body visibly sags and stands)",
    )
    body.add_argument("--poisson", type=float, metavar="NU", help="Poisson's ratio (default: 0.45)")
    body.add_argument("--density", type=float, metavar="RHO", help="mass density [kg/m^3] (default: 1000)")
    body.add_argument("--model", choices=MODELS, default="corotated", help="elastic model (default: corotated)")
    body.add_argument(
        "--rotation-level",
        type=int,
        metavar="L",
        help="corotated box: take rotations from the tree's level L only (default: every element has its own)",
    )
    body.add_argument(
        "--fix",
        metavar="EXPR",
        help='nodes that are held, such as "z < 0.01", or none (default: the lowest 2 %% of the height; 10 %% of a '
        "surface or scan)",
    )

    _add_organ_options(parser.add_argument_group("a body from a surface or a scan"))

    motion = parser.add_argument_group("the motion")
    motion.add_argument(
        "--gravity",
        type=float,
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="[m/s^2] (default: 9.81 down the up axis, z where a file names none)",
    )
    motion.add_argument("--damping", type=float, metavar="C", help="mass-proportional damping [1/s] (default: 2)")
    motion.add_argument("--duration", type=float, metavar="T", help="simulated time [s] (default: 4)")
    motion.add_argument("--fps", type=float, default=FPS, metavar="F", help=f"frames per second (default: {FPS:g})")
    motion.add_argument(
        "--dt",
        type=float,
        help="time step [s], shortened so that a whole number makes a frame (default: a safe one, found; with --remesh "
        "it follows the mesh)",
    )

    add_remesh_options(parser.add_argument_group("a mesh that follows the motion, of box, surfaces and scans"))

    parser.add_argument("--device", help='"cpu", "cuda:0", ... (default: a GPU if there is one)')
    parser.add_argument("--preview", type=Path, metavar="FILE.png", help="also draw the last frame")
    return parser


def _add_organ_options(organ: argparse._ArgumentGroup) -> None:
    organ.add_argument(
        "--unit", choices=("mm", "cm", "m"), help="of the coordinates (default: what the file says, or m)"
    )
    organ.add_argument(
        "--tets",
        type=int,
        metavar="N",
        help=f"at most so many tetrahedra, and nearly as many (default: {TETS}, unless --max-level or --surface-error "
        "is given)",
    )
    organ.add_argument(
        "--cell-size", type=float, metavar="M", help="edge of the coarsest cubes [m] (default: by --tets)"
    )
    organ.add_argument(
        "--max-level",
        type=int,
        metavar="L",
        help="how often cubes are bisected at most, three times halve the edge (default: as suits --tets; "
        f"{MAX_LEVEL_FOR_ERROR} with --surface-error)",
    )
    organ.add_argument(
        "--surface-error",
        type=float,
        metavar="M",
        help="how far the surface may be from the given one [m] (default: as near as the rest allows)",
    )
    organ.add_argument(
        "--labels",
        metavar="LIST",
        help="of a scan: the labels that make the body and their materials, as in liver=3kPa:0.45,vessel@4=30kPa:0.45 "
        "(default: all, of one material)",
    )
    organ.add_argument(
        "--smoothing", type=float, metavar="M", help="take the steps of voxels off, over this length [m]"
    )
    organ.add_argument("--draw-tets", action="store_true", help="write the tetrahedra too, not the surface alone")
    organ.add_argument("--draw-labels", action="store_true", help="write a closed surface for each label")
