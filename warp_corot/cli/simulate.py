"""``warp-corot simulate``: a mesh in, an animation out, and a summary at the end."""

from __future__ import annotations

import argparse
import hashlib
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_corot.domain.units import length, pressure
from warp_corot.elasticity import MODELS
from warp_corot.elasticity.dilatation import ELEMENT, shares_dilatation
from warp_corot.errors import InputError, UnstableError
from warp_corot.holding.choice import NAMED
from warp_corot.inputs.processes import process_count
from warp_corot.inputs.stopwatch import KERNELS, WATCH
from warp_corot.io.files.whole import check_output
from warp_corot.mesh import TetForest
from warp_corot.simulation.energy import Solves
from warp_corot.simulation.simulation import Simulation
from warp_corot.solvers import INTEGRATORS

from . import terminal
from .options import is_static
from .results import Previews, check_preview, table_of
from .run_file import bodies_of, write_run
from .run_setup import rest, set_up
from .terminal import early_end

if TYPE_CHECKING:
    from warp_corot.discretization.elements import Mesh
    from warp_corot.io.write.animate import Progress, Recording
    from warp_corot.materials.isotropic import Isotropic

    from .bodies import RunBody
    from .input_mesh import InputMesh


def run(args: argparse.Namespace) -> int:
    """Run the command; returns the exit status.

    Raises:
        InputError: Bad options; nothing was simulated or written.
    """
    asked = Simulated(args)
    try:
        rested = asked.record()
    except (KeyboardInterrupt, UnstableError, OSError) as error:
        return early_end(error, asked.done)
    print(
        summary(
            asked.ready.bodies, asked.ready.sim, asked.done, asked.ready.touched.rows(len(asked.ready.bodies)), rested
        )
    )
    return 0


class Simulated:
    """A run that is ready, and what it writes.

    Args:
        args: The command's arguments.
        alone: Whether it is not one of many runs that are compared: those have the same kind of steps, and no pictures.

    Attributes:
        ready: The run.
        done: Its progress.

    Raises:
        InputError: Bad options; nothing was simulated or written.
    """

    def __init__(self, args: argparse.Namespace, *, alone: bool = True):
        from warp_corot.io.write.animate import Recording, frame_count
        from warp_corot.io.write.paraview import check_also
        from warp_corot.io.write.usd.pieces import PieceStore

        self._args, self._options = args, bodies_of(args)
        self._shared = shared = self._options[0]
        if shared.output is None:
            raise InputError("-o is missing; it must name the animation to write, for example -o out.usd")
        if shared.duration is not None:
            frame_count(shared.duration, shared.fps)
        PieceStore(shared.output)  # checks the path, and writes nothing before the first frame
        for other in shared.also or ():
            check_also(other)
        if shared.csv is not None:
            check_output(shared.csv, (".csv",))
        check_preview(shared)
        if args.write_run is not None:
            check_output(args.write_run, (".toml",))
            if args.write_run.exists() and Path(args.input).exists() and args.write_run.samefile(args.input):
                raise InputError(f"{args.write_run}: is the input; it must be another file")
        self.ready = ready = set_up(self._options, chooses=alone)
        self.done = Recording(shared.output)
        self._previews = Previews(shared, ready.count) if alone and shared.preview and ready.sim.is_root else None

    def record(self) -> list[str]:
        """Step the simulation, write its frames, and draw its pictures; returns lines on its states of rest.

        Raises:
            UnstableError, OSError: The errors that end the run.
        """
        from warp_corot.io.write.animate import progress_bar, record

        args, shared, bodies, sim = self._args, self._shared, self.ready.bodies, self.ready.sim
        if args.write_run is not None and sim.is_root:
            write_run(args.write_run, self._options)
        with WATCH.part("solving"):
            rested = rest(shared, sim)
        are_cut = sim.remeshing.are_cut
        surfaces = [None if body.args.draw_labels else body.subject.drawn(are_cut) for body in bodies]
        table: Any = nullcontext()
        if shared.csv:
            table = table_of(shared.csv, sim, self.ready.probes, self.ready.touched.obstacles)
        with progress_bar(self.ready.count) as progress, table as add_row:
            record(
                sim,
                shared.output,
                duration=self.ready.duration or None,
                fps=shared.fps,
                surface=surfaces if any(surface is not None for surface in surfaces) else None,
                tets=any(body.args.draw_tets for body in bodies) or None,
                labels=any(body.args.draw_labels for body in bodies),
                also=shared.also or (),
                progress=partial(self._written, progress, add_row),
                recording=self.done,
                about=about(args, bodies),
            )
        if self._previews is not None:
            with WATCH.part("drawing"):
                self._previews.draw(bodies, title_of(bodies))
        return rested

    def _written(self, progress: Progress, add_row: Callable[[], None] | None, frame: int, count: int) -> None:
        """Add a frame to the table and the pictures."""
        if add_row is not None:
            with WATCH.part("writing"):
                add_row()
        if self._previews is not None:
            with WATCH.part("drawing"):
                self._previews.add(frame, self.ready.bodies, self.ready.sim)
        progress(frame, count)


