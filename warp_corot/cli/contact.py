"""What the bodies of a run touch: grounds, tools and their paths; blades that cut them."""

from __future__ import annotations

import argparse
import csv
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import numpy.typing as npt

from warp_corot.contact.options import Contact, checked_friction, may_meet
from warp_corot.contact.shapes import Box, Capsule, Cylinder, Ground, Shape, Sphere, axis_of
from warp_corot.contact.skin import own_surface
from warp_corot.contact.tool import Obstacle, Tool
from warp_corot.domain.units import in_units, length
from warp_corot.errors import InputError
from warp_corot.solvers import INTEGRATORS

from .options import integrator_name
from .patches import up_of
from .quantities import AUTO
from .terminal import are_several

if TYPE_CHECKING:
    from warp_corot.simulation.simulation import Simulation

    from .bodies import RunBody

# --- tools and their paths -------------------------------------------------------------------------------------------

#: Shapes by name, each with the names of the lengths that it takes.
SHAPES: dict[str, tuple[Callable[..., Shape], str]] = {
    "sphere": (Sphere, "r"),
    "capsule": (Capsule, "rl"),
    "cylinder": (Cylinder, "rl"),
    "box": (lambda *size, **more: Box(size, **more), "xyz"),
}
FORMS = "sphere:r=R, capsule:r=R,l=L, cylinder:r=R,l=L or box:x=X,y=Y,z=Z, for example capsule:r=4mm,l=100mm"
#: Columns of a path, and their units.
POSITION = {"time": "s", "x": "m", "y": "m", "z": "m"}
COLUMNS = POSITION | dict.fromkeys(("qx", "qy", "qz", "qw"), "")
KNOWN = "time, x, y, z, and for turns also qx, qy, qz, qw"
_HEADER = re.compile(r"\s*([A-Za-z_]+)\s*(?:[\[(]\s*([^\])]+?)\s*[\])])?\s*")

Floats = npt.NDArray[np.float64]
AnyTool = TypeVar("AnyTool", bound=Tool)


def tool_shape(text: str) -> Shape:
    """A shape at the origin from the text of ``--tool``.

    Raises:
        InputError: Another form, a length that is not positive, or a negative friction.
    """
    kind, _, rest = text.partition(":")
    kind = kind.strip().lower()
    try:
        if kind not in SHAPES:
            raise InputError(f"{kind!r} is not a shape")
        make, names = SHAPES[kind]
        pairs = [[part.strip() for part in word.split("=", 1)] for word in rest.split(",")]
        given = {pair[0].lower(): pair[-1] for pair in pairs}
        friction = given.pop("friction", None)
        if set(given) != set(names) or len(pairs) != len(names) + (friction is not None):
            raise InputError(f"a {kind} has {', '.join(names)}, each once")
        lengths = (in_units(given[name], "m") for name in names)
        return make(*lengths, **({} if friction is None else {"friction": float(friction)}))
    except (InputError, ValueError) as error:
        raise InputError(f"--tool {text!r}: {error}; it must be {FORMS}") from None


def moved(tool: AnyTool, path: Path) -> AnyTool:
    """A tool that moves along the path in a file; with a single row it stays there.

    Raises:
        InputError: The file cannot be read, or its rows are not a path.
    """
    times, positions, turns = read_tool_path(path)
    try:
        if len(times) == 1:
            tool.move(positions[0], None if turns is None else turns[0])
        else:
            tool.follow(times, positions, turns)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return tool


