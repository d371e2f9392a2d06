"""What ``warp-corot simulate`` says of itself; its options are those of a run."""

from __future__ import annotations

from warp_corot.cli.exit_status import EXIT_CODES

from .defaults import LABEL
from .run import RunOptions

OPTIONS = RunOptions
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

DESCRIPTION = "Lets a soft body sag and sway under gravity and writes a USD animation, coloured by stress."
EPILOG = f"""examples:
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

{EXIT_CODES}"""