# --- the description of a run in its stage ---------------------------------------------------------------------------

#: Replacement for bytes that are not UTF-8, which USD's strings must be.
_ERRORS = "backslashreplace"


def about(args: argparse.Namespace, bodies: Sequence[RunBody]) -> dict[str, Any]:
    """The command, its run file if any, and for each body its input's name and hash, its supports and its loads; for
    the layer's custom data.

    Args:
        args: The command's arguments.
        bodies: The bodies that it simulates.
    """
    said: dict[str, Any] = {"command": _text(getattr(args, "command_line", "warp-corot simulate"))}
    if args.input.lower().endswith(".toml"):
        said |= {"runFile": _text(args.input), "run": _text(Path(args.input).read_text(encoding="utf-8"))}
    for number, body in enumerate(bodies, start=1):
        subject, own = body.subject, body.args
        said[f"body{number}"] = of_body = {"name": _text(subject.name), "input": _text(own.input)}
        of_body["held"] = body.held_words
        if subject.source is not None:
            of_body["inputSha256"] = _hash(subject.source)
        of_body |= {name: getattr(own, name) for name in ("scale", "unit") if getattr(own, name, None) is not None}
        if loads := "; ".join(map(str, body.loads)):
            of_body["loads"] = _text(loads)
    return said


def _hash(path: Path) -> str:
    """SHA-256 of a file; for a folder, of the names and contents of its files in order."""
    if not path.is_dir():
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    digest = hashlib.sha256()
    for inside in sorted(each for each in path.rglob("*") if each.is_file()):
        digest.update(str(inside.relative_to(path)).encode(errors=_ERRORS) + bytes.fromhex(_hash(inside)))
    return digest.hexdigest()


def _text(text: str) -> str:
    return text.encode("utf-8", errors=_ERRORS).decode("utf-8")


# --- the summary -----------------------------------------------------------------------------------------------------

#: Maximum number of regions whose materials are listed.
MOST_KINDS = 8


def summary(
    bodies: Sequence[RunBody],
    sim: Simulation,
    done: Recording,
    touched: Sequence[tuple[str, str]] = (),
    rested: Sequence[str] = (),
) -> str:
    """The run in a dozen lines.

    Args:
        bodies: The bodies.
        sim: The simulation at its end.
        done: The recording.
        touched: Lines on what the bodies touch.
        rested: Lines on the static answers of the bodies.
    """
    shared = bodies[0].args
    static = is_static(shared)
    integrator = asdict(sim.integrator)  # type: ignore[call-overload]
    damping = "" if static else f", damping {integrator['damping']:g} /s"
    if integrator["viscosity"]:
        damping += f", viscosity {integrator['viscosity']:g} s"
    height = max(body.subject.height for body in bodies)
    at_end = f"{length(done.final_displacement)} at the end ({done.final_displacement / height:.1%} of the height)"
    shown = "" if static else f", {done.simulated:.4g} s"
    lines, ranks, solves = [], process_count(), solved(sim, static)
    # States of rest have no steps in time.
    steps = [("solves", solves)] if solves else []
    if not static:
        shortest, longest = sim.dt_range
        if sim.integrator.is_implicit:
            name = next(name for name, kind in INTEGRATORS.items() if type(sim.integrator) is kind)
            step = f"{milliseconds(sim.dt)}, {name}"
        else:
            step = milliseconds(longest)
            if sim.integrator.dt is not None:
                step = f"{milliseconds(shortest)}, as given"
            elif shortest <= 0.99 * longest:
                step = f"{milliseconds(shortest)} to {step}, following the state"
            at_last = " (at the end)" if sim.remeshing.every else ""
            step += f"; largest stable one at rest about {milliseconds(sim.stable_dt)}{at_last}"
        steps = [("time step", step), *steps, ("speed", speed(done))]
    for body in bodies:
        lines += [f"{body.subject.name}, {body.held_words}", *aligned(_body_rows(body))]
    rows = [
        *remesh_rows(sim, done),
        *touched,
        ("gravity", f"{' '.join(f'{g:g}' for g in sim.gravity)} m/s^2{damping}"),
        *[("static", f"the first frame is {line}" if done.steps else line) for line in rested],
        *steps,
        ("wall time", wall_time()),
        ("displacement", f"{length(done.largest_displacement)} largest, {at_end}"),
        ("device", f"{sim.device} ({sim.device.name})" + (f", {ranks} ranks" if ranks > 1 else "")),
        ("written", f"{done.path}, {done.frames} frame{'s' * (done.frames > 1)}{shown}"),
    ]
    rows += [("also written", str(path)) for path in shared.also or ()]
    for name, path in (("preview", shared.preview), ("table", shared.csv)):
        if path:
            rows.append((name, str(path)))
    return "\n".join([*lines, *([] if len(bodies) == 1 else ["all together"]), *aligned(rows)])


