"""The options of ``warp-corot scene``."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from warp_corot.cli.exit_status import EXIT_CODES
from warp_corot.cli.quantities import Acceleration, Density, Metres, Number, PerSecond, Pressure, Seconds

from .declared import one_of

DESCRIPTION = """Steps the scene of a USD stage and writes a stage over it in which its bodies move, with the stress \
of every tetrahedron. Needs Newton: pip install "warp-corot[newton]" newton-usd-schemas."""
EPILOG = f"""examples:
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

{EXIT_CODES}"""


@dataclass(kw_only=True)
class StageFiles:
    """The stages.

    Attributes:
        input (INPUT): stage with TetMesh prims (.usd, .usda, .usdc, .usdz)
        output (OUT.usd): stage to write (.usd, .usdc or .usda)
    """

    input: Path = field(metadata={"flags": ("input",)})
    output: Path = field(metadata={"flags": ("-o", "--output")})


@dataclass(kw_only=True)
class StageBodies:
    """What the stage does not define.

    Attributes:
        young (E): Young's modulus [Pa] (default: 20 times the weight of a column as high as the body, over its area)
        poisson (NU): Poisson's ratio (default: 0.45)
        density (RHO): [kg/m^3] (default: 1000)
        ground (HEIGHT): height of a ground plane [m]; auto: below the bodies if nothing is held and no collider stays
            in place (default); or none
        radius (R): contact radius around each point of soft bodies [m]: half of an edge closes the gaps between points,
            through which smaller things slip, and keeps bodies that far from others (default: 0)
        no_soft_contact: soft bodies and cloth pass through one another, which takes less time
        fix (EXPR): points that are held, for example "z > zmax - 0.01": see simulate --help [m]
    """

    TITLE = "what the stage does not define"

    young: Pressure | None = None
    poisson: Number | None = None
    density: Density | None = None
    ground: str = "auto"
    radius: Metres = 0.0
    no_soft_contact: bool = False
    fix: str | None = None


@dataclass(kw_only=True)
class StageMotion:
    """The motion.

    Attributes:
        gravity (X Y Z): [m/s^2] (default: the stage's, else 9.81 down)
        viscosity (S): viscous over elastic shear stress of one strain [s] (default: 5 % of critical damping for each
            body's slowest vibration)
        damping (C): mass-proportional damping [1/s], which also damps falls (default: 0)
        duration (T): simulated time [s] (default: 2)
        fps (F): frames per second (default: the stage's time codes per second, else 24)
        integrator: explicit: many short steps; implicit: steps of any length, for stiff bodies, by backward Euler,
            which damps; soft bodies then pass through one another, and there is no cloth (default: explicit)
        dt: longest time step [s] (default: a safe one; 1/60 s if implicit)
        rigid: which of Newton's solvers steps rigid bodies and joints (default: semi-implicit)
    """

    TITLE = "the motion"

    gravity: tuple[Acceleration, Acceleration, Acceleration] | None = None
    viscosity: Seconds | None = None
    damping: PerSecond = 0.0
    duration: Seconds = 2.0
    fps: Number | None = None
    integrator: str = one_of("explicit", "implicit", default="explicit")
    dt: Seconds | None = None
    rigid: str = one_of("semi-implicit", "xpbd", "none", default="semi-implicit")


@dataclass(kw_only=True)
class StageLook:
    """The output.

    Attributes:
        show_stress: colour soft bodies by stress, in place of their materials
        flatten: write one file that needs no other stage
    """

    TITLE = "the output"

    show_stress: bool = False
    flatten: bool = False


@dataclass(kw_only=True)
class SceneOptions(StageLook, StageMotion, StageBodies, StageFiles):
    """All options.

    Attributes:
        device: "cpu", "cuda:0", ... (default: a GPU if there is one)
    """

    device: str | None = None


OPTIONS = SceneOptions
