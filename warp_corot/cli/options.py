"""The commands and their options, as one table, which imports neither Warp nor NumPy: help is quick.

argparse, run files and the help follow from `TABLE`.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from warp_corot.inputs import choices
from warp_corot.inputs.choices import INTEGRATORS, MODELS

from .quantities import AUTO, ground_height, number, quantity, rotation_level, unit_of_length, value_range, whole_number

# --- values of options that are not given ----------------------------------------------------------------------------

FPS = 24.0
#: Default number of tetrahedra, approximately.
TETS = 20_000
BOX_LEVEL = 6
#: Young's modulus over the weight of a column as high as the body: such bodies sag by roughly a tenth of their height.
STIFFNESS_PER_WEIGHT = 20.0
#: With a level: the number of root cubes along the body's longest side.
CUBES_OF_LEVEL = 16
#: The step of implicit integrators if none is given [s].
IMPLICIT_DT = 0.01
#: The form of a label or region and its material.
LABEL = "NAME[@NUMBER[+NUMBER...]]=YOUNG[:POISSON[:DENSITY]]"
#: Loads: number of values after PATCH.
LOADS = {"pull": 3, "twist": 1, "press": 1}
#: Views by name: azimuth and elevation [°].
VIEWS = {
    "corner": (35.0, 14.0),
    "front": (0.0, 0.0),
    "right": (90.0, 0.0),
    "back": (180.0, 0.0),
    "left": (-90.0, 0.0),
    "top": (0.0, 89.9),
    "bottom": (0.0, -89.9),
}
SIDES = ", ".join(VIEWS)

EXIT_CODES = """exit status:
  0    done
  1    a file could not be written, for example because the disk is full
  2    the input or an option was wrong; nothing was simulated, no file was touched
  3    the simulation became unstable; the frames before that are kept
  130  interrupted (Ctrl-C), 143 terminated (SIGTERM); the written frames are kept"""

#: Models and integrators that the command line has options for.
CHOICES = [name for name in MODELS if name not in ("holzapfel-gasser-ogden", "prestressed", "prony")]
STEPPING = [name for name in INTEGRATORS if name != "quasi-static"]

# --- the table -------------------------------------------------------------------------------------------------------

#: Groups of options, each below a line with its name and, if the help shows it, its title. An option is
#: ``NAME METAVARS [KIND=DEFAULT]: help``, with ``!`` after the name if it must be given, and ``...`` before the colon
#: if it can be given several times. A kind is one of `KINDS`, a unit, words with ``|`` between them, or a flag. Names
#: in braces are values of this module and of `choices`.
TABLE = """
== input
INPUT [text]: what to simulate. A mesh with volume, whose other cells are split into tetrahedra: a USD file with a
    TetMesh, or a Mesh with tetraIndices; .vtk, .vtu, .vtm, .msh of Gmsh, .inp of Abaqus, .mesh, .node, .ele, .vol and
    others; warp:bear, a toy bear; or box, the beam of Tagawa et al. 2013. A closed surface: .obj, .stl, .ply, .off,
    .glb, .vtp, a USD file with only Mesh prims, one of the other files with only triangles; or warp:bunny. A
    segmented scan: .nii, .nii.gz, .mha, .mhd, .nrrd, .vti, or a folder with a DICOM series. Or a run file, .toml

== output
-o output OUT.usd [path]: animation to write (.usd, .usdc or .usda)
also OUT.pvd [path]...: also write for ParaView, with displacement, velocity, strain and stress: .pvd with all frames,
    or .vtu with the last; can be given several times
static [flag]: find where the body is at rest in place of its motion: one frame, or with --pull, --twist or --press a
    state of rest for each frame

== body: the body
unit LENGTH [unit]: unit of the file's coordinates: mm, inch, 3.2cm, ... (default: the file's own; if it has none, m
    for up to 3 units, else mm, or cm for bodies of up to 10)
join [flag]: make everything in the file one body, and merge coincident nodes of tetrahedra (default: closed surfaces,
    and prims, blocks and instances of tetrahedra, are separate bodies)
