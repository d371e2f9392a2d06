"""What the browser is told, what it asks for, and what it saves; commands are done on the session's thread."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Callable, Collection, Sequence
from dataclasses import asdict, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from warp_corot.contact.shapes import Ground
from warp_corot.contact.tool import Tool
from warp_corot.elasticity import MODELS, Corotated, EdgeStVK, MassSpring, Prestressed, Prony
from warp_corot.elasticity.dilatation import AUTO
from warp_corot.errors import InputError, UnstableError
from warp_corot.inputs.checks import checked_choice, checked_count, checked_flag, checked_number, checked_vector, shown
from warp_corot.io.pictures.colors import STEEL, TISSUE, stress_colors
from warp_corot.io.pictures.preview import write_film
from warp_corot.io.write.animate import frame_count, record
from warp_corot.io.write.skins import Solid, solid_of
from warp_corot.materials.isotropic import Isotropic
from warp_corot.mesh import TetForest
from warp_corot.remesh.remeshing import OnlineRemesh
from warp_corot.simulation.simulation import Simulation

from .hands import HANDS, ToolHand
from .server import Visitor, packed
from .session import PageFrame, Session
from .shown import INPUT, Plane

if TYPE_CHECKING:
    from PIL.Image import Image

#: Pixels of films and pictures.
WIDTH, HEIGHT = 1280, 720
#: How long a browser may take to draw a picture [s].
PATIENCE = 20.0
#: Frames per second of films and animations.
FPS = 24.0


class Cancelled(Exception):
    """The visitor cancelled."""


class Saving:
    """Saves what visitors ask for; called on the session's thread.

    Args:
        session: The session that is saved.
        show: Sends the present frame to all visitors.
        run_file: The run file of the simulation, or None.

    Attributes:
        kinds: What can be saved: the name of its file, and what writes it and may return a note.
    """

    def __init__(
        self, session: Session, show: Callable[[], None], run_file: Callable[[Simulation], bytes] | None = None
    ):
        self._session, self._show, self._is_cancelled = session, show, False
        self.kinds: dict[str, tuple[str, Callable[[Visitor, float, Path], str | None]]] = {
            "picture": ("picture.png", lambda who, _, path: _drawn(who).save(path)),
            "film": ("film.mp4" if find_spec("imageio_ffmpeg") else "film.gif", self._film),
            "animation": ("animation.usd", self._animation),
            "checkpoint": ("checkpoint.npz", lambda _who, _, path: session.sim.save(path)),
        }
        if run_file is not None:
            text = run_file

            def write(_who: Visitor, _seconds: float, path: Path) -> None:
                path.write_bytes(text(session.sim))

            self.kinds["run file"] = ("run.toml", write)

    def save(self, visitor: Visitor, kind: str, seconds: float) -> None:
        """Save something for a visitor.

        Args:
            kind: One of ``kinds``.
            seconds: The simulated duration of a film or an animation [s].

        Raises:
            InputError: Something is being saved.
        """
        session = self._session
        if session.busy:
            raise InputError("something is being saved; it must end first")
        session.busy, self._is_cancelled = True, False
        try:
            with tempfile.TemporaryDirectory() as folder:
                name, write = self.kinds[kind]
                path = Path(folder, name)
                session.note = write(visitor, seconds, path) or ""
                if path.exists():
                    content = path.read_bytes()
                    visitor.send(packed({"kind": "file", "name": name, "size": len(content)}, content))
        except (OSError, RuntimeError) as error:  # a browser that has gone, a full disk
            session.note = f"nothing was saved: {error}"
        finally:
            session.busy = False
            session.pace.interrupted()

    def end_early(self) -> None:
        """End a film or an animation after the present frame; what there is of it is kept."""
        self._is_cancelled = True

    def _film(self, visitor: Visitor, seconds: float, path: Path) -> None:
        """Save frames at even intervals of simulated time, however long each one takes."""
        count, frames = frame_count(seconds, FPS), list[Path]()
        for number in range(count + 1):
            if self._is_cancelled:
                break
            if number:
                self._session.sim.advance(1.0 / FPS)
            self._between(number, count)
            frames.append(path.with_name(f"{number}.png"))
            _drawn(visitor).save(frames[-1])
        if frames:
            write_film(path, map(_opened, frames), FPS)

    def _animation(self, visitor: Visitor, seconds: float, path: Path) -> str:
        session = self._session

        def progress(number: int, count: int) -> None:
            self._between(number, count)
            if self._is_cancelled:
                raise Cancelled

        try:
            surfaces = [surfaces.get(INPUT) for surfaces in session.surfaces]
            world = session.controls.world
            record(session.sim, path, duration=seconds, fps=FPS, world=world, surface=surfaces, progress=progress)
        except (Cancelled, UnstableError) as error:  # the frames before are there
            return str(error)
        return ""

    def _between(self, number: int, count: int) -> None:
        """Continue during a long save: hands move, and the frame is shown."""
        self._session.take_commands()
        self._session.note = f"frame {number} of {count}"
        self._show()


def _drawn(visitor: Visitor) -> Image:
    """The picture that a browser shows, without its panels.

    Raises:
        OSError, RuntimeError: The browser has left, or does not draw.
    """
    return _opened(io.BytesIO(visitor.drawn(WIDTH, HEIGHT, PATIENCE)))


def _opened(file: Path | io.BytesIO) -> Image:
    from PIL import Image

    with Image.open(file) as image:
        return image.convert("RGB")


# --- tissues: laws, moduli, and tissues of the literature ------------------------------------------------------------

#: Weight over stiffness, density g L / E, from which on a body of length L hardly keeps its shape.
COLLAPSING = 0.15
#: The name of the choice that gives every element its own rotation.
OWN = "own"


class Tissue(NamedTuple):
    """A tissue that a visitor may choose.

    Attributes:
        name: Its name.
        young: Young's modulus [Pa].
        density: [kg/m^3], of Mech. Mater. 44 (2012) 174, table 3.
        source: The source of Young's modulus.
        poisson: Poisson's ratio; all are nearly incompressible, and a larger one takes longer.
    """

    name: str
    young: float
    density: float
    source: str
    poisson: float = 0.45


_ARDA = "Arda et al., AJR 197 (2011) 532: shear waves"
TISSUES = (
    Tissue("brain", 1.9e3, 1040.0, "Budday et al., J. Mech. Behav. Biomed. 46 (2015) 318: white matter, indented"),
    Tissue("fat", 3.25e3, 950.0, "Samani et al., Phys. Med. Biol. 52 (2007) 1565: of the breast, indented"),
    Tissue("kidney", 5.0e3, 1050.0, f"{_ARDA} in the cortex"),
    Tissue("liver", 5.5e3, 1060.0, "Roulot et al., J. Hepatol. 48 (2008) 606: transient elastography, 429 people"),
    Tissue("muscle", 11.1e3, 1050.0, f"{_ARDA} in the gastrocnemius"),
)


def present(sim: Simulation) -> dict[str, Any]:
    """The present tissue of the first body, by the names of ``switched``."""
    material, model = sim.bodies[0].material, sim.models[0]
    mean = material.isotropic
    return {
        "law": next(name for name, kind in MODELS.items() if type(model) is kind),
        "rotations": OWN if (level := getattr(model, "rotation_level", None)) is None else str(level),
        "young": float(np.mean(mean.young)),
        "poisson": float(np.mean(mean.poisson)),
        "density": float(np.mean(material.density)),
        "remesh": bool(sim.remeshing.every),
        "weight": any(sim.gravity),
    }


def choices(sim: Simulation) -> dict[str, Any]:
    """The laws and rotations that can be chosen, and whether Poisson's ratio and remeshing can be."""
    meshes = [body.mesh for body in sim.bodies]
    levels = [int(mesh.levels.max()) for mesh in meshes if isinstance(mesh, TetForest)]
    are_forests = len(levels) == len(meshes)
    now, names = present(sim), [OWN]
    if are_forests:
        names += ["auto", *map(str, range(min(levels)))]
    return {
        "laws": [name for name in MODELS if name == now["law"] or name not in ("prestressed", "prony")],
        "rotations": list(dict.fromkeys([*names, now["rotations"]])),
        "poisson": all(type(body.material) is Isotropic for body in sim.bodies),
        "remesh": sim.worlds == 1 and are_forests,
    }


