"""The options of ``warp-corot scene``."""

from __future__ import annotations

import argparse
from pathlib import Path

from warp_corot.cli import quantities
from warp_corot.cli.parsing import COMMANDS
from warp_corot.cli.say import EXIT_CODES

DURATION = 2.0


def add_parser(subparsers: argparse._SubParsersAction) -> argparse.ArgumentParser:
    """Add the command to ``warp-corot``."""
    parser = subparsers.add_parser(
        "scene",
        help=COMMANDS["scene"],
        description="Steps the scene of a USD stage and writes a stage over it in which its bodies move, with the "
        'stress of every tetrahedron. Needs Newton: pip install "warp-corot[newton]" newton-usd-schemas.',
        epilog=f"""examples:
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
    )
    parser.add_argument(
        "input", metavar="INPUT", type=Path, help="stage with TetMesh prims (.usd, .usda, .usdc, .usdz)"
    )
    parser.add_argument(
        "-o", "--output", required=True, type=Path, metavar="OUT.usd", help="stage to write (.usd, .usdc or .usda)"
    )
    said = parser.add_argument_group("what the stage does not define")
    said.add_argument(
        "--young",
        type=quantities.pressure,
        metavar="E",
        help="Young's modulus [Pa] (default: 20 times the weight of a column as high as the body, over its area)",
    )
    said.add_argument("--poisson", type=quantities.number, metavar="NU", help="Poisson's ratio (default: 0.45)")
    said.add_argument("--density", type=quantities.density, metavar="RHO", help="[kg/m^3] (default: 1000)")
    said.add_argument(
        "--ground",
        default="auto",
        metavar="HEIGHT",
        help="height of a ground plane [m]; auto: below the bodies if nothing is held and no collider stays in place "
        "(default); or none",
    )
    said.add_argument(
        "--radius",
        type=quantities.metres,
        default=0.0,
        metavar="R",
        help="contact radius around each point of soft bodies [m]: half of an edge closes the gaps between "
        "points, through which smaller things slip, and keeps bodies that far from others (default: 0)",
    )
    said.add_argument(
        "--no-soft-contact",
        action="store_true",
        help="soft bodies and cloth pass through one another, which takes less time",
    )
    said.add_argument(
        "--fix", metavar="EXPR", help='points that are held, for example "z > zmax - 0.01": see simulate --help [m]'
    )
    motion = parser.add_argument_group("the motion")
    motion.add_argument(
        "--gravity",
        type=quantities.acceleration,
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="[m/s^2] (default: the stage's, else 9.81 down)",
    )
    motion.add_argument(
        "--viscosity",
        type=quantities.seconds,
        metavar="S",
        help="viscous over elastic shear stress of one strain [s] (default: 5 %% of critical damping for each body's "
        "slowest vibration)",
    )
    motion.add_argument(
        "--damping",
        type=quantities.per_second,
        default=0.0,
        metavar="C",
        help="mass-proportional damping [1/s], which also damps falls (default: 0)",
    )
    motion.add_argument(
        "--duration",
        type=quantities.seconds,
        default=DURATION,
        metavar="T",
        help=f"simulated time [s] (default: {DURATION:g})",
    )
    motion.add_argument(
        "--fps",
        type=quantities.number,
        metavar="F",
        help="frames per second (default: the stage's time codes per second, else 24)",
    )
    motion.add_argument(
        "--integrator",
        choices=("explicit", "implicit"),
        default="explicit",
        help="explicit: many short steps; implicit: steps of any length, for stiff bodies, by backward Euler, which "
        "damps; soft bodies then pass through one another, and there is no cloth (default: explicit)",
    )
    motion.add_argument(
        "--dt", type=quantities.seconds, help="longest time step [s] (default: a safe one; 1/60 s if implicit)"
    )
    motion.add_argument(
        "--rigid",
        choices=("semi-implicit", "xpbd", "none"),
        default="semi-implicit",
        help="which of Newton's solvers steps rigid bodies and joints (default: semi-implicit)",
    )
    shown = parser.add_argument_group("the output")
    shown.add_argument(
        "--show-stress", action="store_true", help="colour soft bodies by stress, in place of their materials"
    )
    shown.add_argument("--flatten", action="store_true", help="write one file that needs no other stage")
    parser.add_argument("--device", help='"cpu", "cuda:0", ... (default: a GPU if there is one)')
    return parser