level L [whole]: number of bisections of the cubes of the box; three halve the edge (default: {BOX_LEVEL}). For
    surfaces and scans, in place of --tets: of the cubes at the surface, {CUBES_OF_LEVEL} along the longest side
scale S [number]: multiply the coordinates by this, after --unit
offset DX DY DZ [m]: move the body by this much before the run starts [m], after --scale; this places the bodies of a
    run file
up AXIS [Y|Z]: axis that points up, y or z (default: the file's, or the convention of its format)
young E [Pa]: Young's modulus [Pa] (default: {STIFFNESS_PER_WEIGHT:g} times density, gravity and height, so that a
    body sags visibly and stands)
poisson NU [number]: Poisson's ratio (default: 0.45)
toughness G [number]: energy that a cut takes [J/m^2] (default: 0)
density RHO [kg/m^3]: mass density [kg/m^3] (default: 1000)
materials LIST [text]: materials of the file's regions (physical groups, sets or cell data) or of a scan's labels, for
    example liver=3kPa:0.45,vessel@4=30kPa; everything else has --young, --poisson and --density
regions-by ARRAY [text]: array of the file that numbers its regions (default: the likeliest one)
model [{CHOICES}=corotated]: elastic model (default: corotated)
rotation-level L [rotations]: share rotations among elements, on the mesh of box, a surface or a scan: at the tree's
    level L; or, with auto or a tolerance in radians, where they are similar (default: each element has its own)
dilatation [element|shared]: whether elements share their change of volume: shared does not lock where Poisson's ratio
    is near 1/2, and is slower (default: shared where it is 0.45 or more, else element)
region PATCH VALUES [text]...: another material for the tetrahedra whose centre is in a patch:
    YOUNG[:POISSON[:DENSITY]], for example 30kPa:0.45; can be given several times; where patches overlap the last one
    is used
patch NAME=EXPR [text]...: name a patch, for other options and for later patches
fix PATCH [text]...: fix these nodes, for example bottom or "z < 0.01"; none fixes nothing; can be given several times
    (default: what the body stands on, if that is flat and supports it; else nothing, and it lies on a ground)

== organ: a body from a surface or a scan
tets N [whole]: largest number of tetrahedra; the mesh has nearly as many (default: {TETS})
min-layers K [number]: tetrahedra through the thickness of thin parts, where --tets allows (default: 2)
labels LIST [text]: for a scan: the labels that make up the body, and their materials, for example
    liver=3kPa:0.45,vessel@4=30kPa:0.45 (default: all labels, one material)
smoothing M [m]: smooth away the steps of voxels, over this length [m]
threshold LOW[:HIGH] [range]: for a scan without labels: voxels with these values make up the body, for example 200 or
    -200:300
skin [input|marched]: surface to draw: the input's own, with its texture coordinates, names and materials, or the
    marched surface of the tetrahedra (default: input)
draw-tets [flag]: write the tetrahedra as well as the surface
draw-labels [flag]: write a closed surface for each label

== motion: the motion
gravity X Y Z [m/s^2]: gravity [m/s^2] (default: 9.81 down the up axis, z if a file has none)
pull PATCH DX DY DZ [text]...: move a patch by this much [m], for example 0 0 3cm
twist PATCH DEGREES [text]...: turn a patch about its mean normal, counter-clockwise seen from outside
press PATCH PASCALS [text]...: press on the surface of a patch, along its normals at rest; a negative pressure pulls
ramp T [s]: time in which pulls, twists and pressures grow to their full values [s] (default: half of the duration)
damping C [1/s]: mass-proportional damping [1/s] (default: 2)
viscosity S [s]: stiffness-proportional damping: viscous over elastic stress at one strain [s]; a vibration of angular
    frequency w decays by S w^2 / 2 (default: 0)
duration T [s]: simulated time [s] (default: 4)
fps F [number={FPS:g}]: frames per second (default: {FPS:g})
dt [s]: time step [s], shortened so that a whole number of them makes a frame (default: the step follows the state;
    {IMPLICIT_DT:g} s with an implicit --integrator)
