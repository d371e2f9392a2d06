"""Recording of a simulation, frame by frame, as a USD animation."""

from __future__ import annotations

import math
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from functools import cached_property
from importlib.metadata import PackageNotFoundError, version
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.contact.reading import contact_at_nodes
from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_number, checked_path, shown
from warp_corot.inputs.simulation_lock import under_lock
from warp_corot.inputs.stopwatch import WATCH
from warp_corot.io.pictures.colors import VertexAverage
from warp_corot.simulation.parts import check_whole
from warp_corot.simulation.progress import bar_of, hidden
from warp_corot.simulation.simulation import Simulation

from .skins import BoundSkins, has_domain

if TYPE_CHECKING:
    from warp_corot.io.write.usd.pieces import ColoredStage

    from .paraview import ParaViewWriter
    from .skins import Surface

Progress = Callable[[int, int], None]

#: A frame with more steps would take years.
MOST_STEPS = 1e12


@dataclass
class Recording:
    """The progress of a recording.

    Attributes:
        path: The stage.
        frames: Number of written frames, the first one included.
        steps: Number of time steps.
        simulated: Simulated time [s].
        elements: Tetrahedra of the drawn bodies in one world, for each frame; they change only with remeshing.
        stepping: Wall time of stepping [s], without writing.
        writing: Wall time of reading the state and writing it [s].
        largest_displacement: Largest displacement from rest of any node in any frame [m].
        final_displacement: The same in the last frame [m].
    """

    path: Path
    frames: int = 0
    steps: int = 0
    simulated: float = 0.0
    elements: list[int] = field(default_factory=list)
    stepping: float = 0.0
    writing: float = 0.0
    largest_displacement: float = 0.0
    final_displacement: float = 0.0


class JoinedBodies:
    """The bodies of a simulation in one world as one mesh and one material, body after body."""

    def __init__(self, sim: Simulation, world: int):
        self.worlds = [body.world(world) for body in sim.bodies]
        self.up_axis = sim.bodies[0].mesh.up_axis
        self.changing = [changing is not None for changing in sim.remeshing.changing]
        self.are_cut = sim.remeshing.are_cut
        self._join()

    def has_changed(self) -> bool:
        """Whether the mesh has changed since the last call; if so, everything is updated to the current mesh."""
        if self._revisions == [world.body.version for world in self.worlds]:
            return False
        self._join()
        return True

    @property
    def meshes(self) -> list[Any]:
        return [world.body.mesh for world in self.worlds]

    def skins(
        self, surface: Surface | Sequence[Surface | None] | None, tets: bool | None, labels: bool
    ) -> BoundSkins | None:
        """Surfaces that are drawn in place of the boundary of the tetrahedra; None if there are only tetrahedra."""
        self.are_plain = surface is None and not labels and not any(map(has_domain, self.meshes))
        if self.are_plain and tets is not False and not self.are_cut:
            return None
        return BoundSkins(self.meshes, surface, labels, self.changing, self.are_cut)

    @cached_property
    def average(self) -> VertexAverage:
        """The average from tetrahedra to nodes."""
        return VertexAverage.of(self)

    def nodal(self, name: str) -> npt.NDArray[Any]:
        """An array of the bodies with a row for each node, by its name."""
        return np.concatenate([getattr(world, name).numpy() for world in self.worlds])

    def von_mises(self, sim: Simulation) -> npt.NDArray[np.float32]:
        """Von Mises stress of all tetrahedra [Pa], [T]."""
        return np.concatenate([sim.von_mises(world.body)[world.elements] for world in self.worlds])

    def _join(self) -> None:
        self._revisions = [world.body.version for world in self.worlds]
        vars(self).pop("average", None)
        meshes = self.meshes
        offsets = np.cumsum([0, *(len(mesh.points) for mesh in meshes)])
        self.points = np.concatenate([mesh.points for mesh in meshes])
        self.tets = np.concatenate([mesh.tets + n for mesh, n in zip(meshes, offsets[:-1], strict=True)])
        self.tets = self.tets.astype(np.int32)
        self.fixed = np.concatenate([w.body.constrained[w.nodes] for w in self.worlds])
        for name in ("young", "poisson", "density"):
            values = []
            for world in self.worlds:
                body, given = world.body, getattr(world.body.material.isotropic, name)
                values.append(np.broadcast_to(given, (body.worlds, len(body.mesh.tets)))[world.index])
            joined = np.concatenate(values).astype(np.float64)
            setattr(self, name, float(joined[0]) if (joined == joined[0]).all() else joined)


