"""What ``warp-corot simulate`` says at the end."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING

import numpy as np

from ..elasticity import MODELS
from ..mesh import TetForest
from .remesh import remesh_rows

if TYPE_CHECKING:
    from pathlib import Path

    from ..elements import Mesh
    from ..io.animate import Recording
    from ..materials import Isotropic
    from ..simulation import Simulation
    from .subject import Subject


def summary(subject: Subject, sim: Simulation, done: Recording, fixed: str, preview: Path | None = None) -> str:
    """The run in a dozen lines.

    Args:
        subject: What was simulated.
        sim: The simulation at its end.
        done: What was recorded.
        fixed: The fixed nodes, in words.
        preview: The picture that was drawn.
    """
    model = next(name for name, kind in MODELS.items() if type(sim.models[0]) is kind)
    level = getattr(sim.models[0], "rotation_level", None)
    material = sim.body.material
    damping = asdict(sim.integrator)["damping"]  # type: ignore[call-overload]
    stepping = max(done.stepping, 1e-9)
    at_end = (
        f"{length(done.final_displacement)} at the end ({done.final_displacement / subject.height:.1%} of the height)"
    )
    at_last = " (at the end)" if sim.remeshing.every else ""
    rows = [
        *_body(subject),
        *remesh_rows(sim, done),
        *_materials(subject, sim.body.mesh, material),
        ("model", model if level is None else f"{model}, rotations of level {level}"),
        ("fixed", fixed),
        ("gravity", f"{' '.join(f'{g:g}' for g in sim.gravity)} m/s^2, damping {damping:g} /s"),
        ("time step", f"{_steps(sim)}; largest stable one at rest about {milliseconds(sim.stable_dt)}{at_last}"),
        ("speed", f"{done.steps / stepping:.0f} steps/s, {done.simulated / stepping:.3g} times real time"),
        ("wall time", f"{done.stepping:.2f} s stepping, {done.writing:.2f} s writing"),
        ("displacement", f"{length(done.largest_displacement)} largest, {at_end}"),
        ("device", f"{sim.device} ({sim.device.name})"),
        ("written", f"{done.path}, {done.frames} frames, {done.simulated:.4g} s"),
    ]
    if preview:
        rows.append(("preview", str(preview)))
    return "\n".join([subject.name, *(f"  {name:<14}{text}" for name, text in rows)])


def _body(subject: Subject) -> list[tuple[str, str]]:
    """Of a body from a surface or a scan, all that its domain and its mesh have to say, and the time that it took."""
    if subject.domain is None:
        return [("mesh", _mesh(subject))]
    assert isinstance(subject.mesh, TetForest)
    took = ", ".join(f"{stage} {seconds:.2f} s" for stage, seconds in subject.times.items())
    rows = [*_block("domain", subject.domain.report()), *_block("mesh", subject.mesh.summary())]
    if subject.surface is not None:
        rows.append(("surface", f"{len(subject.surface.points)} points, {len(subject.surface.triangles)} triangles"))
    return [*rows, ("ready in", f"{sum(subject.times.values()):.2f} s: {took}")]


def _block(name: str, lines: list[str]) -> list[tuple[str, str]]:
    return [(name if first else "", line) for first, line in zip([True] + len(lines) * [False], lines, strict=False)]


def _materials(subject: Subject, mesh: Mesh, material: Isotropic) -> list[tuple[str, str]]:
    if not subject.labels:
        return [("material", _values(material.young, material.poisson, material.density))]
    assert isinstance(mesh, TetForest)
    lines = []
    for label in subject.labels:
        of_label = np.flatnonzero(mesh.elements_of(label.name))
        if len(of_label):
            one = (getattr(material, name)[of_label[0]] for name in ("young", "poisson", "density"))
            lines.append(f"{label.name}: {_values(*one)}")
        else:
            lines.append(f"{label.name}: in no tetrahedron")
    return _block("material", lines)


def _values(young: float, poisson: float, density: float) -> str:
    return f"E = {pressure(float(young))}, nu = {poisson:g}, rho = {density:g} kg/m^3"


def _steps(sim: Simulation) -> str:
    shortest, longest = sim.dt_range
    if sim.integrator.dt is not None:
        return f"{milliseconds(shortest)}, as given"
    if shortest > 0.99 * longest:
        return milliseconds(longest)
    return f"{milliseconds(shortest)} to {milliseconds(longest)}, following the state"


def milliseconds(seconds: float) -> str:
    return f"{1e3 * seconds:.4g} ms"


def length(metres: float) -> str:
    """A length to three digits, in mm or m."""
    return f"{metres:.3g} m" if metres >= 1.0 else f"{1e3 * metres:.3g} mm"


def pressure(pascals: float) -> str:
    """A pressure in Pa, kPa, MPa or GPa."""
    for unit, factor in (("GPa", 1e9), ("MPa", 1e6), ("kPa", 1e3)):
        if pascals >= factor:
            return f"{pascals / factor:g} {unit}"
    return f"{pascals:g} Pa"


def _mesh(subject: Subject) -> str:
    nodes, repaired = len(subject.mesh.points), getattr(subject.mesh, "repaired", 0)
    unused = nodes - len(subject.used)
    remarks = [f"{repaired} wound wrongly and repaired"] if repaired else []
    remarks += [f"{unused} nodes in no tetrahedron"] if unused else []
    return f"{nodes} nodes, {len(subject.mesh.tets)} tetrahedra" + (f" ({', '.join(remarks)})" if remarks else "")
