"""More results of a run: the table of ``--probe`` and ``--csv``, and pictures and films of ``--preview``."""

from __future__ import annotations

import argparse
import contextlib
import csv
import itertools
import math
import pickle
import tempfile
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import IO, TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.contact.shapes import Ground
from warp_corot.contact.tool import Obstacle, Tool
from warp_corot.errors import InputError
from warp_corot.inputs.loading import begin_loading
from warp_corot.io.files.whole import check_output, writing
from warp_corot.io.pictures.preview import FILMS, GIF_FPS, check_film, write_film
from warp_corot.simulation.progress import bar_of

from .options import VIEWS, is_static
from .patches import POINT

if TYPE_CHECKING:
    from PIL.Image import Image

    from warp_corot.body.soft_body import SoftBody
    from warp_corot.io.pictures.preview import Picture
    from warp_corot.simulation.simulation import Simulation

    from .bodies import RunBody
    from .patches import BodyPatches

#: A point outside by more than this fraction of the body's size is not moved to the nearest point inside.
OUTSIDE = 0.05
#: Names and units of the columns of a probe.
COLUMNS = [f"{what}{axis} [{unit}]" for what, unit in (("u", "m"), ("v", "m/s")) for axis in "xyz"]
COLUMNS += [f"reaction {axis} [N]" for axis in "xyz"]

Array = npt.NDArray[np.float64]


class Probe:
    """A probed point or patch of a body.

    A point interpolates the four nodes of its tetrahedron. A patch has the mass-weighted mean over its nodes, and the
    sum of their reactions. Both are found again when the mesh has changed.

    Args:
        text: "X Y Z" [m] at rest, or a patch's expression.
        body: The body.
        patches: The body's patches.

    Raises:
        InputError: A point outside the body, a patch without nodes, or an invalid expression.
    """

    def __init__(self, text: str, body: SoftBody, patches: BodyPatches):
        self.text, self.body, self._patches = text, body, patches
        match = POINT.fullmatch(text)
        self.point = np.array([float(part) for part in match.groups()] if match else 3 * [np.nan])
        self.is_patch = match is None
        self._find()

    def values(self) -> list[float]:
        """Displacement [m], velocity [m/s] and reaction [N], nine numbers."""
        if self._revision != self.body.version:
            self._find()
        u, v = (array.numpy()[self._nodes].astype(float) for array in (self.body.displacements, self.body.velocities))
        r = self.body.reactions.numpy()[self._nodes].astype(float)
        share = np.ones(len(r)) if self.is_patch else self._weights
        return [float(x) for x in (*(self._weights @ u), *(self._weights @ v), *(share @ r))]

    def _find(self) -> None:
        """Find the nodes in the current mesh, or the tetrahedron that contains the point or is nearest; and weights."""
        self._revision, mesh = self.body.version, self.body.mesh
        if self.is_patch:
            self._nodes = np.flatnonzero(self._patches.of_mesh(mesh).some(self.text, "--probe"))
            masses = self.body.masses[self._nodes]
            self._weights = masses / masses.sum()
            return
        (element,), (weights,) = mesh.embed(self.point[None])
        inside = np.clip(weights, 0.0, None)
        self._weights, self._nodes = inside / inside.sum(), mesh.tets[element]
        away = float(np.linalg.norm(self._weights @ mesh.points[self._nodes] - self.point))
        size = float(np.linalg.norm(np.ptp(mesh.points[mesh.tets.ravel()], axis=0)))
        if away > OUTSIDE * size:
            raise InputError(f"--probe {self.text!r}: the point is {away:.3g} m outside the body")


@contextlib.contextmanager
def table_of(
    path: Path, sim: Simulation, probes: Sequence[Probe], obstacles: Mapping[str, Obstacle]
) -> Iterator[Callable[[], None]]:
    """A CSV file with one row for each frame; each row is written at once, by the first of several ranks.

    Args:
        path: The file; a former one stays until the first row.
        sim: The simulation.
        probes: Probes of its bodies.
        obstacles: Obstacles by name; the forces on them and the places of tools have columns.

    Yields:
        A function that adds a row with the current state, or raises a `WriteError` if it cannot be written.
    """
    file: IO[str] | None = None

    def add() -> None:
        nonlocal file
        bodies, energy = sim.bodies, sim.energy()
        row = [("time [s]", sim.time)]
        for probe in probes:
            of = f"body {bodies.index(probe.body) + 1}: " if len(bodies) > 1 else ""
            row += zip([f"{of}{probe.text} {column}" for column in COLUMNS], probe.values(), strict=True)
        for name, each in obstacles.items():
            row += [(f"{name} {column}", value) for column, value in _felt(each).items()]
        row += [(f"{name} [J]", getattr(energy, name)) for name in ("kinetic", "elastic", "gravitational")]
        row.append(("dt [s]", sim.dt))
        if not sim.is_root:
            return
        with writing(path):
            if file is None:
                file = path.open("w", newline="")
                csv.writer(file).writerow([name for name, _ in row])
            csv.writer(file).writerow([f"{value:.9g}" for _, value in row])
            file.flush()

    try:
        yield add
    finally:
        if file is not None:
            file.close()


