"""A simulation under a person's hands: commands between advances, time that follows a wall clock, frames.

Nothing here depends on a browser. One thread calls ``tick``; others only hand it commands by ``ask``.
"""

from __future__ import annotations

import queue
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from warp_corot.contact.tool import Obstacle, Tool
from warp_corot.cutting.blade import Blade
from warp_corot.errors import InputError, UnstableError
from warp_corot.inputs.loading import CONTACT_ON_CPU, load
from warp_corot.io.pictures.colors import color_index, round_limit
from warp_corot.simulation.remade import remade, tools_lent
from warp_corot.simulation.simulation import Simulation

from .hands import HANDS, SpringHand, Springs, ToolHand, new_tool
from .shown import TOO_WIDE, Plane, Shown, cut, sources, surfaces_of

# --- controls in one direction, frames in the other ------------------------------------------------------------------

Vector: TypeAlias = npt.NDArray[np.float64]


@dataclass
class PageControls:
    """The values of the page's controls.

    Attributes:
        running: Whether the simulation runs.
        speed: Wanted simulated seconds for each second of wall time.
        fps: The most frames per second.
        hand: A name in ``HANDS``.
        radius: Radius of a hand's patch over the body's size.
        strength: Strength of a hand's spring, 0 to 1.
        colors: A name in ``Session.sources``; "" for none.
        surface: The name of the surface that is shown; bodies without it show their first.
        plane: Where bodies are cut, if they are.
        world: The number of the world that is shown.
    """

    running: bool = True
    speed: float = 1.0
    fps: float = 30.0
    hand: str = "drag"
    radius: float = 0.06
    strength: float = 1.0
    colors: str = "stress"
    surface: str = ""
    plane: Plane | None = None
    world: int = 0


@dataclass(frozen=True, eq=False)
class PageFrame:
    """The picture at one time.

    Attributes:
        number: The version of the surfaces' topology, which changes with the triangles.
        positions: The shown points of each body [m], float32 [V, 3].
        triangles: int32 [F, 3] for each body.
        shades: The number of each point's colour in a table of 256, uint8 [V] for each body; None: without colours.
        highest: The value of the last colour.
        poses: Position [m] and quaternion (x, y, z, w) of each obstacle, float64 [7].
        time: Simulated time [s].
        ratio: Simulated over wall time, lately.
        slow: Whether that is less than was requested.
        forces: The force of each hand that holds something, by its owner [N], float64 [3].
        ends: The two ends of each of these hands' springs [m].
    """

    number: int
    positions: Sequence[npt.NDArray[np.float32]]
    triangles: Sequence[npt.NDArray[np.int32]]
    shades: Sequence[npt.NDArray[np.uint8] | None]
    highest: float
    poses: Sequence[Vector]
    time: float
    ratio: float
    slow: bool
    forces: dict[Any, Vector]
    ends: dict[Any, tuple[Vector, Vector]]


# --- simulated time over wall time -----------------------------------------------------------------------------------

#: The least share of a frame's time for steps, however long the rest takes.
STEPPING = 0.4
#: Time is made up for that was lost within this many periods of frames.
MOST_LATE = 4.0
#: Time counts as slow below this share of the requested speed.
SLOW = 0.9


@dataclass
class RealTimeFactor:
    """The speed of simulated time.

    Attributes:
        rate: Simulated seconds per second of stepping, lately.
        ratio: Simulated over wall time, lately.
        rest: Wall time of a frame without its steps, lately [s].
    """

    rate: float = 0.0
    ratio: float = 0.0
    rest: float = 0.0
    _owed: float = 0.0
    _since: float = 0.0
    _then: float = 0.0

    def wanted(self, speed: float, period: float) -> float:
        """Simulated seconds of the next frame: as many as requested since the last one began, and as are still owed
        from those before, if there is time enough for them.

        Args:
            speed: Wanted simulated seconds for each second of wall time.
            period: Period of frames [s].
        """
        now = time.perf_counter()
        self._since, self._then = (now - self._then if self._then else period), now
        late = MOST_LATE * period
        self._owed = min(self._owed + speed * self._since, speed * late)
        # Frames that were late may take longer, but less so each time.
        length = 0.5 * (period + min(max(self._since, period), late))
        return min(self._owed, self.rate * max(length - self.rest, STEPPING * period) if self.rate else self._owed)

    def is_slow(self, speed: float) -> bool:
        """Whether simulated time is slower than requested."""
        return 0.0 < self.ratio < SLOW * speed

    def took(self, simulated: float, stepping: float) -> None:
        """Note an advance: its simulated time, and its time for steps [s]."""
        self._owed = max(self._owed - simulated, 0.0)
        if simulated > 0.0:
            self.rate = _mean(self.rate, simulated / max(stepping, 1e-9), 0.3)
        if self._since:
            self.ratio = _mean(self.ratio, simulated / self._since, 0.1)

    def showed(self, rest: float) -> None:
        """Note how long a frame took to read and send [s]."""
        self.rest = _mean(self.rest, rest, 0.3)

    def interrupted(self) -> None:
        """Forget the time before an interruption."""
        self._owed = self._since = self._then = 0.0