def switched(sim: Simulation, wanted: dict[str, Any], gravity: Sequence[float]) -> dict[str, Any]:
    """The models, materials and gravity of ``remade`` for a wanted tissue; what stays as it is is left out.

    Args:
        wanted: Values by the names of ``present``.
        gravity: Gravity of bodies with weight [m/s^2], [3].
    """
    now, found = present(sim), dict[str, Any]()
    changes = {name for name, value in now.items() if wanted.get(name, value) != value}
    if changes & {"law", "rotations"}:
        # Only the corotated law shares rotations, and springs share no dilatation; the choice of that stays.
        former, kind, options = sim.models[0], MODELS[wanted["law"]], dict[str, Any]()
        springs = (EdgeStVK, MassSpring)
        if kind not in springs and not isinstance(former, springs):
            options["dilatation"] = getattr(former, "dilatation", AUTO)
        if kind is Corotated and (rotations := wanted["rotations"]) != OWN:
            if rotations != "auto":
                rotations = int(rotations) if rotations.isdecimal() else float(rotations)
            options["rotation_level"] = rotations
        model = former if kind in (Prestressed, Prony) else kind(**options)
        found["models"] = [model] * len(sim.bodies)
    if "weight" in changes:
        found["gravity"] = gravity if wanted["weight"] else (0.0, 0.0, 0.0)
    if changes & {"young", "poisson", "density"}:
        stiffer, found["materials"] = wanted["young"] / now["young"], []
        for material in [body.material for body in sim.bodies]:
            stiff = [name for name in vars(material) if name.startswith(("young", "shear", "k1"))]
            values = {name: getattr(material, name) * stiffer for name in stiff}
            values["density"] = material.density * (wanted["density"] / now["density"])
            if "poisson" in changes and type(material) is Isotropic:
                values["poisson"] = wanted["poisson"]
            found["materials"].append(replace(material, **values))
    return found