integrator [{STEPPING}]: explicit, symplectic-euler, whose steps are bound by the smallest element, or an implicit one
    for steps of any length (default: symplectic-euler, or backward-euler where explicit steps would be slower than
    real time and less than half as fast)

== contact: contact
ground HEIGHT [height]: put a ground at this height against gravity [m], or just below the bodies (auto, the default
    height); bodies stand on it, and nothing is fixed without --fix
no-ground [flag]: hold a body that would lie on a ground, because it has no flat feet to stand on, at a flat region or
    a broad side
drop HEIGHT [m]: let the bodies fall freely onto a ground this far below them [m]
tool SHAPE [text]...: press with a rigid tool: sphere:r=5mm, capsule:r=4mm,l=100mm, cylinder:r=4mm,l=100mm or
    box:x=2cm,y=2cm,z=5mm, with its axis along z; a friction=MU of its own may follow; can be given several times
tool-path PATH.csv [path]...: how the tool moves: rows of time [s], x, y, z of its centre [m] and, if it turns,
    quaternions qx, qy, qz, qw; one row for a tool that stays; one path for each --tool, in the same order
blade PATH.csv [path]...: cut with a straight edge, along z about its centre, which moves as --tool-path says; can be
    given several times
blade-length L [m]: length of blades [m] (default: three times the body's size)
touch [flag]: let the bodies touch one another; always on with a ground or a tool
self-contact [flag]: let the bodies touch themselves, too
friction MU [number]: coefficient of friction of all contacts (default: 0.3)

== remesh: a mesh that follows the motion, of box, surfaces and scans
remesh [flag]: refine tetrahedra where they are stretched, and merge them again elsewhere
refine-above X [number]: bisect elements whose longest edge is more than X times as long as at rest (default:
    {REFINE_ABOVE:g})
simplify-below X [number]: merge elements whose longest edge is less than X times as long as at rest (default:
    {SIMPLIFY_BELOW:g})
remesh-levels MIN MAX [whole]: minimum and maximum number of bisections of a cube (default: nowhere fewer than at the
    start, and up to three more than its most)
remesh-every N [whole]: steps from one pass of remeshing to the next (default: {REMESH_EVERY})
capacity N [whole]: largest number of tetrahedra (default: four times the number at the start, or 100000)

== results: more results
preview FILE [path]: also draw the last frame (.png), or a film of all frames (.gif, .mp4)
preview-frames LIST [text]: draw these frames side by side into the .png, counted from 0, or back from -1, for example
    0,12,-1
preview-views LIST [text]: draw from these sides: {SIDES}, or AZIMUTH:ELEVATION [°], for example front,left,35:14
    (default: corner)
probe POINT|PATCH [text]...: record this point, "X Y Z" [m], or patch in --csv; can be given several times
csv FILE.csv [path]: write displacement, velocity and reaction of each probe, the forces on ground and tools, and the
    energies, of every frame
write-run RUN.toml [path]: save these options as a run file

== device
device [text]: where to compute: "cpu", "cuda:0", ... (default: a GPU if there is one)
threads N [int]: the most threads on the CPU (default: as many as there are cores)

== page: the page
host ADDRESS [text=127.0.0.1]: address to listen at (default: 127.0.0.1)
port N [whole=8080]: port; 0: any free one (8080)
token WORD [text]: word that visitors need, as in http://ADDRESS:N/?token=WORD (default: none on this computer; a
    random word where others can reach the address)

== sweep
INPUT [text]: as for simulate: a run file, a mesh, a surface, a scan or box
vary! OPTION=VALUES [text]...: an option of simulate and its values: A,B,C, FIRST:LAST:COUNT or FIRST:LAST:COUNT:log;
    may be repeated
probe WHERE [text]...: as for simulate: its motion is a result
duration T [text]: as for simulate
-o output FOLDER [path]: folder for the results
workers N [int]: processes (default: one a card, or one a core)
retries N [int=2]: how often a failed run is repeated (default: 2)
device [text]: as for simulate

