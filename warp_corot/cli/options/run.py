"""The options of a run: of ``simulate``, ``view`` and run files."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from warp_corot.cli.quantities import (
    Acceleration,
    Density,
    GroundHeight,
    Metres,
    Number,
    PerSecond,
    Pressure,
    RotationLevel,
    Seconds,
    Tool,
    UnitOfLength,
    ValueRange,
    WholeNumber,
)
from warp_corot.inputs.choices import ELEMENT, INTEGRATORS, MODELS, SHARED

from .declared import one_of
from .defaults import AUTO, FPS

#: Models and integrators that the command line has options for.
CHOICES = [name for name in MODELS if name not in ("holzapfel-gasser-ogden", "prestressed", "prony")]
STEPPING = [name for name in INTEGRATORS if name != "quasi-static"]


@dataclass(kw_only=True)
class InputOptions:
    """What is simulated.

    Attributes:
        input (INPUT): what to simulate. A mesh with volume, whose other cells are split into tetrahedra: a USD file
            with a TetMesh, or a Mesh with tetraIndices; .vtk, .vtu, .vtm, .msh of Gmsh, .inp of Abaqus, .mesh, .node,
            .ele, .vol and others; warp:bear, a toy bear; or box, the beam of Tagawa et al. 2013. A closed surface:
            .obj, .stl, .ply, .off, .glb, .vtp, a USD file with only Mesh prims, one of the other files with only
            triangles; or warp:bunny. A segmented scan: .nii, .nii.gz, .mgz, .mha, .mhd, .nrrd, .vti, or a folder with a
            DICOM series. Or a run file, .toml
    """

    input: str = field(metadata={"flags": ("input",)})


@dataclass(kw_only=True)
class OutputOptions:
    """What is written.

    Attributes:
        output (OUT.usd): animation to write (.usd, .usdc or .usda)
        also (OUT.pvd): also write for ParaView, with displacement, velocity, strain and stress: .pvd or .xdmf with all
            frames, or .vtu with the last; can be given several times
        static: find where the body is at rest in place of its motion: one frame, or with --pull, --twist or --press a
            state of rest for each frame
    """

    output: Path | None = field(default=None, metadata={"flags": ("-o", "--output")})
    also: list[Path] | None = None
    static: bool = False


@dataclass(kw_only=True)
class BodyOptions:
    """The body.

    Attributes:
        unit (LENGTH): unit of the file's coordinates: mm, inch, 3.2cm, ... (default: the file's own; if it has none, m
            for up to 3 units, else mm, or cm for bodies of up to 10)
        join: make everything in the file one body, and merge coincident nodes of tetrahedra (default: closed surfaces,
            and prims, blocks and instances of tetrahedra, are separate bodies)
        level (L): number of bisections of the cubes of the box; three halve the edge (default: {BOX_LEVEL}). For
            surfaces and scans, in place of --tets: of the cubes at the surface, {CUBES_OF_LEVEL} along the longest side
            if --cell-size is not given
        scale (S): multiply the coordinates by this, after --unit
        offset (DX DY DZ): move the body by this much before the run starts [m], after --scale; this places the bodies
            of a run file
        up (AXIS): axis that points up, y or z (default: the file's, or the convention of its format)
        young (E): Young's modulus [Pa] (default: {STIFFNESS_PER_WEIGHT:g} times density, gravity and height, so that a
            body sags visibly and stands)
        poisson (NU): Poisson's ratio (default: 0.45)
        toughness (G): energy that a cut takes [J/m^2] (default: 0)
        density (RHO): mass density [kg/m^3] (default: 1000)
        materials (LIST): materials of the file's regions (physical groups, sets or cell data) or of a scan's labels,
            for example liver=3kPa:0.45,vessel@4=30kPa; everything else has --young, --poisson and --density
        regions_by (ARRAY): array of the file that numbers its regions (default: the likeliest one)
        model: elastic model (default: corotated)
        rotation_level (L): share rotations among elements, on the mesh of box, a surface or a scan: at the tree's level
            L; or, with auto or a tolerance in radians, where they are similar (default: each element has its own)
        dilatation: whether elements share their change of volume: shared does not lock where Poisson's ratio is near
            1/2, and is slower (default: shared where it is 0.45 or more, else element)
        region (PATCH VALUES): another material for the tetrahedra whose centre is in a patch:
            YOUNG[:POISSON[:DENSITY]], for example 30kPa:0.45; can be given several times; where patches overlap the
            last one is used
        patch (NAME=EXPR): name a patch, for other options and for later patches
        fix (PATCH): fix these nodes, for example bottom or "z < 0.01"; none fixes nothing; can be given several times
            (default: what the body stands on, if that is flat and supports it; else nothing, and it lies on a ground)
    """

    TITLE = "the body"

    unit: UnitOfLength | None = None
    join: bool = False
    level: WholeNumber | None = None
    scale: Number | None = None
    offset: tuple[Metres, Metres, Metres] | None = None
    up: str | None = one_of("Y", "Z", type=str.upper)
    young: Pressure | None = None
    poisson: Number | None = None
    toughness: Number | None = None
    density: Density | None = None
    materials: str | None = None
    regions_by: str | None = None
    model: str = one_of(*CHOICES, default="corotated")
    rotation_level: RotationLevel | None = None
    dilatation: str | None = one_of(ELEMENT, SHARED)
    region: list[tuple[str, str]] | None = None
    patch: list[str] | None = None
    fix: list[str] | None = None


@dataclass(kw_only=True)
class OrganOptions:
    """A body from a surface or a scan.

    Attributes:
        tets (N): largest number of tetrahedra; the mesh has nearly as many (default: {TETS}, unless --max-level or
            --surface-error is given)
        min_layers (K): tetrahedra through the thickness of thin parts, where --tets allows (default: 2)
        cell_size (M): edge of the coarsest cubes [m] (default: chosen to suit --tets)
        max_level (L): maximum number of bisections of a cube; three halve the edge (default: chosen to suit --tets;
            {MAX_LEVEL_FOR_ERROR} with --surface-error)
        surface_error (M): largest distance of the mesh's surface from the input's [m] (default: as small as the other
            options allow)
        labels (LIST): for a scan: the labels that make up the body, and their materials, for example
            liver=3kPa:0.45,vessel@4=30kPa:0.45 (default: all labels, one material)
        smoothing (M): smooth away the steps of voxels, over this length [m]
        threshold (LOW[:HIGH]): for a scan without labels: voxels with these values make up the body, for example 200 or
            -200:300
        skin: surface to draw: the input's own, with its texture coordinates, names and materials, or the marched
            surface of the tetrahedra (default: input)
        draw_tets: write the tetrahedra as well as the surface
        draw_labels: write a closed surface for each label
    """

    TITLE = "a body from a surface or a scan"

    tets: WholeNumber | None = None
    min_layers: Number | None = None
    cell_size: Metres | None = None
    max_level: WholeNumber | None = None
    surface_error: Metres | None = None
    labels: str | None = None
    smoothing: Metres | None = None
    threshold: ValueRange | None = None
    skin: str | None = one_of("input", "marched")
    draw_tets: bool = False
    draw_labels: bool = False


@dataclass(kw_only=True)
class MotionOptions:
    """The motion.

    Attributes:
        gravity (X Y Z): gravity [m/s^2] (default: 9.81 down the up axis, z if a file has none)
        pull (PATCH DX DY DZ): move a patch by this much [m], for example 0 0 3cm
        twist (PATCH DEGREES): turn a patch about its mean normal, counter-clockwise seen from outside
        press (PATCH PASCALS): press on the surface of a patch, along its normals at rest; a negative pressure pulls
        ramp (T): time in which pulls, twists and pressures grow to their full values [s] (default: half of the
            duration)
        damping (C): mass-proportional damping [1/s] (default: 2)
        viscosity (S): stiffness-proportional damping: viscous over elastic stress at one strain [s]; a vibration of
            angular frequency w decays by S w^2 / 2 (default: 0)
        duration (T): simulated time [s] (default: 4)
        fps (F): frames per second (default: {FPS:g})
        dt: time step [s], shortened so that a whole number of them makes a frame (default: the step follows the state;
            {IMPLICIT_DT:g} s with an implicit --integrator)
        integrator: explicit, symplectic-euler, whose steps are bound by the smallest element, or an implicit one for
            steps of any length (default: symplectic-euler, or backward-euler where explicit steps would be slower than
            real time and less than half as fast)
    """

    TITLE = "the motion"

    gravity: tuple[Acceleration, Acceleration, Acceleration] | None = None
    pull: list[tuple[str, str, str, str]] | None = None
    twist: list[tuple[str, str]] | None = None
    press: list[tuple[str, str]] | None = None
    ramp: Seconds | None = None
    damping: PerSecond | None = None
    viscosity: Seconds | None = None
    duration: Seconds | None = None
    fps: Number = FPS
    dt: Seconds | None = None
    integrator: str | None = one_of(*STEPPING)


@dataclass(kw_only=True)
class ContactOptions:
    """What bodies touch.

    Attributes:
        ground (HEIGHT): put a ground at this height against gravity [m], or just below the bodies (auto, the default
            height); bodies stand on it, and nothing is fixed without --fix
        no_ground: hold a body that would lie on a ground, because it has no flat feet to stand on, at a flat region or
            a broad side
        drop (HEIGHT): let the bodies fall freely onto a ground this far below them [m]
        tool (SHAPE): press with a rigid tool: sphere:r=5mm, capsule:r=4mm,l=100mm, cylinder:r=4mm,l=100mm or
            box:x=2cm,y=2cm,z=5mm, with its axis along z; a friction=MU of its own may follow; can be given several
            times
        tool_path (PATH.csv): how the tool moves: rows of time [s], x, y, z of its centre [m] and, if it turns,
            quaternions qx, qy, qz, qw; one row for a tool that stays; one path for each --tool, in the same order
        blade (PATH.csv): cut with a straight edge, along z about its centre, which moves as --tool-path says; can be
            given several times
        blade_length (L): length of blades [m] (default: three times the body's size)
        touch: let the bodies touch one another; always on with a ground or a tool
        self_contact: let the bodies touch themselves, too
        friction (MU): coefficient of friction of all contacts (default: 0.3)
    """

    TITLE = "contact"

    ground: GroundHeight | None = field(default=None, metadata={"nargs": "?", "const": AUTO})
    no_ground: bool = False
    drop: Metres | None = None
    tool: list[Tool] | None = None
    tool_path: list[Path] | None = None
    blade: list[Path] | None = None
    blade_length: Metres | None = None
    touch: bool = False
    self_contact: bool = False
    friction: Number | None = None


@dataclass(kw_only=True)
class RemeshOptions:
    """A mesh that follows the motion.

    Attributes:
        remesh: refine tetrahedra where they are stretched, and merge them again elsewhere
        refine_above (X): bisect elements whose longest edge is more than X times as long as at rest (default:
            {REFINE_ABOVE:g})
        simplify_below (X): merge elements whose longest edge is less than X times as long as at rest (default:
            {SIMPLIFY_BELOW:g})
        remesh_levels (MIN MAX): minimum and maximum number of bisections of a cube (default: nowhere fewer than at the
            start, and up to three more than its most)
        remesh_every (N): steps from one pass of remeshing to the next (default: {REMESH_EVERY})
        capacity (N): largest number of tetrahedra (default: four times the number at the start, or 100000)
    """

    TITLE = "a mesh that follows the motion, of box, surfaces and scans"

    remesh: bool = False
    refine_above: Number | None = None
    simplify_below: Number | None = None
    remesh_levels: tuple[WholeNumber, WholeNumber] | None = None
    remesh_every: WholeNumber | None = None
    capacity: WholeNumber | None = None


@dataclass(kw_only=True)
class ResultOptions:
    """More results.

    Attributes:
        preview (FILE): also draw the last frame (.png), or a film of all frames (.gif, .mp4)
        preview_frames (LIST): draw these frames side by side into the .png, counted from 0, or back from -1, for
            example 0,12,-1
        preview_views (LIST): draw from these sides: {SIDES}, or AZIMUTH:ELEVATION [°], for example front,left,35:14
            (default: corner)
        probe (POINT|PATCH): record this point, "X Y Z" [m], or patch in --csv; can be given several times
        csv (FILE.csv): write displacement, velocity and reaction of each probe, the forces on ground and tools, and the
            energies, of every frame
        write_run (RUN.toml): save these options as a run file
    """

    TITLE = "more results"

    preview: Path | None = None
    preview_frames: str | None = None
    preview_views: str | None = None
    probe: list[str] | None = None
    csv: Path | None = None
    write_run: Path | None = None


@dataclass(kw_only=True)
class DeviceOptions:
    """Where it runs.

    Attributes:
        device: where to compute: "cpu", "cuda:0", ... (default: a GPU if there is one)
        threads (N): the most threads on the CPU (default: as many as there are cores)
    """

    device: str | None = None
    threads: int | None = None


@dataclass(kw_only=True)
class RunOptions(
    DeviceOptions,
    ResultOptions,
    RemeshOptions,
    ContactOptions,
    MotionOptions,
    OrganOptions,
    BodyOptions,
    OutputOptions,
    InputOptions,
):
    """All options of a run."""


#: Options that all bodies of a run share, as those of one body cannot differ.
OF_THE_RUN = tuple(
    name
    for part in (OutputOptions, ResultOptions, MotionOptions, DeviceOptions, ContactOptions)
    for name in part.__annotations__
    if name not in ("pull", "twist", "press", "probe", "write_run")
)