# --- what the browser is told ----------------------------------------------------------------------------------------

#: The table of the colours, as one word of hexadecimal digits.
_COLORS = np.rint(255.0 * stress_colors()).astype(np.uint8).tobytes().hex()
#: What is drawn of a ground, which the browser draws itself, and of other obstacles that have no surface.
_NOTHING = Solid(np.zeros((0, 3)), np.zeros((0, 3), np.int32))


def page_told(session: Session, title: str, saves: Collection[str]) -> bytes:
    """The controls, their choices and values, and what the scene is.

    Args:
        saves: What can be saved.
    """
    controls, sim = session.controls, session.sim
    plane = controls.plane
    cut = None if plane is None else {**asdict(plane), "axis": "xyz"[plane.axis]}
    there = [name for name, source in session.sources.items() if any(map(source.applies, sim.bodies))]
    return packed(
        {
            "kind": "page",
            "title": title,
            "elements": sum(body.world_element_count for body in sim.bodies),
            "size": session.size,
            "up": session.up.tolist(),
            "colormap": _COLORS,
            "tissueColor": TISSUE,
            "toolColor": STEEL,
            "controls": {**asdict(controls), "plane": cut, "world": str(controls.world)},
            "tool": session.tool,
            "sources": {name: [session.sources[name].label, session.sources[name].unit] for name in there},
            "surfaces": list(dict.fromkeys(name for each in session.surfaces for name in each)),
            "worlds": sim.worlds,
            "tissue": present(sim),
            "choices": {**choices(sim), "weight": any(session.gravity)},
            "tissues": [each._asdict() for each in TISSUES],
            "saves": list(saves),
            "busy": session.busy,
            "note": session.note,
        }
    )