def _felt(obstacle: Obstacle) -> dict[str, float]:
    """The force on an obstacle in the last step by columns; for a tool its place before, and the torque about it
    after."""
    names = [*(f"force {axis} [N]" for axis in "xyz"), *(f"torque {axis} [N m]" for axis in "xyz")]
    felt = dict(zip(names, map(float, obstacle.wrench.numpy()[0]), strict=True))
    if not isinstance(obstacle, Tool):
        return {name: felt[name] for name in names[:3]}
    return dict(zip((f"{axis} [m]" for axis in "xyz"), obstacle.present_pose[0, :3].tolist(), strict=True)) | felt


# --- what pictures show at one time ----------------------------------------------------------------------------------


class DrawnBodies:
    """What is drawn of bodies: their skins and their stresses, bound again when a mesh has changed."""

    def __init__(self, bodies: Sequence[RunBody], sim: Simulation):
        from warp_corot.io.write.animate import JoinedBodies
        from warp_corot.io.write.skins import BoundSkins

        self._joined = joined = JoinedBodies(sim, 0)
        drawn = [body.subject.drawn(joined.are_cut) for body in bodies]
        self._skins = BoundSkins(joined.meshes, drawn, changing=joined.changing, are_cut=joined.are_cut)

    def frame(self, sim: Simulation) -> Picture:
        """The current state; values are NaN on obstacles."""
        from warp_corot.io.pictures.preview import Picture
        from warp_corot.io.write.skins import ground_corners, poses_of, shape_of, solid_of

        self._joined.has_changed()
        u, held = self._joined.nodal("displacements"), self._joined.fixed.astype(float)
        stress = self._joined.average(self._joined.von_mises(sim))
        parts: list[tuple[np.ndarray, ...]] = [
            (skin.surface.moved(u), skin.surface.triangles, skin.values(stress), skin.surface.points, skin.values(held))
            for skin in self._skins.on(self._joined.meshes)
        ]
        rests, ground = np.concatenate([part[3] for part in parts]), np.zeros((0, 3))
        obstacles = () if sim.contact is None else sim.contact.obstacles.given
        for each, pose in zip(obstacles, poses_of(obstacles), strict=True):
            shape = shape_of(each)
            if isinstance(shape, Ground) and not len(ground):
                ground = ground_corners(shape, rests)
            if (solid := solid_of(shape)) is not None:
                points = solid.at(pose)
                parts.append((points, solid.triangles, np.full(len(points), np.nan), points, np.zeros(len(points))))
        firsts = np.cumsum([0, *(len(part[0]) for part in parts)])
        moved, faces, values, rest, fixed = zip(*parts, strict=True)
        marks = {"held": np.concatenate(fixed) > 0.5} | ({"square": ground} if len(ground) else {})
        return Picture(
            np.concatenate(moved).astype(np.float32),
            np.concatenate([triangles + first for triangles, first in zip(faces, firsts, strict=False)]),
            np.concatenate(values).astype(np.float32),
            np.concatenate(rest),
            options=marks,
        )


# --- pictures of frames from several sides, or a film of all of them -------------------------------------------------

MOST_PANELS, MOST_COLUMNS = 12, 4
#: Pixels of each view of a film.
FILM_SIZE = (640, 540)
#: Directions in which points may lie farthest out, [3, 26].
OUTWARDS = np.array([each for each in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(each)]).T