def steps_per_frame(fps: float, dt: float) -> int:
    """The smallest number of steps, none longer than ``dt`` [s], that makes a frame.

    Raises:
        InputError: There would be too many steps to count.
    """
    count = 1.0 / fps / dt
    if count > MOST_STEPS:
        raise InputError(f"a frame of {1.0 / fps:.3g} s would take {count:.3g} steps of {dt:.3g} s")
    return max(math.ceil(count * (1.0 - 1e-9)), 1)


def frame_count(duration: float, fps: float) -> int:
    """The number of frames after the first one, nearest to ``duration`` [s].

    Raises:
        InputError: A value is not positive and finite, or the duration is shorter than half a frame.
    """
    for name, value, unit in (("fps", fps, ""), ("duration", duration, " s")):
        if not 0 < checked_number(value, name) < math.inf:
            raise InputError(f"{name} is {value:g}{unit}; it must be a positive number")
    count = round(duration * fps)
    if count < 1:
        raise InputError(f"duration is {duration:g} s; it must be at least one frame, {1.0 / fps:.3g} s")
    return count


def rounding(duration: float, fps: float) -> str | None:
    """What to tell users about a duration [s] that is not a whole number of frames; None if it is one."""
    end = frame_count(duration, fps) / fps
    if math.isclose(end, duration, rel_tol=1e-3):
        return None
    rates = range(math.ceil(fps), math.ceil(fps) + 100)
    better = next((rate for rate in rates if math.isclose(rate * duration, round(rate * duration))), None)
    cure = "" if better is None else f"; with --fps {better} it ends there"
    return f"the last frame shows {end:.4g} s, not {duration:.4g} s, since frames come every {1.0 / fps:.3g} s{cure}"


def shortening(dt: float, fps: float) -> str | None:
    """What to tell users about a step [s] that is shortened until a whole number makes a frame, or that is longer than
    a second; None otherwise."""
    steps = steps_per_frame(fps, dt)
    used, asked = 1.0 / (fps * steps), f"{dt:g} s" if dt > 1.0 else f"{1e3 * dt:.4g} ms"
    near = sorted(range(max(steps - 50, 1), steps + 50), key=lambda count: abs(count - 1.0 / (fps * dt)))
    rates = [f"{1.0 / (count * dt):.4g}" for count in near]
    exact = [rate for rate in rates if math.isclose((count := 1.0 / (float(rate) * dt)), round(count))]
    # A rate that is rounded up: otherwise the step would be a little too long, and another one would be needed.
    rate = exact[0] if exact else f"{1.000005 / (steps * dt):.6g}"
    cure = f"; did you mean --dt {dt:g}ms?" if dt > 1.0 else f"; with --fps {rate} they take that"
    if not math.isclose(used, dt, rel_tol=1e-3):
        whole = f"since a whole number of them makes a frame of {1e3 / fps:.4g} ms"
        return f"steps take {1e3 * used:.4g} ms, not {asked}, {whole}{cure}"
    return f"steps take {asked}{cure}" if dt > 1.0 else None


