"""Saving by a visitor: pictures, films, animations, run files and checkpoints, sent to the browser that asked.

On the page's computer, only files in a temporary folder are written.
"""

from __future__ import annotations

import io
import tempfile
import threading
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from warp_corot.errors import InputError, UnstableError
from warp_corot.io.pictures.film import write_film
from warp_corot.io.write.animate import frame_count, record
from warp_corot.simulation.simulation import Simulation

from .session import Session
from .shown import INPUT

if TYPE_CHECKING:
    from PIL.Image import Image
    from viser import ViserServer

#: Pixels of films and pictures.
WIDTH, HEIGHT = 1280, 720
#: How long a browser may take to draw a picture [s].
PATIENCE = 20.0
#: Frames per second of films and animations, and their initial length [s].
FPS, SECONDS = 24.0, 4.0


class Cancelled(Exception):
    """The visitor cancelled."""


class Saving:
    """The folder of controls that save.

    Args:
        server: viser's server.
        session: The session that is saved.
        show: Sends the present frame to all visitors; called on the session's thread.
        run_file: The run file of the simulation, or None.
    """

    def __init__(
        self,
        server: ViserServer,
        session: Session,
        show: Callable[[], None],
        run_file: Callable[[Simulation], bytes] | None = None,
    ):
        self._session, self._show, self._cancelled = session, show, threading.Event()
        gui = server.gui
        with gui.add_folder("save", expand_by_default=False):
            gui.add_button("picture", hint="as this browser shows it").on_click(self._picture)
            self._seconds = gui.add_number("seconds", SECONDS, min=0.1, max=600.0, step=0.1, hint="of simulated time")
            gui.add_button("film", hint="as this browser shows it").on_click(self._asked(self._film))
            gui.add_button("USD animation").on_click(self._asked(self._animation))
            gui.add_button("end early", hint="what has been made of a film or an animation is kept").on_click(
                lambda _: self._cancelled.set()
            )
            gui.add_button("checkpoint", hint="for Simulation.load").on_click(self._asked(self._checkpoint))
            if run_file is not None:
                text = run_file
                gui.add_button("run file", hint="for warp-corot simulate").on_click(
                    self._asked(lambda client: _send(client, "run.toml", text(session.sim)))
                )

    def _asked(self, save: Callable[[Any], str | None]) -> Callable[[Any], None]:
        """A function that makes the session's thread save something for a client."""

        def clicked(event: Any) -> None:
            self._session.ask(lambda: self._saved(save, event.client))

        return clicked

    def _saved(self, save: Callable[[Any], str | None], client: Any) -> None:
        self._cancelled.clear()
        session = self._session
        if session.busy:
            raise InputError("something is being saved; it must end first")
        session.busy, session.note = True, ""
        try:
            session.note = save(client) or ""
        except (OSError, RuntimeError) as error:  # a browser that has gone, a full disk
            session.note = f"nothing was saved: {error}"
        finally:
            session.busy = False
            session.pace.interrupted()

    # --- pictures --------------------------------------------------------------------------------------------------

    def _picture(self, event: Any) -> None:
        """Save the picture that the browser shows; called on viser's threads."""
        try:
            found = io.BytesIO()
            _drawn(event.client).save(found, format="PNG")
            _send(event.client, "picture.png", found.getvalue())
        except (OSError, RuntimeError) as error:
            note = f"no picture was saved: {error}"
            self._session.ask(lambda: setattr(self._session, "note", note))

    def _film(self, client: Any) -> None:
        """Save frames at even intervals of simulated time, however long each one takes."""
        name = "film.mp4" if find_spec("imageio_ffmpeg") else "film.gif"
        count = frame_count(float(self._seconds.value), FPS)
        with tempfile.TemporaryDirectory() as folder:
            frames = []
            for number in range(count + 1):
                if self._cancelled.is_set():
                    break
                if number:
                    self._session.sim.advance(1.0 / FPS)
                self._between(number, count)
                # Once more, because browsers show colours a frame later.
                self._show()
                frames.append(Path(folder) / f"{number}.png")
                _drawn(client).save(frames[-1])
            if frames:
                write_film(Path(folder) / name, _opened(frames), FPS)
                _send(client, name, (Path(folder) / name).read_bytes())

    # --- files -----------------------------------------------------------------------------------------------------

    def _animation(self, client: Any) -> str:
        session, note = self._session, ""

        def progress(number: int, count: int) -> None:
            self._between(number, count)
            if self._cancelled.is_set():
                raise Cancelled

        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "animation.usd"
            try:
                record(
                    session.sim,
                    path,
                    duration=float(self._seconds.value),
                    fps=FPS,
                    world=session.controls.world,
                    surface=[surfaces.get(INPUT) for surfaces in session.surfaces],
                    progress=progress,
                )
            except (Cancelled, UnstableError) as error:  # the frames before are there
                note = str(error)
            _send(client, path.name, path.read_bytes())
        return note

    def _checkpoint(self, client: Any) -> None:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "checkpoint.npz"
            self._session.sim.save(path)
            _send(client, path.name, path.read_bytes())

    def _between(self, number: int, count: int) -> None:
        """Continue during a long save: hands move, and the frame is shown."""
        self._session.take_commands()
        self._session.note = f"frame {number} of {count}"
        self._show()


def _drawn(client: Any) -> Image:
    """The picture that a browser shows, without its panels.

    Raises:
        RuntimeError: The browser has left, or does not draw.
    """
    from PIL import Image

    try:
        drawn = Image.fromarray(client.get_render(HEIGHT, WIDTH, transport_format="png", timeout=PATIENCE))
    except TimeoutError:
        raise RuntimeError("the browser does not draw; its tab must be visible") from None
    # The background is transparent, which films do not support.
    paper = Image.new("RGBA", drawn.size, "white")
    return Image.alpha_composite(paper, drawn.convert("RGBA")).convert("RGB")


def _opened(frames: list[Path]) -> Iterator[Image]:
    from PIL import Image

    for path in frames:
        with Image.open(path) as image:
            yield image.convert("RGB")


def _send(client: Any, name: str, content: bytes) -> None:
    client.send_file_download(name, content, save_immediately=True)