@dataclass
class Previews:
    """The pictures of ``--preview``: frames are stored during the run and drawn at its end.

    Args:
        args: The command's arguments.
        count: Number of frames after the first one.

    Raises:
        InputError: Invalid frames or views, or a package is missing.
    """

    args: argparse.Namespace
    count: int

    def __post_init__(self) -> None:
        path = self.args.preview
        self.views = _views(self.args.preview_views)
        self.frames, self.fps = _frames(self.args.preview_frames, self.count), self.args.fps
        if is_film(path):
            # A GIF leaves out frames in between.
            every = max(math.ceil(self.fps / GIF_FPS - 1e-9), 1) if path.suffix.lower() == ".gif" else 1
            self.frames, self.fps = list(range(0, self.count + 1, every)), self.fps / every
        elif len(self.frames) * len(self.views) > MOST_PANELS:
            panels = f"{len(self.frames)} frames from {len(self.views)} sides"
            raise InputError(f"--preview would have {panels}; a picture has at most {MOST_PANELS} panels")
        begin_loading(["viewing.pictures"], wp.get_device("cpu"))
        self._file: IO[bytes] | None = None
        # Of all stored frames: points that lie farthest out [m], and the end of the colour map.
        self._outermost: list[np.ndarray] = []
        self._highest = 0.0

    def add(self, frame: int, bodies: Sequence[RunBody], sim: Simulation) -> None:
        """Store the current state if its frame is drawn."""
        from warp_corot.io.pictures.drawing import value_limits

        if frame not in self.frames:
            return
        if self._file is None:
            self._file = tempfile.TemporaryFile()  # noqa: SIM115 (closed with this object)
            self._bodies = DrawnBodies(bodies, sim)
        shown = self._bodies.frame(sim)
        pickle.dump((sim.time, shown), self._file, pickle.HIGHEST_PROTOCOL)
        used = np.unique(shown.faces)
        seen = np.concatenate([np.asarray(each)[used] for each in (shown.positions, shown.rest)])
        self._outermost.append(seen[np.argmax(seen @ OUTWARDS, axis=0)])
        self._highest = max(self._highest, value_limits(shown.scalars)[1])

    def draw(self, bodies: Sequence[RunBody], name: str) -> None:
        """Draw the stored frames.

        Args:
            bodies: The bodies of the run.
            name: The title, before the time.

        Raises:
            OSError: It cannot be written.
        """
        if self._file is None:
            return
        from warp_corot.io.pictures.preview import save_picture

        with bar_of(len(self._outermost), "frames", "drawing") as drawn:
            images = self._shots(name, bodies[0].soft.mesh.up_axis, drawn)
            with contextlib.closing(images):
                if is_film(self.args.preview):
                    write_film(self.args.preview, images, self.fps)
                else:
                    save_picture(next(images), self.args.preview)

    def _shots(self, name: str, up_axis: str, drawn: Callable[[float], None]) -> Generator[Image, None, None]:
        """The frames of a film, or the only picture."""
        from warp_corot.io.pictures.preview import Strip

        assert self._file is not None
        self._file.seek(0)
        film, sides, static = is_film(self.args.preview), len(self.views), is_static(self.args)
        several = len(self.frames) > 1 and not film
        strip, sheet = None, []
        for number, frame in enumerate(self.frames[: len(self._outermost)], start=1):
            time, shown = pickle.load(self._file)
            when = f"frame {frame}" if static else f"{time:.3g} s"
            named = self.args.preview_views.split(",") if sides > 1 else [""]
            titles = [", ".join(filter(None, (side, when if several else ""))) for side in named]
            sheet += [replace(shown, view=view, title=title) for view, title in zip(self.views, titles, strict=True)]
            if not film and number < len(self._outermost):
                continue
            strip = strip or Strip(
                sheet,
                np.concatenate(self._outermost),
                up_axis,
                titled=True,
                value_range=(0.0, self._highest),
                size=(FILM_SIZE[0] * sides, FILM_SIZE[1]) if film else (1200, 900) if len(sheet) == 1 else None,
                columns=sides if film or 1 < sides < len(sheet) else min(len(sheet), MOST_COLUMNS),
            )
            yield strip.draw(
                sheet, name if static or several else f"{name}; {f'{time:.2f}' if film else f'{time:.3g}'} s"
            )
            drawn(number)
            sheet = []


def is_film(path: Path) -> bool:
    return path.suffix.lower() in FILMS


def check_preview(args: argparse.Namespace) -> None:
    """Check, before a long run, that its picture can be drawn.

    Raises:
        InputError: It cannot.
    """
    if args.preview is None:
        return
    if find_spec("matplotlib") is None:
        raise InputError('--preview needs Matplotlib: pip install "warp-corot[plot]"')
    check_output(args.preview, (".png", *FILMS))
    check_film(args.preview)
    if is_film(args.preview) and args.preview_frames is not None:
        raise InputError(f"--preview-frames is for a .png; {args.preview} is a film and has all frames")
    _views(args.preview_views)


def _frames(text: str | None, count: int) -> list[int]:
    """Numbers of frames from 0 to ``count``, in rising order."""
    if text is None:
        return [count]
    found = []
    for word in text.split(","):
        try:
            number = int(word)
        except ValueError:
            raise InputError(f"--preview-frames {text!r}: {word!r} must be a whole number") from None
        if not -count - 1 <= number <= count:
            raise InputError(f"--preview-frames {text!r}: there is no frame {number}; the last one is {count}")
        found.append(number % (count + 1))
    return sorted(set(found))


def _views(text: str | None) -> list[tuple[float, float]]:
    """Azimuth and elevation [°] of each view."""
    if text is None:
        return [VIEWS["corner"]]
    found = []
    for word in text.split(","):
        if word in VIEWS:
            found.append(VIEWS[word])
            continue
        try:
            azimuth, elevation = (float(number) for number in word.split(":"))
        except ValueError:
            azimuth = elevation = np.nan
        if not (np.isfinite(azimuth) and abs(elevation) <= 90.0):
            known = ", ".join(VIEWS)
            raise InputError(f"--preview-views {text!r}: {word!r} must be {known} or AZIMUTH:ELEVATION in degrees")
        found.append((azimuth, elevation))
    return found