def wall_time() -> str:
    """The wall time of the command so far, and its parts."""
    WATCH.switch("preparing")
    names = {KERNELS: "compiling kernels" if terminal.has_compiled else "loading kernels"}
    parts = [f"{spent:.2f} s {names.get(part, part)}" for part, spent in WATCH.parts.items() if spent >= 0.005]
    return f"{sum(WATCH.parts.values()):.2f} s: {', '.join(parts)}"


def names_of(bodies: Sequence[RunBody]) -> str:
    """The names of the first bodies, and the number of others."""
    left = len(bodies) - NAMED
    return ", ".join(body.subject.name for body in bodies[:NAMED]) + (f" and {left} more" if left > 0 else "")


def title_of(bodies: Sequence[RunBody]) -> str:
    """The title of a picture: the bodies, their elements and their stiffness."""
    words = [names_of(bodies)]
    if not any(body.remesh for body in bodies):
        words.append(f"{sum(len(body.soft.mesh.tets) for body in bodies):,} elements")
    young = np.unique(np.concatenate([np.ravel(body.soft.material.isotropic.young) for body in bodies]))
    words += [pressure(float(young[0]))] if len(young) == 1 else []
    return ", ".join([*words, *(["at rest"] if is_static(bodies[0].args) else [])])


def _body_rows(body: RunBody) -> list[tuple[str, str]]:
    model = next(name for name, kind in MODELS.items() if type(body.model) is kind)
    level = getattr(body.model, "rotation_level", None)
    words = [model] if level is None else [model, f"rotations of level {level}"]
    if shares_dilatation(getattr(body.model, "dilatation", ELEMENT), body.soft.discretization):
        words.append("shared dilatation")
    rows = [
        *_mesh_rows(body.subject),
        *_materials(body.subject, body.soft.mesh, body.soft.material),
        ("model", ", ".join(words)),
        ("fixed", f"{body.held.sum()} nodes, {body.held_words}" if body.held.any() else "nothing"),
    ]
    return rows + [("" if number else "moved", str(load)) for number, load in enumerate(body.loads)]


def aligned(rows: Sequence[tuple[str, str]]) -> list[str]:
    """Lines with a name and a text."""
    return [f"  {name:<14}{text}" for name, text in rows]


def _mesh_rows(subject: InputMesh) -> list[tuple[str, str]]:
    """For a body from a surface or a scan, the reports of its domain and its mesh, and their time."""
    if subject.domain is None:
        nodes, repaired = len(subject.mesh.points), getattr(subject.mesh, "repaired", 0)
        unused = nodes - len(subject.used)
        remarks = [f"{repaired} wound wrongly and repaired"] if repaired else []
        remarks += [f"{unused} nodes in no tetrahedron"] if unused else []
        said = f" ({', '.join(remarks)})" if remarks else ""
        return [("mesh", f"{nodes} nodes, {len(subject.mesh.tets)} tetrahedra{said}")]
    assert isinstance(subject.mesh, TetForest)
    assert subject.fidelity is not None
    assert subject.surface is not None
    took = ", ".join(f"{stage} {seconds:.2f} s" for stage, seconds in subject.times.items())
    return [
        *_block("domain", subject.domain.report()),
        *_block("mesh", subject.mesh.summary()),
        *_block("true to it", subject.fidelity.report()),
        ("surface", f"{len(subject.surface.points)} points, {len(subject.surface.triangles)} triangles"),
        ("ready in", f"{sum(subject.times.values()):.2f} s: {took}"),
    ]


