"""``--preview``: pictures of frames from several sides, or a film of all of them."""

from __future__ import annotations

import argparse
import contextlib
import itertools
import pickle
import tempfile
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from warp_corot.errors import InputError
from warp_corot.io.files.whole import check_output
from warp_corot.io.pictures.film import FILMS, check_film, frames_shown, write_film
from warp_corot.simulation.progress import bar_of

from .implicit import is_static
from .options.defaults import VIEWS
from .preview_frame import DrawnBodies, PreviewFrame

if TYPE_CHECKING:
    from PIL.Image import Image

    from warp_corot.io.pictures.preview import Picture
    from warp_corot.simulation.simulation import Simulation

    from .bodies import RunBody

MOST_PANELS, MOST_COLUMNS = 12, 4
#: Pixels of each view of a film, and its approximate number of polygons.
FILM_SIZE, FILM_PIECES = (640, 540), 15_000
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
            self.frames, self.fps = frames_shown(path, list(range(self.count + 1)), self.args.fps)
        elif len(self.frames) * len(self.views) > MOST_PANELS:
            panels = f"{len(self.frames)} frames from {len(self.views)} sides"
            raise InputError(f"--preview would have {panels}; a picture has at most {MOST_PANELS} panels")
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
            self._bodies = DrawnBodies(bodies)
        shown = self._bodies.frame(sim)
        pickle.dump(shown, self._file, pickle.HIGHEST_PROTOCOL)
        used = np.unique(shown.triangles)
        seen = np.concatenate([shown.positions[used], shown.rest[used]])
        self._outermost.append(seen[np.argmax(seen @ OUTWARDS, axis=0)])
        self._highest = max(self._highest, value_limits(shown.values)[1])

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

        with (
            bar_of(len(self._outermost), "frames", "drawing") as drawn,
            contextlib.closing(self._images(name, bodies[0].soft.mesh.up_axis, drawn)) as images,
        ):
            if is_film(self.args.preview):
                write_film(self.args.preview, images, self.fps)
            else:
                save_picture(next(images), self.args.preview)

    def _images(self, name: str, up_axis: str, drawn: Callable[[float], None]) -> Generator[Image, None, None]:
        """The frames of a film, or the only picture."""
        from warp_corot.io.pictures.preview import Strip

        film, sides = is_film(self.args.preview), len(self.views)
        strip = None
        for pictures, title in self._sheets(name, film, drawn):
            if strip is None:
                one = len(pictures) == 1
                strip = Strip(
                    pictures,
                    np.concatenate(self._outermost),
                    up_axis,
                    titled=True,
                    value_range=(0.0, self._highest),
                    size=(FILM_SIZE[0] * sides, FILM_SIZE[1]) if film else (1200, 900) if one else None,
                    fineness=1 if film else 2,
                    columns=sides if film or 1 < sides < len(pictures) else min(len(pictures), MOST_COLUMNS),
                )
            yield strip.draw(pictures, title)

    def _sheets(self, name: str, film: bool, drawn: Callable[[float], None]) -> Iterator[tuple[list[Picture], str]]:
        """Pictures that are drawn side by side, and their title."""
        static, several = is_static(self.args), len(self.frames) > 1
        panels = []
        for number, (frame, shown) in enumerate(zip(self.frames, self._kept(), strict=False), start=1):
            if film:
                yield self._pictures(shown, ""), name if static else f"{name}; {shown.time:.2f} s"
            else:
                when = f"frame {frame}" if static else f"{shown.time:.3g} s"
                panels += self._pictures(shown, when if several else "")
            drawn(number)
        if not film:
            yield panels, name if several or static else f"{name}; {shown.time:.3g} s"

    def _pictures(self, shown: PreviewFrame, frame_title: str) -> list[Picture]:
        """A frame from all sides."""
        from warp_corot.io.pictures.preview import Picture

        named = (self.args.preview_views or "").split(",") if len(self.views) > 1 else [""]
        titles = [", ".join(filter(None, (name, frame_title))) for name in named]
        options: dict[str, Any] = {"held": shown.held} if shown.held.any() else {}
        if len(shown.ground):
            options["square"] = shown.ground
        if is_film(self.args.preview):
            options["pieces"] = FILM_PIECES
        return [
            Picture(shown.positions, shown.triangles, shown.values, shown.rest, words, options, view)
            for view, words in zip(self.views, titles, strict=True)
        ]

    def _kept(self) -> Iterator[PreviewFrame]:
        assert self._file is not None
        self._file.seek(0)
        for _ in self._outermost:
            yield pickle.load(self._file)


def is_film(path: Path) -> bool:
    return path.suffix.lower() in FILMS


def check_preview(args: argparse.Namespace) -> None:
    """Check, before a long run, that its picture can be drawn.

    Raises:
        InputError: It cannot.
    """
    if args.preview is None:
        for name in ("preview_frames", "preview_views"):
            if getattr(args, name) is not None:
                raise InputError(f"--{name.replace('_', '-')} is for --preview, which is not given")
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