== stage files
INPUT [path]: stage with TetMesh prims (.usd, .usda, .usdc, .usdz)
-o output! OUT.usd [path]: stage to write (.usd, .usdc or .usda)

== stage bodies: what the stage does not define
young E [Pa]: Young's modulus [Pa] (default: 20 times the weight of a column as high as the body, over its area)
poisson NU [number]: Poisson's ratio (default: 0.45)
density RHO [kg/m^3]: [kg/m^3] (default: 1000)
ground HEIGHT [text=auto]: height of a ground plane [m]; auto: below the bodies if nothing is held and no collider
    stays in place (default); or none
radius R [m=0]: contact radius around each point of soft bodies [m]: half of an edge closes the gaps between points,
    through which smaller things slip, and keeps bodies that far from others (default: 0)
no-soft-contact [flag]: soft bodies and cloth pass through one another, which takes less time
fix EXPR [text]: points that are held, for example "z > zmax - 0.01": see simulate --help [m]

== stage motion: the motion
gravity X Y Z [m/s^2]: [m/s^2] (default: the stage's, else 9.81 down)
viscosity S [s]: viscous over elastic shear stress of one strain [s] (default: 5 % of critical damping for each body's
    slowest vibration)
damping C [1/s=0]: mass-proportional damping [1/s], which also damps falls (default: 0)
duration T [s=2]: simulated time [s] (default: 2)
fps F [number]: frames per second (default: the stage's time codes per second, else 24)
integrator [explicit|implicit=explicit]: explicit: many short steps; implicit: steps of any length, for stiff bodies,
    by backward Euler, which damps; soft bodies then pass through one another, and there is no cloth (default:
    explicit)
dt [s]: longest time step [s] (default: a safe one; 1/60 s if implicit)
rigid [semi-implicit|xpbd|none=semi-implicit]: which of Newton's solvers steps rigid bodies and joints (default:
    semi-implicit)

== stage look: the output
show-stress [flag]: colour soft bodies by stress, in place of their materials
flatten [flag]: write one file that needs no other stage

== stage device
device [text]: "cpu", "cuda:0", ... (default: a GPU if there is one)

== warm-up
device [text]: "cpu", "cuda:0", ... (default: Warp's choice)
all [flag]: also all elastic models, remeshing, states of rest and own surfaces

== verify
CASES* CASE [text]: names of cases (default: all)
list [flag]: list the cases, and run none
full [flag]: finer meshes and longer times: minutes on a CPU core, where the quick form takes half a minute
json FILE [path]: also write the rows as JSON
device [text]: "cpu", "cuda:0", ... (default: Warp's choice)
"""

#: Groups of the options of a body, and of a run.
OF_BODIES = ("body", "organ", "motion", "contact", "remesh")
RUN = ("input", "output", *OF_BODIES, "results", "device")

#: Functions that read the text of an option, by kind.
KINDS: dict[str, Callable[[str], Any]] = {
    "text": str,
    "path": Path,
    "int": int,
    "number": number,
    "whole": whole_number,
    "unit": unit_of_length,
    "rotations": rotation_level,
    "range": value_range,
    "height": ground_height,
}


class Option(NamedTuple):
    """An option.

    Attributes:
        name: Its name in Python.
        flags: The words that name it; for what stands alone, the name itself.
        settings: More arguments of ``add_argument``.
    """

    name: str
    flags: tuple[str, ...]
    settings: dict[str, Any]

    @property
    def default(self) -> Any:
        """Its value if it is not given."""
        return self.settings.get("default")

    @property
    def is_flag(self) -> bool:
        """Whether it has no value."""
        return self.settings.get("action") == "store_true"

    @property
    def is_list(self) -> bool:
        """Whether it can be given several times."""
        return self.settings.get("action") == "append"


_ENTRY = re.compile(r"((?:-\w )?)(\S+?)([!*]?)((?: (?!\[)\S+)*) \[([^\]=]*)=?([^\]]*)\](\.*): (.*)")


@cache
def table() -> dict[str, tuple[str, tuple[Option, ...]]]:
    """The title and the options of each group."""
    found = {}
    known = vars(choices) | {name: value for name, value in globals().items() if name.isupper() and name != "TABLE"}
    words = {name: "|".join(value) for name, value in known.items() if name in ("CHOICES", "STEPPING")}
    for group in TABLE.format(**(known | words)).split("\n== ")[1:]:
        head, _, text = group.replace("\n    ", " ").partition("\n")
        name, _, title = head.partition(": ")
        found[name] = title, tuple(map(_option, text.strip().splitlines()))
    return found


def _option(line: str) -> Option:
    match = _ENTRY.fullmatch(line)
    assert match is not None, line
    short, name, mark, metavars, kind, default, many, text = match.groups()
    settings: dict[str, Any] = {"help": text.replace("%", "%%")}
    dest, shown = name.lower().replace("-", "_"), tuple(metavars.split())
    if kind == "flag":
        return Option(dest, (f"--{name}",), settings | {"action": "store_true", "default": False})
    if "|" in kind:
        words = kind.split("|")  # in any case
        listed = {word.lower(): word for word in words}
        settings |= {"choices": words, "type": lambda text: listed.get(text.lower(), text)}
    else:
        settings["type"] = KINDS[kind] if kind in KINDS else quantity(kind)
    if name.isupper():
        settings |= {"metavar": shown[0] if shown else name} | ({"nargs": "*"} if mark else {})
        return Option(dest, (dest,), settings)
    if shown:
        settings |= {"metavar": shown, "nargs": len(shown)} if len(shown) > 1 else {"metavar": shown[0]}
    settings |= {"nargs": "?", "const": AUTO} if kind == "height" else {}
    settings |= {"action": "append"} if many else {}
    settings |= (
        {"required": True}
        if mark
        else {"default": KINDS.get(kind, str if "|" in kind else float)(default) if default else None}
    )
    return Option(dest, (*short.split(), f"--{name}"), settings)


def options_of(groups: Sequence[str]) -> list[Option]:
    """The options of groups."""
    return [option for name in groups for option in table()[name][1]]


def add_options(parser: argparse.ArgumentParser, groups: Sequence[str]) -> None:
    """Add groups of options to a parser; those with a title are groups of the help."""
    for title, options in (table()[name] for name in groups):
        group = parser.add_argument_group(title) if title else parser
        for option in options:
            group.add_argument(*option.flags, **option.settings)


#: Options that all bodies of a run share, as those of one body cannot differ.
OF_THE_RUN = tuple(
    option.name
    for option in options_of(("output", "results", "motion", "device", "contact"))
    if option.name not in ("pull", "twist", "press", "probe", "write_run")
)


#: Options that need another one.
NEEDS = dict.fromkeys(("refine_above", "simplify_below", "remesh_levels", "remesh_every", "capacity"), "remesh")
NEEDS |= {"preview_frames": "preview", "preview_views": "preview", "probe": "csv", "blade_length": "blade"}

# --- the commands ----------------------------------------------------------------------------------------------------

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


class Command(NamedTuple):
    """A subcommand of ``warp-corot``, whose module has its name with _ for -.

    Attributes:
        line: Its line in the help.
        groups: The groups of its options in `TABLE`.
        description, epilog: What its own help says before and after them.
        files: The groups of the options that run files may name, too; they have their defaults.
    """

    line: str
    groups: tuple[str, ...]
    description: str
    epilog: str | None = None
    files: tuple[str, ...] = ()


COMMANDS = {
    "simulate": Command(
        "simulate a soft body and write its motion as a USD animation",
        RUN,
        "Lets a soft body sag and sway under gravity and writes a USD animation, coloured by stress.",
        f"""examples:
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
    ),
    "sweep": Command(
        "repeat a run with many combinations of parameters, and write a table of the results",
        ("sweep",),
        """Runs INPUT with every combination of the values of --vary, in several processes. The same command \
continues an interrupted sweep.""",
        """examples:
  warp-corot sweep box --vary young=500,1kPa,2kPa -o results
  warp-corot sweep run.toml --vary young=1kPa:100kPa:64:log --vary poisson=0.3,0.45,0.49 -o results

the folder gets table.csv, runs.jsonl with the finished runs, and in runs/ a stage and a table for each run. Results are
the last row of each run's table, and the largest displacement.""",
    ),
    "view": Command(
        "take hold of a soft body in a browser",
        ("input", "page", *OF_BODIES, "device"),
        """Opens a page in which a soft body moves and can be dragged, pressed, held and cut with the mouse. \
Needs websockets: pip install "warp-corot[view]".""",
        """examples:
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
        RUN,
    ),
    "scene": Command(
        "step a USD stage: soft bodies, rigid bodies, ground",
        ("stage files", "stage bodies", "stage motion", "stage look", "stage device"),
        """Steps the scene of a USD stage and writes a stage over it in which its bodies move, with the stress \
of every tetrahedron. Needs Newton: pip install "warp-corot[newton]" newton-usd-schemas.""",
        f"""examples:
  warp-corot scene stage.usda -o moving.usd
  warp-corot scene stage.usda -o moving.usd --duration 5 --fps 60 --device cuda:0
  warp-corot scene block.usd -o block-falls.usd --young 2e4 --ground -0.5 --show-stress

what is read, as Newton reads it:
  TetMesh prims, with or without PhysicsVolumeDeformableSimAPI; of the physics material that is bound to them
  (PhysicsVolumeDeformableMaterialAPI) youngsModulus (else 1 MPa), poissonsRatio (else 0.3), density (else 1000 kg/m^3)
  and dynamicFriction (else 0.5; contact has the mean of both sides'); masses, restShapePoints; attachments to rigid
  bodies, and to what does not move, by which points are held; graphics meshes of a deformable body; cloth, as Newton's
  membrane; no cables
  rigid bodies, colliders, joints and the gravity of UsdPhysics, at their first moment if they are animated;
  metersPerUnit, kilogramsPerUnit, upAxis, transforms

what touches what: points of soft bodies, and of cloth, touch colliders and rigid bodies; surfaces of soft bodies and
  cloth touch one another; rigid bodies touch rigid bodies and colliders

what is written, on top of OUT's sublayer INPUT, which must stay beside it unless --flatten is given:
  for TetMesh prims points, velocities, primvars:vonMises [Pa], one a tetrahedron, and its colours
  for rigid bodies their transforms; for graphics meshes and cloth their points

{EXIT_CODES}""",
    ),
    "warm-up": Command(
        "compile the kernels of frequent runs, so that these start at once",
        ("warm-up",),
        """\
Makes short runs of the kinds that simulate and view make most, so that the
kernels of these are in Warp's cache when you need them. Nothing is written
elsewhere. Where they already are, the runs take seconds.""",
    ),
    "verify": Command(
        "run cases with known answers, and print a table of results, references and errors",
        ("verify",),
        """\
Runs cases with known answers on this machine: elastic laws, contact, friction
and impacts. Prints a table: each result, its reference, how far they are apart,
how far they may be, and where the reference comes from.""",
        """\
exit status: 0 if all rows pass, 4 if a row does not, else as of simulate.""",
    ),
}


def add_command(subparsers: Any, name: str) -> argparse.ArgumentParser:
    """Add a subcommand to a parser, with its options."""
    command = COMMANDS[name]
    parser: argparse.ArgumentParser = subparsers.add_parser(
        name, help=command.line, description=command.description, epilog=command.epilog
    )
    add_options(parser, command.groups)
    there = {option.name for option in options_of(command.groups)}
    more = {option.name: option.default for option in options_of(command.files)}
    parser.set_defaults(**{name: default for name, default in more.items() if name not in there})
    return parser


def is_static(args: argparse.Namespace) -> bool:
    return bool(getattr(args, "static", False))


def integrator_name(args: argparse.Namespace) -> str:
    return args.integrator or "symplectic-euler"
