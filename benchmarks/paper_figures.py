"""Counterparts of the paper's figures 5 to 8, drawn with Matplotlib (an extra)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from paper_beam import CELL_SIZE, CELLS, OWN, PEER, REFERENCE, Results, Run
from paper_report import PUBLISHED_COROTATED, PUBLISHED_LINEAR, VOLUME_KEPT

from warp_corot.cli.verify import device_name
from warp_corot.errors import InputError
from warp_corot.io.files.whole import written_whole
from warp_corot.io.pictures.drawing import Camera, draw_body
from warp_corot.mesh.topology import boundary_faces

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FILES = {
    5: "figure5_computation_time.png",
    6: "figure6_deformed_shapes.png",
    7: "figure7_error_by_model.png",
    8: "figure8_error_by_rotation_level.png",
}

INK, FAINT = "#2b2730", "#8a8590"
LINEAR, OWN_COLOR, NEO = "#c8452f", "#1f6f8b", "#8a8590"
_ROTATION, _FORCE, _REST, _FUSED, _SHIPPED = "#d95f3b", "#3b7ea1", "#b9c3c9", "#8a6f8e", "#4c8c5f"
#: After this time nothing moves, and the axis of a long run is logarithmic [s].
_SETTLED = 3.0
STYLE = {
    **{f"axes.spines.{side}": False for side in ("top", "right")},
    **dict.fromkeys(("text.color", "axes.labelcolor", "xtick.labelcolor", "ytick.labelcolor"), INK),
    **{"axes.edgecolor": FAINT, "xtick.color": FAINT, "ytick.color": FAINT, "axes.axisbelow": True},
    **{"axes.grid": True, "axes.grid.axis": "y", "grid.color": "#e9e8ec", "grid.linewidth": 0.7},
    **{"font.size": 9.0, "legend.frameon": False, "legend.fontsize": 8.5},
}


def check_matplotlib() -> None:
    """Check, before a long run, that figures can be drawn.

    Raises:
        InputError: Matplotlib is not installed.
    """
    if find_spec("matplotlib") is None:
        raise InputError('the figures need Matplotlib: pip install "warp-corot[plot]"')


def draw_figures(folder: Path, results: Results) -> list[Path]:
    """Draw all figures into an existing folder; each is written to a temporary file and renamed.

    Returns:
        The files, in the order of the paper's figures.

    Raises:
        InputError: Matplotlib is not installed.
        OSError: A file could not be written; a former one stays.
    """
    check_matplotlib()
    paths = {number: folder / name for number, name in FILES.items()}
    draw_times(paths[5], results)
    draw_shapes(paths[6], results)
    draw_errors_by_model(paths[7], results)
    draw_errors_by_level(paths[8], results)
    return list(paths.values())


def draw_times(path: Path, results: Results) -> None:
    """Figure 5: the time of a step by model and by rotation level, stage by stage (leaf by leaf) and as shipped."""
    from matplotlib.patches import Patch

    shared, cuda = results.levels, results.device.is_cuda
    runs = [*(results.runs[name] for name in (PEER, REFERENCE, "neo-hookean")), *shared, results.runs[OWN]]
    names = ["linear", "StVK", "neo-\nHookean", *(f"level {run.case.rotation_level}" for run in shared), "own"]
    measured = [run.times for run in runs if run.times is not None]
    times = [each.seconds if cuda else each.relative for each in measured]
    stages = {
        name: (1e6 if cuda else 1.0) * np.array([getattr(each, name) for each in times])
        for name in ("rest", "force", "rotation", "step", "shipped")
    }
    place = np.arange(len(runs)) + 0.5 * (np.arange(len(runs)) > 2)
    force = [_FUSED if each.fused else _FORCE for each in measured]
    with _figure(path, "Computation time of a step by model and rotation level", results, (8.0, 4.9)) as figure:
        ax, left, bottom = figure.subplots(), place - 0.2 * (place > 2), np.zeros(len(runs))
        for name, color in (("rest", _REST), ("force", force), ("rotation", _ROTATION)):
            ax.bar(left, stages[name], 0.4, bottom=bottom, color=color, edgecolor="white", linewidth=0.6)
            bottom += stages[name]
        whole = ax.hlines(stages["step"], left - 0.2, left + 0.2, color=INK, linewidth=1.4)
        for x, y in zip(left, np.maximum(bottom, stages["step"]), strict=True):
            ax.annotate(f"{y:.1f}", (x, y), (0, 3), textcoords="offset points", ha="center", fontsize=8)
        shipped = ax.bar(place[3:] + 0.2, stages["shipped"][3:], 0.24, color=_SHIPPED)
        ax.bar_label(shipped, fmt="%.1f", padding=3, fontsize=8)
        ax.set_xticks(place, names)
        ax.tick_params(axis="x", length=0)
        ax.set_xlabel("three models, and the corotated one with rotations shared at a level of the tree, or its own")
        ax.set_ylabel("time of a step [µs]" if cuda else "time of a step\n(linear's force + rest = 1)")
        colors = {"rotation": _ROTATION, "force": _FORCE, "rotation and force in one kernel": _FUSED}
        colors |= {"rest (integration)": _REST, "whole step as shipped (by subtrees)": _SHIPPED}
        whole.set_label("whole step, leaf by leaf")
        marks = [*(Patch(color=color, label=label) for label, color in colors.items()), whole]
        figure.legend(handles=marks, loc="outside lower center", ncols=3, handlelength=1.2)


def draw_shapes(path: Path, results: Results) -> None:
    """Figure 6: the shapes at the end, each in front of its rest shape, and their outlines superimposed."""
    mesh = results.mesh
    faces, _ = boundary_faces(mesh.tets, mesh.points)
    named = {PEER: "linear", REFERENCE: "St. Venant–Kirchhoff", "neo-hookean": "neo-Hookean"}
    named |= {OWN: "corotated, own rotations", f"{OWN}-0": "corotated, level 0"}
    shown = np.concatenate([mesh.points, *(results.runs[name].positions for name in named)])
    camera = Camera.fit(shown, mesh.up_axis, azimuth=68.0, elevation=12.0)
    window, _ = camera.project(shown)
    room = 0.04 * np.ptp(window, axis=0)
    (left, bottom), (right, top) = window.min(axis=0) - room, window.max(axis=0) + room
    with _figure(path, "Deformed shapes at the end", results, (9.6, 6.4)) as figure:
        *panels, last = figure.subplots(2, 3).ravel()
        for ax, (name, label) in zip(panels, named.items(), strict=True):
            run = results.runs[name]
            draw_body(ax, run.positions, faces, rest=mesh.points, camera=camera, edges=True, ground=False)
            ax.set(xlim=(left, right), ylim=(bottom, top))
            growth = f"{100 * run.growth[-1]:+.1f} %".replace("-", "−")
            strong = abs(run.growth[-1]) > VOLUME_KEPT
            ax.set_title(f"{label}\nvolume {growth}", fontsize=10, color=LINEAR if strong else INK)
        _draw_outlines(last, results)


def draw_errors_by_model(path: Path, results: Results) -> None:
    """Figure 7: distance of the observed node from its place under StVK, over time."""
    lines = [
        (results.runs[PEER], "linear", LINEAR),
        (results.runs["neo-hookean"], "neo-Hookean", NEO),
        (results.runs[OWN], "corotated, own", OWN_COLOR),
    ]
    marks = [(PUBLISHED_LINEAR, "published, linear: 22 mm"), (PUBLISHED_COROTATED, "published, corotated: 3.6 mm")]
    _draw_errors(path, results, lines, marks, "Displacement error of the free end against StVK, by model")


def draw_errors_by_level(path: Path, results: Results) -> None:
    """Figure 8: the same distance by the tree level whose rotations are shared."""
    import matplotlib

    shared = results.levels
    colors = matplotlib.colormaps["viridis"](np.linspace(0.05, 0.92, len(shared)))[::-1]
    lines = [(run, f"level {run.case.rotation_level}", color) for run, color in zip(shared, colors, strict=True)]
    marks = [(PUBLISHED_COROTATED, "published bound: 3.6 mm")]
    _draw_errors(path, results, lines, marks, "Displacement error of the free end against StVK, by rotation level")


# --- pieces --------------------------------------------------------------------------------------------------------


def _draw_errors(
    path: Path,
    results: Results,
    lines: Sequence[tuple[Run, str, Any]],
    marks: Sequence[tuple[float, str]],
    title: str,
) -> None:
    """Errors over time in mm, with those at the end in the legend."""
    time = np.concatenate([[0.0], results.times])
    with _figure(path, title, results, (8.0, 4.4)) as figure:
        ax = figure.subplots()
        for run, label, color in lines:
            error = np.concatenate([[0.0], 1e3 * results.error(run.case.name)])
            ax.plot(time, error, color=color, linewidth=1.6, label=f"{label}  {error[-1]:.1f}")
        for value, text in marks:
            ax.axhline(1e3 * value, color=FAINT, linewidth=0.9, linestyle=(0, (4, 3)), zorder=1)
            ax.text(time[-1], 1e3 * value, f"{text} ", ha="right", va="bottom", color=FAINT)
        if time[-1] > 2.0 * _SETTLED:
            ax.set_xscale("symlog", linthresh=_SETTLED)
        ax.set(xlim=(0.0, time[-1]), xlabel="time [s]", ylabel="error [mm]")
        ax.set_ylim(bottom=0.0)
        figure.legend(loc="outside right center", title="at the end [mm]")


def _draw_outlines(ax: Axes, results: Results) -> None:
    """Draw the beams' sides at x = 0, seen along the x axis."""
    mesh, (_, depth, length) = results.mesh, np.array(CELLS) * CELL_SIZE
    x, y, z = mesh.points.T
    side = np.flatnonzero((np.abs(x) < 1e-9) & (np.minimum(y * (depth - y), z * (length - z)) < 1e-12))
    # Around the middle of the rectangle, by angle.
    loop = side[np.argsort(np.arctan2(y[side] - 0.5 * depth, z[side] - 0.5 * length))]
    loop = np.append(loop, loop[0])
    for name, label, color, style in (
        (None, "rest", "#c9c7ce", "-"),
        (PEER, "linear", LINEAR, "-"),
        (REFERENCE, "StVK", INK, "-"),
        (OWN, "corotated, own", OWN_COLOR, (0, (3, 1.5))),
    ):
        at = 1e3 * (mesh.points if name is None else results.runs[name].positions)[loop]
        ax.plot(-at[:, 2], at[:, 1], color=color, linewidth=1.6, linestyle=style, label=label)
    ax.set_aspect("equal")
    ax.set_axis_off()
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, 0.0), ncols=2)


@contextmanager
def _figure(path: Path, title: str, results: Results, size: tuple[float, float]) -> Iterator[Figure]:
    """A figure of this size in inches, without pyplot and its global state, with a title, the simulation and the
    device; at the end it is written as PNG to a temporary file that is renamed."""
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=size, dpi=200, facecolor="white", layout="constrained")
        about = (
            f"beam 64 × 64 × 192 mm under its weight, {len(results.mesh.points)} nodes, {len(results.mesh.tets)} "
            f"tetrahedra, {results.times[-1]:.1f} s simulated · {device_name(results.device)}"
        )
        figure.suptitle(f"$\\bf{{{title.replace(' ', '~')}}}$\n{about}", x=0.01, ha="left", fontsize=9.5)
        yield figure
        with written_whole(path) as part:
            figure.savefig(part, format="png")
