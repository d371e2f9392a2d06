"""The controls of a page, and its words, numbers and plot."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Any

import numpy as np

from .cutting import Plane
from .frames import Frame
from .hands import HANDS
from .tissue import Tissue

if TYPE_CHECKING:
    from viser import ViserServer

    from .session import Session

#: How often numbers and the plot are updated [1/s]; frames come more often.
TOLD = 8.0
#: Seconds that the plot shows, and its maximum number of points.
WINDOW, POINTS = 10.0, 400
#: The plot's forces begin at zero.
FROM_ZERO = {"min": {"soft": 0.0, "mode": 1}, "max": {"pad": 0.1, "soft": 0.01, "mode": 1}}
#: No colours, no cut.
NOTHING = "none"


class Panel:
    """The controls of a page. Callbacks only hand commands to the session.

    Args:
        server: viser's server.
        session: The session that they control.
    """

    def __init__(self, server: ViserServer, session: Session):
        self._server, self._session, self._gui = server, session, server.gui
        self._told = -1.0
        self._samples: deque[tuple[float, float]] = deque(maxlen=POINTS)
        self._add_state()
        self._add_time()
        self._add_hands()
        self._add_looks()
        Tissue(server, session)

    # --- words and numbers
    # ----------------------------------------------------------------------------------------------

    def tell(self, frame: Frame, now: float) -> None:
        """Update words, numbers and the plot.

        Args:
            now: Wall time [s].
        """
        force = float(np.linalg.norm(sum(frame.forces.values(), np.zeros(3)))) if frame.forces else 0.0
        if self._samples and frame.time < self._samples[-1][0]:
            self._samples.clear()
        if not self._samples or frame.time > self._samples[-1][0]:
            self._samples.append((frame.time, force))
        if now - self._told < 1.0 / TOLD:
            return
        self._told = now
        self._state.content = state_words(frame, self._session)
        self._force.content = f"force on the tissue: **{newtons(force)}**"
        self._plot.data = self._curve()
        if self._running.label != ("pause" if self._session.controls.running else "go on"):
            self._running.label = "pause" if self._session.controls.running else "go on"

    def _curve(self) -> tuple[np.ndarray, np.ndarray]:
        found = np.array(self._samples).reshape(-1, 2)
        found = found[found[:, 0] > found[-1, 0] - WINDOW] if len(found) else np.zeros((2, 2))
        return np.ascontiguousarray(found[:, 0]), np.ascontiguousarray(found[:, 1])

    # --- controls --------------------------------------------------------------------------------------------------

    def _add_state(self) -> None:
        self._state = self._gui.add_markdown("…")
        self._force = self._gui.add_markdown("…")
        zero = np.zeros(2)
        self._plot = self._gui.add_uplot(
            (zero, zero),
            ({"label": "t [s]"}, {"label": "force [N]", "stroke": "#1458c8", "width": 2}),
            scales={"x": {"time": False, "auto": True}, "y": {"auto": True, "range": FROM_ZERO}},
            legend={"show": False},
            padding=(12, 12, 0, 0),
            aspect=2.0,
        )

    def _add_time(self) -> None:
        session = self._session
        with self._gui.add_folder("time"):
            self._running = self._gui.add_button("pause")
            self._running.on_click(lambda _: session.ask(lambda: session.change(running=not session.controls.running)))
            step = self._gui.add_button("one step", hint="while the simulation is paused")
            step.on_click(lambda _: session.ask(session.step))
            reset = self._gui.add_button("reset")
            reset.on_click(lambda _: session.ask(session.reset))
            self._slider("speed", 0.01, 1.0, 0.01, "speed", hint="1 is real time")

    def _add_hands(self) -> None:
        session = self._session
        with self._gui.add_folder("hand"):
            self._choice("hand", list(HANDS), "hand", "what the left mouse button does on the tissue")
            self._slider("radius", 0.0, 0.25, 0.01, "radius", hint="of the patch, over the body's size")
            self._slider("strength", 0.02, 1.0, 0.02, "strength", hint="of the spring, over the largest stable one")
            release = self._gui.add_button("release all")
            release.on_click(lambda _: session.ask(session.release_all))

    def _add_looks(self) -> None:
        session = self._session
        with self._gui.add_folder("looks"):
            there = [name for name, each in session.sources.items() if any(map(each.applies, session.sim.bodies))]
            colors = self._gui.add_dropdown("colours", [*there, NOTHING], initial_value=session.controls.colors)
            colors.on_update(lambda _: self._change(colors="" if colors.value == NOTHING else colors.value))
            names = list(dict.fromkeys(name for surfaces in session.surfaces for name in surfaces))
            surface = self._gui.add_dropdown("surface", names, initial_value=names[0])
            surface.on_update(lambda _: self._change(surface=surface.value))
            if session.sim.worlds > 1:
                numbers = [str(world) for world in range(session.sim.worlds)]
                world = self._gui.add_dropdown("world", numbers, initial_value=str(session.controls.world))
                world.on_update(lambda _: self._change(world=int(world.value)))
            axis = self._gui.add_dropdown("cut", [NOTHING, "x", "y", "z"])
            place = self._gui.add_slider("place", 0.01, 0.99, 0.01, 0.5)
            flipped = self._gui.add_checkbox("other side", False)

            def cut(_: Any) -> None:
                # The value is read when the command runs: if many moves of the slider wait, the first one sets the last
                # value.
                def change() -> None:
                    there = None if axis.value == NOTHING else "xyz".index(axis.value)
                    session.change(plane=None if there is None else Plane(there, place.value, flipped.value))

                session.ask(change)

            for control in (axis, place, flipped):
                control.on_update(cut)

    # --- pieces ----------------------------------------------------------------------------------------------------

    def _change(self, **values: Any) -> None:
        self._session.ask(lambda: self._session.change(**values))

    def _slider(self, label: str, low: float, high: float, step: float, name: str, hint: str) -> None:
        value = min(max(getattr(self._session.controls, name), low), high)
        slider = self._gui.add_slider(label, low, high, step, value, hint=hint)
        slider.on_update(lambda _: self._change(**{name: slider.value}))

    def _choice(self, label: str, names: list[str], name: str, hint: str) -> None:
        choice = self._gui.add_dropdown(label, names, initial_value=getattr(self._session.controls, name), hint=hint)
        choice.on_update(lambda _: self._change(**{name: choice.value}))


def state_words(frame: Frame, session: Session) -> str:
    """The time, its speed, the meaning of colours, and notes for the visitor."""
    controls = session.controls
    pace = "paused"
    if controls.running:
        pace = f"{frame.ratio:.2g} × real time"
        if frame.slow:
            pace += f", **slower than requested** ({controls.speed:g} ×)"
    lines = [f"t = {frame.time:.2f} s, {pace}"]
    source = session.sources.get(controls.colors)
    if source is not None:
        lines.append(f"{controls.colors}: light is 0, dark is {frame.highest:g} {source.unit}".rstrip())
    count = sum(body.world_element_count for body in session.sim.bodies)
    lines.append(f"{count} tetrahedra")
    if session.note:
        lines.append(f"**{session.note}**")
    return "  \n".join(lines)


def newtons(force: float) -> str:
    """A force to three digits, in N or mN."""
    return f"{1e3 * force:.3g} mN" if 0.0 < force < 1.0 else f"{force:.3g} N"