def record(
    sim: Simulation,
    path: str | PathLike[str],
    *,
    duration: float | None,
    fps: float = 24.0,
    world: int | None = None,
    surface: Surface | Sequence[Surface | None] | None = None,
    tets: bool | None = None,
    labels: bool = False,
    also: Sequence[str | PathLike[str]] = (),
    progress: Progress | None = None,
    recording: Recording | None = None,
    about: Mapping[str, Any] | None = None,
) -> Recording:
    """Advance a simulation and write ``fps`` frames a second, the current state first.

    Several bodies become one mesh, body after body. For a mesh made from a domain, the smooth marched surface is
    written instead of the tetrahedra; for any other mesh, the tetrahedra and their boundary. For a body that is
    remeshed, each frame shows the current mesh; smooth surfaces stay the same and are bound to it. Obstacles and tools
    are drawn, too, with the forces on tools. Frame k shows the state at k / fps, or, for a simulation with a given
    step, after the nearest whole number of steps. If the run is interrupted, the written frames stay: Ctrl-C and
    SIGTERM wait while a frame is being written. On several ranks, all must call this, and the first one writes.

    Args:
        sim: The simulation; it continues from its current state.
        path: A .usd, .usdc or .usda file; a former file stays until the first frames are complete.
        duration: Simulated time [s], rounded to whole frames; None: the current state is the only frame.
        fps: Frames per second of simulated time.
        world: The world that is drawn; must be given if there are several.
        surface: A surface in place of the mesh's own, for several bodies one each (None for the mesh's own): from
            ``mesh.bind(points, triangles)``; or a USD file with Mesh prims, or another surface file, in the mesh's
            coordinates. Its parts are bound to the mesh and keep their names, faces, texture coordinates, subsets and
            materials; parts without materials and colours show the stress.
        tets: Whether to write the TetMesh prim; None: only without a smooth surface.
        labels: Draw each label of the mesh as a separate closed surface, in place of one around all.
        also: Files for ParaView with displacement, velocity, strain and stress: .pvd with all frames, .vtu with the
            last one.
        progress: Called with the number of finished frames and of all frames after each; None: terminals show a bar
            after two seconds.
        recording: Filled during the run, so that it is available if the run ends early.
        about: More data about the run, besides those that are recorded for every simulation: texts, numbers and
            dictionaries of them, under "warp_corot" in the layer's custom data.

    Returns:
        The progress at the end.

    Raises:
        InputError: A path that cannot be written to, a duration or frame rate out of range, no such world, or a
            surface that does not fit; nothing was simulated or written.
        UnstableError: The state is no longer finite; the frames before are kept.
        OSError: The file cannot be written, for example because the disk is full; all but the last seconds are kept.
    """
    from warp_corot.io.write.usd.prims import Touched
    from warp_corot.io.write.usd.writer import UsdWriter

    from .paraview import ParaViewWriter, frame_of

    if not isinstance(sim, Simulation):
        raise InputError(f"sim is {shown(sim)}; it must be a Simulation, for example Simulation(body)")
    checked_path(path, "path")
    count = 0 if duration is None else frame_count(duration, fps)
    for body in sim.bodies:
        check_whole(body)
    others = [ParaViewWriter(Path(other)) for other in also if sim.is_root]
    if world is None and sim.worlds > 1:
        raise InputError(f"the simulation has {sim.worlds} worlds; choose the one to draw, for example world=0")
    joined = JoinedBodies(sim, world or 0)
    skins = joined.skins(surface, tets, labels)
    writer: Any = _Unwritten(Path(path))
    if sim.is_root:
        writer = UsdWriter(
            Path(path),
            joined,
            fps=fps,
            fixed=joined.fixed,
            material=joined,
            skins=skins.on(joined.meshes) if skins else (),
            tets=True if tets is None and joined.are_plain else tets,
            changing=any(joined.changing),
            gravity=sim.gravity,
            obstacles=() if sim.contact is None else sim.contact.obstacles.given,
            world=world or 0,
        )
    told = {**provenance(sim, joined.fixed), **(about or {})}
    done = Recording(writer.path) if recording is None else recording
    first_time = sim.total_time

    @under_lock
    def write_state() -> None:
        touched = None
        if sim.contact is not None:
            drawn = zip(sim.bodies, joined.worlds, strict=True)
            found = [contact_at_nodes(sim.contact, k, body, world.index) for k, (body, world) in enumerate(drawn)]
            touched = Touched(*(np.concatenate(each) for each in zip(*found, strict=True)))
        arrays = {"velocities": joined.nodal("velocities"), "von_mises": joined.von_mises(sim), "touched": touched}
        writer.write(joined.nodal("positions"), **arrays)
        done.frames = writer.frames
        done.elements.append(len(joined.tets))
        # In float64: before a state becomes infinite, squares overflow float32.
        lengths = np.linalg.norm(joined.nodal("displacements").astype(np.float64), axis=1)
        done.final_displacement = float(lengths.max())
        done.largest_displacement = max(done.largest_displacement, done.final_displacement)

    def write() -> None:
        sim.collect()
        if joined.has_changed():
            bound = skins.on(joined.meshes) if skins else ()
            writer.change_mesh(joined, fixed=joined.fixed, material=joined, skins=bound)
        shortest, longest = sim.dt_range
        steps = {"steps": sim.total_steps, "shortestStep": float(shortest), "longestStep": float(longest)}
        writer.about = told | steps
        write_state()
        if also:
            shown_mesh = frame_of(sim, joined)
            for other in others:
                other.write(sim.total_time - first_time, shown_mesh)

    with closed_whole(writer, done, others), progress_bar(count, wanted=progress is None) as bar:
        make_frames(sim, fps, count, done, write, progress or bar)
    return done


