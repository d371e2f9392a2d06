"""What a browser asks for: each command is checked, and done on the session's thread."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_choice, checked_count, checked_flag, checked_number, checked_vector, shown
from warp_corot.remesh.remeshing import OnlineRemesh

from .hands import HANDS
from .saving import Saving
from .server import Visitor
from .session import Session
from .shown import Plane
from .tissue import choices, collapses, present, switched

Command = Callable[[], None]


def _between(low: float, high: float, given: Any, name: str, unit: str = "") -> float:
    number = checked_number(given, name, unit)
    if not low <= number <= high:
        raise InputError(f"{name} is {number:g}; it must be {low:g} to {high:g}{f' [{unit}]' if unit else ''}")
    return number


class Commands:
    """The commands of a page, by the word in ``do``.

    Args:
        session: The session that they change.
        saving: Saves what visitors ask for.
    """

    def __init__(self, session: Session, saving: Saving):
        self._session, self._saving, self._options = session, saving, OnlineRemesh()
        self._known: dict[str, Callable[[Visitor, dict[str, Any]], Command]] = {
            "press": lambda who, asked: self._press(who.number, asked),
            "press tool": lambda who, asked: self._press_tool(who.number, asked),
            "move": lambda who, asked: partial(session.move, who.number, checked_vector(asked["by"], "by")),
            "let go": lambda who, _: partial(session.let_go, who.number),
            "release": lambda *_: session.release_all,
            "change": lambda _, asked: self._change(asked["what"]),
            "use tool": lambda _, asked: partial(session.use_tool, asked["name"], asked["at"]),
            "tissue": lambda _, asked: self._tissue(asked["what"]),
            "step": lambda *_: session.step,
            "reset": lambda *_: session.reset,
            "save": lambda who, asked: self._save(who, asked),
            "end early": lambda *_: saving.end_early,
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
            command = self._known[asked["do"]](visitor, asked)
        except (KeyError, TypeError, AttributeError):
            raise InputError(f"the page asked for {shown(asked)}, which cannot be done") from None
        if asked["do"] not in ("move", "let go"):
            self._session.note = ""
        command()

    def _press(self, owner: int, asked: dict[str, Any]) -> Command:
        body, at = checked_count(asked["body"], "body", 0), checked_vector(asked["at"], "at")
        return partial(self._session.press, owner, body, at)

    def _press_tool(self, owner: int, asked: dict[str, Any]) -> Command:
        return partial(self._session.press_tool, owner, checked_count(asked["number"], "number", 0))

    def _change(self, what: dict[str, Any]) -> Command:
        session = self._session
        checks: dict[str, Callable[[Any, str], Any]] = {
            "running": checked_flag,
            "speed": partial(_between, 0.01, 1.0),
            "hand": partial(checked_choice, choices=HANDS),
            "radius": partial(_between, 0.0, 0.25),
            "strength": partial(_between, 0.02, 1.0),
            "colors": partial(checked_choice, choices=["", *session.sources]),
            "surface": partial(checked_choice, choices=[name for each in session.surfaces for name in each]),
            "world": partial(checked_choice, choices=list(map(str, range(session.sim.worlds)))),
            "plane": lambda given, _: _plane(given),
        }
        values = {name: checks[name](value, name) for name, value in what.items()}
        if "world" in values:
            values["world"] = int(values["world"])
        return partial(session.change, **values)

    def _tissue(self, what: dict[str, Any]) -> Command:
        session, sim = self._session, self._session.sim
        there = choices(sim)
        checks: dict[str, Callable[[Any, str], Any]] = {
            "law": partial(checked_choice, choices=there["laws"]),
            "rotations": partial(checked_choice, choices=there["rotations"]),
            "young": partial(_between, 1.0, 1e12, unit="Pa"),
            "poisson": partial(_between, 0.0, 0.499),
            "density": partial(_between, 1.0, 1e5, unit="kg/m^3"),
            "remesh": checked_flag,
            "weight": checked_flag,
        }
        now = present(sim)
        wanted = now | {name: checks[name](value, name) for name, value in what.items()}
        gravity, size = session.gravity, session.size
        falls = "weight" not in what and collapses(wanted, gravity, size) > collapses(now, gravity, size)
        wanted["weight"] &= not falls
        former = [None if each is None else each.options for each in sim.remeshing.changing]
        remesh = [(each or self._options) if wanted["remesh"] else None for each in former]

        def switch() -> None:
            session.switch(**switched(sim, wanted, gravity), remesh=remesh)
            if falls:
                session.note = "So soft a body of this size would collapse under its weight: Weight is off now."

        return switch

    def _save(self, visitor: Visitor, asked: dict[str, Any]) -> Command:
        seconds = _between(0.1, 600.0, asked["seconds"], "seconds", "s")
        return partial(self._saving.save, visitor, checked_choice(asked["what"], "what", self._saving.kinds), seconds)


def _plane(given: dict[str, Any] | None) -> Plane | None:
    if given is None:
        return None
    axis, share = checked_choice(given["axis"], "axis", "xyz"), _between(0.01, 0.99, given["share"], "share")
    return Plane("xyz".index(axis), share, checked_flag(given["flipped"], "flipped"))
