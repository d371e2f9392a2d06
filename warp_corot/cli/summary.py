"""The summary at the end of a run."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING

import numpy as np

from warp_corot.domain.units import length
from warp_corot.elasticity import MODELS
from warp_corot.elasticity.dilatation import ELEMENT, shares_dilatation
from warp_corot.holding.choice import NAMED
from warp_corot.inputs.processes import process_count
from warp_corot.inputs.stopwatch import KERNELS, WATCH
from warp_corot.mesh import TetForest
from warp_corot.simulation.energy import Solves
from warp_corot.simulation.simulation import Simulation
from warp_corot.solvers import INTEGRATORS

from . import terminal
from .options import is_static

if TYPE_CHECKING:
    from collections.abc import Sequence

    from warp_corot.discretization.elements import Mesh
    from warp_corot.io.write.animate import Recording
    from warp_corot.materials.isotropic import Isotropic

    from .bodies import RunBody
    from .input_mesh import InputMesh

#: Maximum number of regions whose materials are listed.
MOST_KINDS = 8
#: What loads do to a body, for its title.
DONE = {"pull": "pulled", "twist": "twisted", "press": "pressed"}


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
    lines, ranks = [], process_count()
    for body in bodies:
        lines += [f"{body.subject.name}, {body.held.words}", *aligned(_of_body(body))]
    rows = [
        *remesh_rows(sim, done),
        *touched,
        ("gravity", f"{' '.join(f'{g:g}' for g in sim.gravity)} m/s^2{damping}"),
        *[("static", f"the first frame is {line}" if done.steps else line) for line in rested],
        *_time_step(sim, done, static),
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


def title_of(bodies: Sequence[RunBody], gravity: Sequence[float]) -> str:
    """The title of a picture: the bodies, and what happens to them under this gravity [m/s^2]."""
    words = [names_of(bodies)]
    if not any(body.remesh for body in bodies):
        words.append(f"{sum(len(body.soft.mesh.tets) for body in bodies):,} elements")
    young = np.unique(np.concatenate([np.ravel(body.soft.material.isotropic.young) for body in bodies]))
    words += [pressure(float(young[0]))] if len(young) == 1 else []
    return ", ".join([*words, *_happening(bodies, any(gravity))])


def _happening(bodies: Sequence[RunBody], heavy: bool) -> list[str]:
    """What happens to bodies, which may have weight, in words."""
    args = bodies[0].args
    kinds = {load.kind for body in bodies for load in body.loads}
    words = ["at rest"] if is_static(args) else []
    words += [word for kind, word in DONE.items() if kind in kinds]
    if args.tool:
        words.append("pressed by a tool" if len(args.tool) == 1 else f"pressed by {len(args.tool)} tools")
    if args.blade:
        words.append("cut by a blade" if len(args.blade) == 1 else f"cut by {len(args.blade)} blades")
    if args.drop is not None:
        words.append("dropped on a ground")
    elif args.ground is not None:
        words.append("on a ground")
    elif not any(body.held.count for body in bodies):
        words.append("falling freely" if heavy else "moving freely")
    elif not words:
        words.append(f"under {'its' if len(bodies) == 1 else 'their'} weight" if heavy else "held at the dots")
    return words


def _of_body(body: RunBody) -> list[tuple[str, str]]:
    model = next(name for name, kind in MODELS.items() if type(body.model) is kind)
    level = getattr(body.model, "rotation_level", None)
    words = [model] if level is None else [model, f"rotations of level {level}"]
    if shares_dilatation(getattr(body.model, "dilatation", ELEMENT), body.soft.discretization):
        words.append("shared dilatation")
    rows = [
        *_body(body.subject),
        *_materials(body.subject, body.soft.mesh, body.soft.material),
        ("model", ", ".join(words)),
        ("fixed", f"{body.held.count} nodes, {body.held.words}" if body.held.count else "nothing"),
    ]
    return rows + [("" if number else "moved", str(load)) for number, load in enumerate(body.loads)]


def aligned(rows: Sequence[tuple[str, str]]) -> list[str]:
    """Lines with a name and a text."""
    return [f"  {name:<14}{text}" for name, text in rows]


def _body(subject: InputMesh) -> list[tuple[str, str]]:
    """For a body from a surface or a scan, the reports of its domain and its mesh, and their time."""
    if subject.domain is None:
        nodes, repaired = len(subject.mesh.points), getattr(subject.mesh, "repaired", 0)
        unused = nodes - len(subject.used)
        remarks = [f"{repaired} wound wrongly and repaired"] if repaired else []
        remarks += [f"{unused} nodes in no tetrahedron"] if unused else []
        said = f" ({', '.join(remarks)})" if remarks else ""
        return [("mesh", f"{nodes} nodes, {len(subject.mesh.tets)} tetrahedra{said}")]
    assert isinstance(subject.mesh, TetForest)
    took = ", ".join(f"{stage} {seconds:.2f} s" for stage, seconds in subject.times.items())
    rows = [*_block("domain", subject.domain.report()), *_block("mesh", subject.mesh.summary())]
    if subject.fidelity is not None:
        rows += _block("true to it", subject.fidelity.report())
    if subject.surface is not None:
        rows.append(("surface", f"{len(subject.surface.points)} points, {len(subject.surface.triangles)} triangles"))
    return [*rows, ("ready in", f"{sum(subject.times.values()):.2f} s: {took}")]


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


def _time_step(sim: Simulation, done: Recording, static: bool) -> list[tuple[str, str]]:
    """The length of steps, their limit or the iterations that they needed, and the speed; states of rest have no
    steps in time."""
    found = solved(sim, static)
    rows = [("solves", found)] if found else []
    if static:
        return rows
    if sim.integrator.is_implicit:
        name = next(name for name, kind in INTEGRATORS.items() if type(sim.integrator) is kind)
        step = f"{milliseconds(sim.dt)}, {name}"
    else:
        at_last = " (at the end)" if sim.remeshing.every else ""
        step = f"{_steps(sim)}; largest stable one at rest about {milliseconds(sim.stable_dt)}{at_last}"
    return [("time step", step), *rows, ("speed", speed(done))]


def speed(done: Recording) -> str:
    """The speed of stepping, in words."""
    stepping = max(done.stepping, 1e-9)
    return f"{done.steps / stepping:.0f} steps/s, {done.simulated / stepping:.3g} times real time"


def _steps(sim: Simulation) -> str:
    shortest, longest = sim.dt_range
    if sim.integrator.dt is not None:
        return f"{milliseconds(shortest)}, as given"
    if shortest > 0.99 * longest:
        return milliseconds(longest)
    return f"{milliseconds(shortest)} to {milliseconds(longest)}, following the state"


def milliseconds(seconds: float) -> str:
    return f"{1e3 * seconds:.4g} ms"


def pressure(pascals: float) -> str:
    """A pressure in Pa, kPa, MPa or GPa."""
    for unit, factor in (("GPa", 1e9), ("MPa", 1e6), ("kPa", 1e3)):
        if pascals >= factor:
            return f"{pascals / factor:g} {unit}"
    return f"{pascals:g} Pa"


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