def topology(session: Session, frame: PageFrame) -> bytes:
    """The rest points and the triangles of each body, and the solids of the obstacles that are drawn."""
    bodies = [(shown.rest, triangles) for shown, triangles in zip(session.shown, frame.triangles, strict=True)]
    solids = [solid_of(tool.shape) or _NOTHING for tool in session.tools]
    grounds = [number for number, tool in enumerate(session.tools) if isinstance(tool.shape, Ground)]
    parts = [*bodies, *((solid.points, solid.triangles) for solid in solids)]
    header = {
        "kind": "topology",
        "bodies": [[len(points), len(triangles)] for points, triangles in bodies],
        "solids": [[len(solid.points), len(solid.triangles)] for solid in solids],
        "movable": [isinstance(each, Tool) for each in session.given],
        "grounds": grounds,
    }
    arrays = [np.ascontiguousarray(points, np.float32) for points, _ in parts]
    arrays += [np.ascontiguousarray(triangles, np.uint32) for _, triangles in parts]
    return packed(header, *arrays)


def frame_told(session: Session, frame: PageFrame) -> bytes:
    """What changes from frame to frame: 13 bytes a point."""
    # Tools that nobody drags need no mark.
    hands = [
        {"place": frame.ends[owner][0].tolist(), "force": force.tolist(), "dragged": isinstance(owner, int)}
        for owner, force in frame.forces.items()
        if isinstance(owner, int) or not isinstance(session.hands[owner], ToolHand)
    ]
    source = session.sources.get(session.controls.colors)
    header = {
        "kind": "frame",
        "time": frame.time,
        "ratio": frame.ratio,
        "slow": bool(frame.slow),
        "highest": frame.highest if source is not None else 0.0,
        "shaded": [shades is not None for shades in frame.shades],
        "force": float(np.linalg.norm(sum(frame.forces.values(), np.zeros(3)))),
        "hands": hands,
        "poses": [pose.tolist() for pose in frame.poses],
    }
    shades = [each for each in frame.shades if each is not None]
    return packed(header, *frame.positions, *shades)


# --- what the browser asks for ---------------------------------------------------------------------------------------


Check = Callable[[Any, str], Any]
#: A whole number that is not negative, and whatever a command itself checks.
COUNT: Check = partial(checked_count, least=0)
ANY: Check = lambda given, _: given  # noqa: E731


def _between(low: float, high: float, unit: str = "") -> Check:
    def check(given: Any, name: str) -> float:
        number = checked_number(given, name, unit)
        if not low <= number <= high:
            raise InputError(f"{name} is {number:g}; it must be {low:g} to {high:g}{f' [{unit}]' if unit else ''}")
        return number

    return check


def _one_of(words: Collection[str]) -> Check:
    return partial(checked_choice, choices=words)


def _plane(given: Any, _: str) -> Plane | None:
    if given is None:
        return None
    axis, share = _one_of("xyz")(given["axis"], "axis"), _between(0.01, 0.99)(given["share"], "share")
    return Plane("xyz".index(axis), share, checked_flag(given["flipped"], "flipped"))