def _block(name: str, lines: list[str]) -> list[tuple[str, str]]:
    return [(name if first else "", line) for first, line in zip([True] + len(lines) * [False], lines, strict=False)]


def _materials(subject: InputMesh, mesh: Mesh, material: Isotropic) -> list[tuple[str, str]]:
    values = [np.ravel(getattr(material, name)) for name in ("young", "poisson", "density")]
    if not subject.labels and all(len(value) == 1 for value in values):
        return [("material", values_line(*(value[0] for value in values)))]
    if not subject.labels:
        kinds, counts = np.unique(np.stack(np.broadcast_arrays(*values)), axis=1, return_counts=True)
        ordered = sorted(zip(counts.tolist(), kinds.T.tolist(), strict=True), reverse=True)
        return _block(
            "material", [f"{values_line(*kind)} in {count} tetrahedra" for count, kind in ordered[:MOST_KINDS]]
        )
    lines = []
    for label in subject.labels:
        of_label = np.flatnonzero(mesh.elements_of(label.name))
        if len(of_label):
            one = (getattr(material, name)[of_label[0]] for name in ("young", "poisson", "density"))
            lines.append(f"{label.name}: {values_line(*one)}")
        else:
            lines.append(f"{label.name}: in no tetrahedron")
    assert mesh.labels is not None
    others = ~np.isin(mesh.labels, [1 + mesh.label_names.index(label.name) for label in subject.labels])
    if others.any():
        first = np.flatnonzero(others)[0]
        one = (getattr(material, name)[first] for name in ("young", "poisson", "density"))
        lines.append(f"all others: {values_line(*one)}")
    return _block("material", lines)


def values_line(young: float, poisson: float, density: float) -> str:
    return f"E = {pressure(float(young))}, nu = {poisson:g}, rho = {density:g} kg/m^3"


def speed(done: Recording) -> str:
    """The speed of stepping, in words."""
    stepping = max(done.stepping, 1e-9)
    return f"{done.steps / stepping:.0f} steps/s, {done.simulated / stepping:.3g} times real time"


def milliseconds(seconds: float) -> str:
    return f"{1e3 * seconds:.4g} ms"


def remesh_rows(sim: Simulation, done: Recording) -> list[tuple[str, str]]:
    """The mesh's changes for the summary; empty without remeshing."""
    changing = sim.remeshing.changing[0]
    if changing is None or not done.elements:
        return []
    options, first, last = changing.options, done.elements[0], done.elements[-1]
    limits = f"above {options.refine_above:g}, below {options.simplify_below:g}"
    low = "that of the start" if options.min_level is None else options.min_level
    levels = f"levels {low} to {options.max_level}"
    counts = f"{first} tetrahedra in the first frame, {max(done.elements)} at most, {last} in the last"
    return [("remeshing", counts), ("", f"every {options.every} steps, {limits}, {levels}")]


# --- the cost of implicit steps --------------------------------------------------------------------------------------


def solved(sim: Simulation, static: bool) -> str | None:
    """The cost of implicit steps, or of the states of rest after the first, in words; None for explicit ones."""
    solves = sim.solves
    if solves is None or not solves.steps:
        return None
    words = f"{solves.iterations / solves.steps:.3g} iterations of Newton's method"
    words += f" and {solves.linear_iterations / solves.steps:.3g} linear ones a {'frame' if static else 'step'}"
    if static:
        return words + unfinished(solves, "later frames", "show more frames (--fps), which are nearer to one another")
    return words + unfinished(solves, "steps", "shorten the steps (--dt), or raise linear_iterations in Python")


def unfinished(solves: Solves, what: str, cure: str) -> str:
    """The number of unfinished solves, and what helps; empty if there are none."""
    if not solves.unfinished:
        return ""
    return f"; {solves.unfinished} of {solves.steps} {what} ended before their linear solve converged; {cure}"