def read_tool_path(path: Path) -> tuple[Floats, Floats, Floats | None]:
    """Times [s], [K], positions [m], [K, 3], and quaternions (x, y, z, w), [K, 4], or None without.

    The first row names the columns, with optional units ("x [mm]"); without names there are four or eight columns in
    the order of `COLUMNS`.

    Raises:
        InputError: No such file, other columns, or a value that is not a finite number.
    """
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = [(number, row) for number, row in enumerate(csv.reader(file), 1) if any(map(str.strip, row))]
    except FileNotFoundError:
        raise InputError(f"{path}: no such file (--tool-path)") from None
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: cannot be read as CSV ({error})") from None
    if not rows:
        raise InputError(f"{path}: is empty; it must have rows of {KNOWN}")
    units = dict.fromkeys(list(COLUMNS)[: len(rows[0][1])], 1.0)
    if rows[0][1][0].strip()[:1].isalpha():
        units = _named_columns(rows.pop(0)[1], path)
    missing = [name for name in (COLUMNS if units.keys() - POSITION else POSITION) if name not in units]
    if missing or not rows:
        lacks = f"column {missing[0]!r}" if missing else "rows"
        raise InputError(f"{path}: has no {lacks}; it must have rows of {KNOWN}")
    values = np.empty((len(rows), len(units)))
    for place, (number, row) in enumerate(rows):
        if len(row) != len(units):
            raise InputError(f"{path}: line {number} has {len(row)} values; it must have {len(units)}")
        for column, (text, (name, unit)) in enumerate(zip(row, units.items(), strict=True)):
            try:
                values[place, column] = unit * float(text)
            except ValueError:
                values[place, column] = math.nan
            if not math.isfinite(values[place, column]):
                raise InputError(f"{path}: line {number}: {name} is {text.strip()!r}; it must be a finite number")
    of = dict(zip(units, values.T, strict=True))
    turns = np.stack([of[name] for name in ("qx", "qy", "qz", "qw")], axis=1) if "qw" in of else None
    return of["time"], np.stack([of[axis] for axis in "xyz"], axis=1), turns


def _named_columns(row: list[str], path: Path) -> dict[str, float]:
    """The columns that a row names, each with its unit in SI units.

    Raises:
        InputError: Other names or units.
    """
    found: dict[str, float] = {}
    for word in row:
        match = _HEADER.fullmatch(word)
        name = {"t": "time"}.get(match[1].lower(), match[1].lower()) if match else word
        if not match or name not in COLUMNS or name in found:
            raise InputError(f"{path}: has a column {word.strip()!r}; its columns must be {KNOWN}")
        try:
            found[name] = in_units(f"1 {match[2]}", COLUMNS[name]) if match[2] and name in POSITION else 1.0
        except InputError as error:
            raise InputError(f"{path}: column {word.strip()!r}: {error}") from None
    return found


# --- what the bodies touch -------------------------------------------------------------------------------------------

#: Tetrahedra that reach farther than this beyond the surface, relative to the height of the body, are said.
FAR = 0.01


@dataclass(eq=False)
class RunContact:
    """What the bodies of a run touch.

    Attributes:
        contact: The options of contact; None: there is no contact.
        obstacles: The obstacles by their names in tables.
    """

    contact: Contact | None
    obstacles: dict[str, Obstacle] = field(default_factory=dict)

    @property
    def moves(self) -> bool:
        """Whether a tool moves."""
        return any(isinstance(each, Tool) and each.keys is not None for each in self.obstacles.values())

    def rows(self, bodies: int) -> list[tuple[str, str]]:
        """Lines of the summary, with this number of bodies."""
        if self.contact is None:
            return []
        found = []
        for name, each in self.obstacles.items():
            shape, moves = (each.shape, each.keys is not None) if isinstance(each, Tool) else (each, False)
            sizes = ", ".join(length(size) for size in shape.size if size > 0.0)
            said = f"{shape!r} ({sizes}), {'moves along its path' if moves else 'stays where it is'}"
            if isinstance(shape, Ground):
                said = f"at {float(axis_of(shape.quaternion) @ shape.position) + 0.0:.4g} m"
            found.append(f"{name}: {said}")
        touches = ["itself" if bodies == 1 else "themselves"] if self.contact.self_contact else []
        touches += ["one another"] if bodies > 1 else []
        found.append("; ".join([*filter(None, [" and ".join(touches)]), f"friction {self.contact.friction:g}"]))
        return [("touches" if place == 0 else "", text) for place, text in enumerate(found)]