class Commands:
    """The commands of a page, by the word in ``do``.

    Args:
        session: The session that they change.
        saving: Saves what visitors ask for.
    """

    def __init__(self, session: Session, saving: Saving):
        self._session, self._options = session, OnlineRemesh()
        #: What does it, which attribute of the visitor it is told, if any, and the checks of its arguments.
        self._known: dict[str, tuple[Callable[..., None], str, dict[str, Check]]] = {
            "press": (session.press, "number", {"body": COUNT, "at": checked_vector}),
            "press tool": (session.press_tool, "number", {"number": COUNT}),
            "move": (session.move, "number", {"by": checked_vector}),
            "let go": (session.let_go, "number", {}),
            "release": (session.release_all, "", {}),
            "change": (lambda values: session.change(**values), "", {"what": self._controls}),
            "use tool": (session.use_tool, "", {"name": ANY, "at": ANY}),
            "tissue": (self._switch, "", {"what": self._tissue}),
            "step": (session.step, "", {}),
            "reset": (session.reset, "", {}),
            "save": (saving.save, "self", {"what": _one_of(saving.kinds), "seconds": _between(0.1, 600.0, "s")}),
            "end early": (saving.end_early, "", {}),
        }

    def take(self, visitor: Visitor, asked: Any) -> None:
        """Queue a command; may be called from any thread."""
        self._session.ask(lambda: self._do(visitor, asked))

    def left(self, visitor: Visitor) -> None:
        """Queue the release of what a visitor held who has left; may be called from any thread."""
        self._session.ask(lambda: self._session.let_go(visitor.number))

    def _do(self, visitor: Visitor, asked: Any) -> None:
        """Do what a message asks for.

        Raises:
            InputError: The message asks for nothing that there is, or as the command.
        """
        try:
            act, who, checks = self._known[asked["do"]]
            given = [check(asked[name], name) for name, check in checks.items()]
        except (KeyError, TypeError, AttributeError):
            raise InputError(f"the page asked for {shown(asked)}, which cannot be done") from None
        if asked["do"] not in ("move", "let go"):
            self._session.note = ""
        act(*{"": (), "number": (visitor.number,), "self": (visitor,)}[who], *given)

    def _controls(self, what: dict[str, Any], _: str) -> dict[str, Any]:
        """Values of controls, checked."""
        session = self._session
        worlds = _one_of(list(map(str, range(session.sim.worlds))))
        checks: dict[str, Check] = {
            "running": checked_flag,
            "speed": _between(0.01, 1.0),
            "hand": _one_of(HANDS),
            "radius": _between(0.0, 0.25),
            "strength": _between(0.02, 1.0),
            "colors": _one_of(["", *session.sources]),
            "surface": _one_of([name for each in session.surfaces for name in each]),
            "world": lambda given, name: int(worlds(given, name)),
            "plane": _plane,
        }
        return {name: checks[name](value, name) for name, value in what.items()}

    def _tissue(self, what: dict[str, Any], _: str) -> tuple[dict[str, Any], bool]:
        """The tissue that is wanted, checked, and whether it loses its weight, under which it would collapse."""
        session, sim = self._session, self._session.sim
        there, now = choices(sim), present(sim)
        checks: dict[str, Check] = {
            "law": _one_of(there["laws"]),
            "rotations": _one_of(there["rotations"]),
            "young": _between(1.0, 1e12, "Pa"),
            "poisson": _between(0.0, 0.499),
            "density": _between(1.0, 1e5, "kg/m^3"),
            "remesh": checked_flag,
            "weight": checked_flag,
        }
        wanted = now | {name: checks[name](value, name) for name, value in what.items()}
        falls = "weight" not in what and wanted["weight"]
        if falls:
            # Whether bodies would hardly keep their shape under gravity, and did before.
            weight = np.linalg.norm(session.gravity) * session.size
            before, then = (weight * each["density"] > COLLAPSING * each["young"] for each in (now, wanted))
            falls = bool(then and not (before and now["weight"]))
        return wanted | {"weight": wanted["weight"] and not falls}, falls

    def _switch(self, asked: tuple[dict[str, Any], bool]) -> None:
        (wanted, falls), session = asked, self._session
        sim = session.sim
        former = [None if each is None else each.options for each in sim.remeshing.changing]
        remesh = [(each or self._options) if wanted["remesh"] else None for each in former]
        session.switch(**switched(sim, wanted, session.gravity), remesh=remesh)
        if falls:
            session.note = "So soft a body of this size would collapse under its weight: Weight is off now."
