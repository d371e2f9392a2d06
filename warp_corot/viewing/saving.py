"""Saving by a visitor: pictures, films, animations, run files and checkpoints, sent to the browser that asked.

On the page's computer, only files in a temporary folder are written.
"""

from __future__ import annotations

import io
import tempfile
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from warp_corot.errors import InputError, UnstableError
from warp_corot.io.pictures.preview import write_film
from warp_corot.io.write.animate import frame_count, record
from warp_corot.simulation.simulation import Simulation

from .server import Visitor, packed
from .session import Session
from .shown import INPUT

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
        kinds: What can be saved.
    """

    def __init__(
        self, session: Session, show: Callable[[], None], run_file: Callable[[Simulation], bytes] | None = None
    ):
        self._session, self._show, self._is_cancelled = session, show, False
        self.kinds: dict[str, Callable[[Visitor, float], str | None]] = {
            "picture": self._picture,
            "film": self._film,
            "animation": self._animation,
            "checkpoint": self._checkpoint,
        }
        if run_file is not None:
            text = run_file
            self.kinds["run file"] = lambda who, _: _send(who, "run.toml", text(session.sim))

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
            session.note = self.kinds[kind](visitor, seconds) or ""
        except (OSError, RuntimeError) as error:  # a browser that has gone, a full disk
            session.note = f"nothing was saved: {error}"
        finally:
            session.busy = False
            session.pace.interrupted()

    def end_early(self) -> None:
        """End a film or an animation after the present frame; what there is of it is kept."""
        self._is_cancelled = True

    # --- pictures --------------------------------------------------------------------------------------------------

    def _picture(self, visitor: Visitor, _: float) -> None:
        found = io.BytesIO()
        _drawn(visitor).save(found, format="PNG")
        _send(visitor, "picture.png", found.getvalue())

    def _film(self, visitor: Visitor, seconds: float) -> None:
        """Save frames at even intervals of simulated time, however long each one takes."""
        name = "film.mp4" if find_spec("imageio_ffmpeg") else "film.gif"
        count = frame_count(seconds, FPS)
        with tempfile.TemporaryDirectory() as folder:
            frames = []
            for number in range(count + 1):
                if self._is_cancelled:
                    break
                if number:
                    self._session.sim.advance(1.0 / FPS)
                self._between(number, count)
                frames.append(Path(folder) / f"{number}.png")
                _drawn(visitor).save(frames[-1])
            if frames:
                write_film(Path(folder) / name, _opened(frames), FPS)
                _send(visitor, name, (Path(folder) / name).read_bytes())

    # --- files -----------------------------------------------------------------------------------------------------

    def _animation(self, visitor: Visitor, seconds: float) -> str:
        session, note = self._session, ""

        def progress(number: int, count: int) -> None:
            self._between(number, count)
            if self._is_cancelled:
                raise Cancelled

        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "animation.usd"
            try:
                record(
                    session.sim,
                    path,
                    duration=seconds,
                    fps=FPS,
                    world=session.controls.world,
                    surface=[surfaces.get(INPUT) for surfaces in session.surfaces],
                    progress=progress,
                )
            except (Cancelled, UnstableError) as error:  # the frames before are there
                note = str(error)
            _send(visitor, path.name, path.read_bytes())
        return note

    def _checkpoint(self, visitor: Visitor, _: float) -> None:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "checkpoint.npz"
            self._session.sim.save(path)
            _send(visitor, path.name, path.read_bytes())

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
    from PIL import Image

    with Image.open(io.BytesIO(visitor.drawn(WIDTH, HEIGHT, PATIENCE))) as drawn:
        return drawn.convert("RGB")


def _opened(frames: list[Path]) -> Iterator[Image]:
    from PIL import Image

    for path in frames:
        with Image.open(path) as image:
            yield image.convert("RGB")


def _send(visitor: Visitor, name: str, content: bytes) -> None:
    visitor.send(packed({"kind": "file", "name": name, "size": len(content)}, content))