def touched_by(options: Sequence[argparse.Namespace]) -> RunContact:
    """The contact that the options request, except the ground, which needs the bodies first.

    Args:
        options: The options of each input.

    Raises:
        InputError: Options that exclude each other, or a file that is no path.
    """
    shared = options[0]
    shapes, paths = shared.tool or [], shared.tool_path or []
    if len(shapes) != len(paths):
        raise InputError(
            f"--tool is given {len(shapes)} times and --tool-path {len(paths)} times; each tool must have one path"
        )
    if shared.drop is not None:
        if not 0.0 < shared.drop < math.inf:
            raise InputError(f"--drop is {shared.drop:g} m; it must be a positive height")
        if isinstance(shared.ground, float):
            raise InputError("--drop puts the ground below the bodies; --ground must be auto then, or left out")
        if any(each.fix not in (None, ["none"]) for each in options):
            raise InputError("--drop lets the bodies fall; --fix must be none then, or left out")
    if shared.no_ground and (shared.ground is not None or shared.drop is not None):
        raise InputError("--no-ground is given with --ground or --drop, which put a ground below the bodies")
    touches = bool(shapes) or shared.ground is not None or shared.drop is not None
    touches = touches or shared.touch or shared.self_contact
    if shared.friction is not None:
        if not touches:
            raise InputError("--friction is for --ground, --drop, --tool, --touch and --self-contact; none is given")
        checked_friction(shared.friction)
    if isinstance(shared.ground, float) and not math.isfinite(shared.ground):
        raise InputError(f"--ground is {shared.ground:g} m; it must be a finite height or auto")
    tools: dict[str, Obstacle] = {
        f"tool {place}": moved(Tool(tool_shape(shape)), path)
        for place, (shape, path) in enumerate(zip(shapes, paths, strict=True), 1)
    }
    friction = Contact().friction if shared.friction is None else shared.friction
    contact = Contact(friction=friction, self_contact=shared.self_contact)
    return RunContact(contact if touches else None, tools)


def place_ground(touched: RunContact, args: argparse.Namespace, bodies: Sequence[RunBody], gravity: Floats) -> None:
    """Add the ground of ``--ground`` or ``--drop``, or of a body that lies, to the obstacles.

    Raises:
        InputError: ``--touch`` for a single body.
    """
    if args.touch and len(bodies) == 1:
        raise InputError("--touch is for several bodies, and there is one (--self-contact is for one body)")
    if args.ground is None and args.drop is None and not any(body.lies for body in bodies):
        return
    touched.contact = touched.contact or Contact()
    up = up_of(bodies[0].subject, gravity)
    height = args.ground
    if height in (None, AUTO):
        # The lowest point on which contact will act.
        whole = are_several() and INTEGRATORS[integrator_name(args)].is_implicit
        is_close = not may_meet(len(bodies), touched.contact)
        owns = [None if whole else own_surface(body.subject.mesh, is_close=is_close) for body in bodies]
        points = [
            body.subject.mesh.points[body.subject.used] if own is None else own.points
            for body, own in zip(bodies, owns, strict=True)
        ]
        height = min(float((each @ up).min()) for each in points) - (args.drop or 0.0)
    touched.obstacles = {"ground": Ground(up, height), **touched.obstacles}


def say_reach(bodies: Sequence[RunBody], sim: Simulation) -> None:
    """Add a note for each body whose tetrahedra reach far beyond its surface, if contact acts on them."""
    if sim.contact is None:
        return
    for body, part in zip(bodies, sim.contact.surface.parts, strict=True):
        phi = getattr(body.soft.mesh, "phi", None)
        if phi is None or part.skin.own is not None:
            continue
        faces, _parents = body.soft.surface_faces
        beyond = np.maximum(phi[np.unique(faces)], 0.0)
        mean, most = float(beyond.mean()), float(beyond.max())
        if mean > FAR * body.subject.height:
            body.subject.notes.append(
                f"contact acts on the tetrahedra, which reach {length(mean)} beyond the surface on average and "
                f"{length(most)} at most; more tetrahedra (--tets) reach less far"
            )
