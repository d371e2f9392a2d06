"""The page of a simulation: ``view`` opens it, and ``View`` is the open page."""

from __future__ import annotations

import secrets
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_flag
from warp_corot.inputs.checks import shown as as_shown
from warp_corot.simulation.simulation import Simulation

from .commands import Commands, Saving, frame_told, page_told, topology
from .server import AccessControl, Server, Visitor, is_loopback
from .session import PageFrame, Session

#: The default port of the page.
PORT = 8080


class View:
    """An open page.

    The simulation runs in one thread: the caller of ``run``, or the page's own thread after ``start``. Use it only
    inside ``with page.held():``.

    Args:
        sim: The simulation.
        host: The address to listen at.
        port: The port, 0 for any free one.
        token: The word that visitors need; see ``view``.
        own: The user's own surface of each body, or None.
        made: Called with every simulation that replaces another.
        run_file: Gives the text of the run file that the page saves; None: it saves none.
        title: The title of the page.

    Attributes:
        address: The address to open in a browser.
        port: The port of the page.
        session: The session.

    Raises:
        InputError: See ``view``.
    """

    def __init__(
        self,
        sim: Simulation,
        *,
        host: str = "127.0.0.1",
        port: int = PORT,
        token: str | None = None,
        own: Sequence[Any] | None = None,
        made: Callable[[Simulation], None] | None = None,
        run_file: Callable[[Simulation], bytes] | None = None,
        title: str = "warp_corot",
    ):
        if not isinstance(sim, Simulation) or not sim.ranks.is_alone:
            raise InputError(f"sim is {as_shown(sim)}; it must be a Simulation on one process: Simulation(body)")
        gate = AccessControl(host, token if token is not None or is_loopback(host) else secrets.token_urlsafe(16))
        self._lock, self._over, self._title = threading.RLock(), threading.Event(), title
        self._thread: threading.Thread | None = None
        self._is_closed = False
        self._state: tuple[Any, ...] = ()
        self._told = b""
        self.session = Session(sim, own, made)
        self._saving = Saving(self.session, lambda: self._send(self.session.frame()), run_file)
        commands = Commands(self.session, self._saving)
        with ExitStack() as undone:
            undone.callback(self.session.close)
            self._server = Server(gate, port, commands.take, commands.left)
            undone.callback(self._server.close)
            self.session.prepare()
            undone.pop_all()
        self.port = self._server.port
        self.address = gate.address(self.port)

    @property
    def sim(self) -> Simulation:
        """The present simulation: another one after its law, material or remeshing was switched on the page."""
        return self.session.sim

    def run(self) -> None:
        """Run until ``close`` or an exception, for example Ctrl-C's."""
        due = time.perf_counter()
        while not self._over.is_set():
            with self._lock:
                if self._over.is_set():
                    break
                self._show()
                period = 1.0 / self.session.controls.fps
            # Waits end late by a fraction of a millisecond, which would add up from frame to frame.
            now = time.perf_counter()
            due = max(due + period, now)
            self._over.wait(due - now)

    def start(self) -> None:
        """Run the simulation in the page's own thread."""
        if self._thread is None:
            self._thread = threading.Thread(target=self.run, name="warp_corot page", daemon=True)
            self._thread.start()

    @contextmanager
    def held(self) -> Iterator[Simulation]:
        """Inside this block the simulation is paused, and the caller may read and change it."""
        with self._lock:
            yield self.session.sim

    def close(self) -> None:
        """Close the page; the simulation belongs to the caller again. Further calls do nothing."""
        self._over.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()
        with self._lock:
            if not self._is_closed:
                self._is_closed = True
                self.session.close()
                self._server.close()

    def _show(self) -> None:
        self.session.advance()
        started = time.perf_counter()
        waiting = [each for each in list(self._server.visitors.values()) if each.takes_frame()]
        if waiting:
            self._send(self.session.frame(), waiting)
            self.session.pace.showed(time.perf_counter() - started)

    def _send(self, frame: PageFrame, visitors: Sequence[Visitor] | None = None) -> None:
        """Send a frame to visitors, and what they do not know yet; None: to all, whether they wait for it or not."""
        session = self.session
        state = (session.sim, session.number, session.controls, session.tool, session.busy, session.note)
        if state != self._state:
            self._state, self._told = state, page_told(session, self._title, self._saving.kinds)
        drawn = frame_told(session, frame)
        for visitor in list(self._server.visitors.values()) if visitors is None else visitors:
            if visitor.sent.get("page") is not self._told:
                visitor.send(self._told)
            if visitor.sent.get("number") != frame.number:
                visitor.send(topology(session, frame))
            visitor.sent.update(page=self._told, number=frame.number)
            visitor.send(drawn)

    def __enter__(self) -> View:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<a page at {self.address}{' (closed)' if self._over.is_set() else ''}>"

    def _repr_html_(self) -> str:
        """The page within a notebook."""
        return f'<iframe src="{self.address}" width="100%" height="640" style="border:0"></iframe>'


def view(
    sim: Simulation,
    *,
    host: str = "127.0.0.1",
    port: int = PORT,
    token: str | None = None,
    surface: Any = None,
    wait: bool | None = None,
) -> View:
    """Open a page that shows a simulation and lets a person drag it with the mouse.

    In a script the call returns when Ctrl-C ends the page. In a notebook, or with ``wait=False``, it returns at once,
    and the simulation runs in a thread: use it only inside ``with page.held() as sim:``.

    Args:
        sim: The simulation. Of several worlds the page shows one at a time.
        host: The address to listen at; only this computer reaches the loopback address.
        port: The port, 0 for any free one.
        token: The word that visitors need, as in ``http://HOST:PORT/?token=…``. Without one, only browsers on this
            computer may enter; at an address that others can reach, a random token is chosen and is part of the page's
            address.
        surface: The user's own surface of each body, as ``record`` takes it: a ``SurfaceMesh``, or None.
        wait: Whether to return at the end of the page; None: unless Python is interactive.

    Returns:
        The page; ``close`` ends it.

    Raises:
        InputError: websockets is not installed, the port is taken, or an argument is out of its range.
    """
    if wait is not None:
        checked_flag(wait, "wait")
    own = None if surface is None else list(surface) if isinstance(surface, Sequence) else [surface]
    if own is not None and len(own) != len(getattr(sim, "bodies", own)):
        raise InputError(f"surface names {len(own)} surfaces; there must be one for each body")
    page = View(sim, host=host, port=port, token=token, own=own)
    print(f"the page is at {page.address}", flush=True)
    is_interactive = hasattr(sys, "ps1") or bool(sys.flags.interactive) or "ipykernel" in sys.modules
    if wait or (wait is None and not is_interactive):
        try:
            page.run()
        except KeyboardInterrupt:
            pass
        finally:
            page.close()
    else:
        page.start()
    return page