def make_frames(
    sim: Simulation, fps: float, count: int, done: Recording, write: Callable[[], None], progress: Progress
) -> None:
    """Advance a simulation from frame to frame, and write the present state and those of ``count`` more frames."""
    first_step, first_time = sim.total_steps, sim.total_time
    for frame in range(count + 1):
        with WATCH.part("stepping", into=done):
            sim.advance_until(first_time + frame / fps)
        with WATCH.part("writing", into=done), signals_held_back():
            write()
        done.steps = sim.total_steps - first_step
        done.simulated = sim.total_time - first_time
        progress(frame, count)


class _Unwritten:
    """In place of a writer, on ranks other than the first."""

    def __init__(self, path: Path):
        self.path, self.frames, self.about = path, 0, dict[str, Any]()

    def write(self, *_: Any, **__: Any) -> None:
        self.frames += 1

    def close(self, *_: Any, **__: Any) -> None:
        pass

    change_mesh = __exit__ = close


@contextmanager
def progress_bar(count: int, *, wanted: bool = True) -> Iterator[Progress]:
    """A bar on a terminal for long runs, to be called with numbers of frames."""
    with bar_of(count, "frames", wanted=wanted) as update, hidden():
        yield lambda frame, _: update(frame)


@contextmanager
def closed_whole(writer: ColoredStage, done: Recording, others: Sequence[ParaViewWriter] = ()) -> Iterator[None]:
    """Close the writers at the end in any case, with signals delayed and the time measured."""
    try:
        yield
    except BaseException as error:
        with signals_held_back():
            writer.__exit__(type(error), error, error.__traceback__)
            with suppress(OSError):  # the first error is the one to report
                for other in others:
                    other.close()
        raise
    with WATCH.part("writing", into=done), signals_held_back():
        writer.close()
        for other in others:
            other.close()


@contextmanager
def signals_held_back() -> Iterator[None]:
    """Deliver SIGINT and SIGTERM only at the end of the block (in the main thread; other threads get none)."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    held: list[int] = []
    before = {int(number): signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    ours = {number: handler for number, handler in before.items() if handler is not None}
    for number in ours:
        signal.signal(number, lambda n, _: held.append(n))
    try:
        yield
    finally:
        for number, handler in ours.items():
            signal.signal(number, handler)
        for number in held[:1]:
            signal.raise_signal(number)


# --- the description of a simulation in the custom data of its stage's layer -----------------------------------------

#: Key in the layer's custom data.
KEY = "warp_corot"


def provenance(sim: Simulation, held: npt.NDArray[np.bool_]) -> dict[str, Any]:
    """Program, models, integrator, units, device and held nodes.

    Args:
        sim: The simulation.
        held: Which nodes of the drawn body are held.
    """
    try:
        number = version("warp-corot")
    except PackageNotFoundError:
        number = "(not installed)"
    models = {}
    for k, model in enumerate(sim.models, start=1):
        options = ", ".join(f"{name}={value!r}" for name, value in vars(model).items() if value is not None)
        models[f"body{k}"] = f"{type(model).__name__}({options})"
    integrator = {name: value for name, value in asdict(sim.integrator).items() if value is not None}  # type: ignore
    return {
        "program": f"warp_corot {number}, warp {wp.__version__}",
        "units": "metres, kilograms, seconds, pascals",
        "device": f"{sim.device} ({sim.device.name})",
        "models": models,
        "integrator": {"name": type(sim.integrator).__name__, **integrator},
        "gravity": " ".join(f"{g:.9g}" for g in sim.gravity),
        "heldNodes": int(np.count_nonzero(held)),
    }