def _mean(before: float, now: float, share: float) -> float:
    return now if not before else before + share * (now - before)


# --- the session -----------------------------------------------------------------------------------------------------

#: The way of a knife in a step over the size of the smallest element, at most.
HALF_ELEMENT = 0.5


class Session:
    """A simulation, its shown surfaces, and the hands that hold it.

    Args:
        sim: The simulation.
        own: The user's own surface of each body, or None.
        made: Called with every simulation that replaces another.

    Attributes:
        sim: The present simulation; a switch of law, material or remeshing replaces it.
        controls: The page's controls; only commands change them.
        shown: The shown surfaces of each body.
        hands: The hands that hold something, by who moves them.
        note: A note for the person, or "".
        gravity: Gravity at the beginning [m/s^2], [3].
        tool: The name of the tool that the page has put into the scene, or "".
        busy: Whether something is being saved, so that the simulation must not be replaced.
    """

    def __init__(
        self,
        sim: Simulation,
        own: Sequence[Any] | None = None,
        made: Callable[[Simulation], None] | None = None,
    ):
        self.sim, self.controls, self.note, self.busy = sim, PageControls(), "", False
        self._own = list(own or [None] * len(sim.bodies))
        self._made = made
        self.tool, self.gravity = "", sim.gravity
        self._given = sim.obstacles, None if sim.contact is None else sim.contact.options
        self._cuts = () if sim.blades is None else sim.blades.blades
        self._commands: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self.hands: dict[Any, SpringHand | ToolHand] = {}
        self.pace = RealTimeFactor()
        self.springs: Springs
        self._highest: float
        self.number = 0
        self._versions: list[int] = []
        self._steps_asked = 0
        self._open()

    # --- commands --------------------------------------------------------------------------------------------------

    def ask(self, command: Callable[[], None]) -> None:
        """Queue a command to be called between two advances; may be called from any thread."""
        self._commands.put(command)

    def take_commands(self) -> None:
        """Call all waiting commands. A refused command leaves a note."""
        while True:
            try:
                command = self._commands.get_nowait()
            except queue.Empty:
                return
            try:
                command()
            except (InputError, LookupError, UnstableError) as error:
                self.note = str(error)

    def change(self, **values: Any) -> None:
        """Change controls, and the picture with them."""
        before = self.controls
        self.controls = now = replace(before, **values)
        if (now.surface, now.plane, now.world) != (before.surface, before.plane, before.world):
            self._show()

    def step(self, count: int = 1) -> None:
        """Make a number of steps while the simulation is paused."""
        self._steps_asked += count

    def reset(self) -> None:
        """Release everything and return to the beginning.

        Raises:
            InputError: Something is being saved.
        """
        self._check_free()
        self.release_all()
        self.sim.reset()
        self.note = ""

    def switch(self, **what: Any) -> None:
        """Continue with other laws, materials or remeshing: the arguments of ``remade``. All hands let go.

        Raises:
            InputError: Something is being saved, or as ``remade``; then nothing has changed.
        """
        self._check_free()
        what.setdefault("remesh", list(self.sim.remesh))
        held = {grasp for hand in self.hands.values() if isinstance(hand, ToolHand) for grasp in hand.grasps}
        what.setdefault("grasps", [grasp for grasp in self.sim.grasps if grasp not in held])
        with tools_lent(self.sim):
            again = remade(self.sim, **what)
            if self._made is not None:
                self._made(again)
        self._close()
        self.sim = again
        self._open()

    def use_tool(self, name: str, place: npt.ArrayLike = (0.0, 0.0, 0.0)) -> None:
        """Put a tool of the page into the scene in place of the last one; "" takes that away. All hands let go.

        Args:
            name: A name in ``SHAPES``, or "".
            place: Where it begins [m], [3], or near there, where it is clear of the bodies.

        Raises:
            InputError: As ``new_tool`` and ``switch``; then nothing has changed.
        """
        given, contact = self._given
        points = np.concatenate([shown.positions for shown in self.shown])
        added: list[Tool] = []
        if name:
            dt = self.sim.integrator.dt
            least = min(body.discretization.smallest_volume for body in self.sim.bodies) ** (1.0 / 3.0)
            fastest_cut = HALF_ELEMENT * least / float(dt or self.sim.stable_dt)
            added = [new_tool(name, self.size, self.up, place, points, dt, fastest_cut)]
        cuts = [each for each in added if isinstance(each, Blade)]
        tools = [each for each in added if each not in cuts]
        self.switch(obstacles=[*given, *tools], contact=contact, cuts=[*self._cuts, *cuts])
        self.tool = name

    def close(self) -> None:
        """Release everything and leave the simulation as it is."""
        self._close()

    # --- hands -----------------------------------------------------------------------------------------------------

    def press(self, owner: Any, body: int, position: npt.ArrayLike) -> None:
        """Take hold, with a mouse, of the place of a body's shown surface that is nearest to a position [m].

        If a hand that stays holds that place already, the mouse moves it.
        """
        shown = self.shown[body]
        pick = shown.pick(body, position)
        for held, hand in list(self.hands.items()):
            if not isinstance(hand, SpringHand) or not hand.stays or hand.pick.body != body:
                continue
            apart = float(np.linalg.norm(shown.at(hand.pick, shown.rest) - shown.at(pick, shown.rest)))
            if apart < max(self.controls.radius, 0.02) * self.size:
                self.hands[owner] = self.hands.pop(held)
                hand.begin()
                return
        self.let_go(owner)
        kind = HANDS[self.controls.hand]
        radius = self.controls.radius * self.size
        self.hands[owner] = kind(self.springs, shown, pick, radius, self.controls.strength)

    def press_tool(self, owner: Any, number: int) -> None:
        """Take an obstacle with a mouse. With the hand ``grasp`` the tool also holds the tissue that is near it.

        Raises:
            InputError: The obstacle is not a ``Tool``, something else moves it, or there is no tissue to grasp.
        """
        given = self.given[number]
        if not isinstance(given, Tool):
            raise InputError(f"the {given!r} does not move; a Tool of its shape would")
        self.let_go(owner)
        held = [key for key, hand in self.hands.items() if isinstance(hand, ToolHand) and hand.tool is given]
        hand = self.hands.pop(held[0]) if held else ToolHand(given, self.controls.world)
        assert isinstance(hand, ToolHand)
        self.hands[owner] = hand
        hand.begin()
        if self.controls.hand == "grasp":
            hand.grasp(self.sim.bodies, self.controls.radius * self.size)

    def move(self, owner: Any, motion: npt.ArrayLike) -> None:
        """Move a hand to the mouse's present distance from where it was pressed [m], [3]."""
        if owner in self.hands and np.isfinite(motion).all():
            self.hands[owner].move(np.asarray(motion, dtype=np.float64))

    def let_go(self, owner: Any) -> None:
        """Release the mouse; hands that stay hold on."""
        hand = self.hands.get(owner)
        if hand is None:
            return
        if hand.stays:
            self.hands[(owner, id(hand))] = self.hands.pop(owner)
        else:
            self.hands.pop(owner).release()

    def release_all(self) -> None:
        """Release all hands."""
        for hand in self.hands.values():
            hand.release()
        self.hands.clear()

    def prepare(self) -> None:
        """Compile what frames, hands and the page's tools launch, several modules at a time."""
        explicit = not self.sim.system.is_implicit
        contact = CONTACT_ON_CPU if explicit and not self.sim.device.is_cuda else ()
        load(["contact.grasp", *contact], self.sim.device)
        self.sim.advance_steps(1)
        self.frame()

    # --- time ------------------------------------------------------------------------------------------------------

    def advance(self) -> None:
        """Take commands, and advance as far as a frame's time allows."""
        self.take_commands()
        before = self.sim.total_time
        stepping = -time.perf_counter()
        try:
            if self.controls.running:
                self.sim.advance(self.pace.wanted(self.controls.speed, 1.0 / self.controls.fps))
            elif self._steps_asked:
                self.sim.advance_steps(self._steps_asked)
        except UnstableError as error:
            self.note = f"{error}; the simulation is paused, and 'Start again' goes back to the beginning"
            self.controls = replace(self.controls, running=False)
        stepping += time.perf_counter()
        self._steps_asked = 0
        self.pace.took(self.sim.total_time - before, stepping)

    def frame(self) -> PageFrame:
        """The present frame."""
        versions = [body.version for body in self.sim.bodies]
        if versions != self._versions:
            self._versions = versions
            if self.sim.remeshing.are_cut:
                self._show_cuts()
            self.springs.refit()
        positions = [shown.read() for shown in self.shown]
        source = self.sources.get(self.controls.colors)
        values = [
            source.values(self.sim, shown) if source is not None and source.applies(shown.body) else None
            for shown in self.shown
        ]
        largest = max((float(v.max(initial=0.0)) for v in values if v is not None), default=0.0)
        least = 0.0 if source is None else max(map(source.least, self.shown))
        # The colours end at a round number that follows the largest value.
        largest = max(largest, least)
        if largest > self._highest or largest < self._highest / TOO_WIDE:
            self._highest = round_limit(largest)
        return PageFrame(
            number=self.number,
            positions=positions,
            triangles=[shown.triangles for shown in self.shown],
            shades=[None if v is None else color_index(v, 0.0, self._highest).astype(np.uint8) for v in values],
            highest=self._highest,
            poses=[tool.present_pose[self.controls.world] for tool in self.tools],
            time=self.sim.time,
            ratio=self.pace.ratio,
            slow=self.controls.running and self.pace.is_slow(self.controls.speed),
            forces={owner: hand.force for owner, hand in self.hands.items()},
            ends={owner: hand.ends for owner, hand in self.hands.items()},
        )

    # --- pieces ----------------------------------------------------------------------------------------------------

    @property
    def size(self) -> float:
        """The longest side of the box around all bodies at rest [m]."""
        return float(np.ptp(self.bounds, axis=0).max())

    @property
    def up(self) -> Vector:
        """The direction against gravity; without weight, the bodies' own upward axis. Float64 [3]."""
        against = -np.asarray(self.sim.gravity, dtype=np.float64)
        if not against.any():
            against = np.eye(3)["XYZ".index(self.sim.bodies[0].mesh.up_axis)]
        return against / np.linalg.norm(against)

    @property
    def bounds(self) -> Vector:
        """Lowest and highest coordinates of all bodies at rest [m], [2, 3]."""
        points = [body.mesh.points for body in self.sim.bodies]
        return np.stack([np.min([p.min(axis=0) for p in points], 0), np.max([p.max(axis=0) for p in points], 0)])

    @property
    def given(self) -> list[Obstacle]:
        """The rigid obstacles that bodies touch, as they were given, and the blades that cut them."""
        return [*self.sim.obstacles, *(() if self.sim.blades is None else self.sim.blades.blades)]

    @property
    def tools(self) -> list[Tool]:
        """The same as tools."""
        sim = self.sim
        moved = (None if sim.contact is None else sim.contact.obstacles, sim.blades)
        return [tool for each in moved if each is not None for tool in each.tools]

    def _check_free(self) -> None:
        if self.busy:
            raise InputError("something is being saved; it must end first")

    def _open(self) -> None:
        """Begin with the present simulation."""
        self.sources = sources()
        self._highest = 0.0
        own = zip(self.sim.bodies, self._own, strict=True)
        self.surfaces = [surfaces_of(body.mesh, each) for body, each in own]
        self.shown: list[Shown] = []
        self._show(first=True)

    def _show(self, first: bool = False) -> None:
        """Show the surfaces that the controls name; hands let go."""
        if not first:
            self._close()
        self.shown, plane = [], self.controls.plane
        for body, surfaces in zip(self.sim.bodies, self.surfaces, strict=True):
            surface = surfaces.get(self.controls.surface) or next(iter(surfaces.values()))
            surface = surface if plane is None else cut(surface, body.mesh, plane)
            self.shown.append(Shown(body, surface, self.controls.world))
        self.springs = Springs(self.sim, self.shown)
        self.number += 1
        for shown in self.shown:
            shown.read()

    def _show_cuts(self) -> None:
        """Show the surfaces of bodies that may have been cut. Only hands on tools go on: places of tissue are new."""
        self.surfaces = [surfaces_of(body.mesh) for body in self.sim.bodies]
        kept = {owner: hand for owner, hand in self.hands.items() if isinstance(hand, ToolHand)}
        self.hands = {owner: hand for owner, hand in self.hands.items() if owner not in kept}
        self._show()
        self.hands |= kept

    def _close(self) -> None:
        self.release_all()
        self.springs.close()
        for shown in self.shown:
            shown.close()
