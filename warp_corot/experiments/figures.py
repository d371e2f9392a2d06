"""Counterparts of the paper's figures 5 to 8, drawn with Matplotlib alone (an extra)."""

from __future__ import annotations

import os
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import InputError
from ..io.preview import Camera, draw_body
from ..mesh.surface import boundary_faces
from .paper import CELL_SIZE, CELLS, OWN, PEER, REFERENCE, Results, Run
from .report import PUBLISHED_COROTATED, PUBLISHED_LINEAR, VOLUME_KEPT, device_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FILES = {
    5: "figure5_computation_time.png",
    6: "figure6_deformed_shapes.png",
    7: "figure7_error_by_model.png",
    8: "figure8_error_by_rotation_level.png",
}

DPI = 200
_INK, _FAINT = "#2b2730", "#8a8590"
_ROTATION, _FORCE, _REST, _FUSED = "#d95f3b", "#3b7ea1", "#b9c3c9", "#8a6f8e"
_LINEAR, _OWN, _NEO = "#c8452f", "#1f6f8b", "#8a8590"
#: The time after which nothing moves any more and a long run's axis is compressed [s].
_SETTLED = 3.0


def check_matplotlib() -> None:
    """Says before a long run whether figures can be drawn.

    Raises:
        InputError: Matplotlib is not installed.
    """
    if find_spec("matplotlib") is None:
        raise InputError('the figures need Matplotlib: pip install "warp-corot[plot]"')


def draw_figures(folder: Path, results: Results) -> list[Path]:
    """Draws all figures into a folder that is there, each written aside and renamed.

    Returns:
        The files, in the order of the paper's figures.

    Raises:
        InputError: Matplotlib is not installed.
        OSError: A file could not be written; one that was there before stays.
    """
    check_matplotlib()
    paths = {number: folder / name for number, name in FILES.items()}
    draw_times(paths[5], results)
    draw_shapes(paths[6], results)
    draw_errors_by_model(paths[7], results)
    draw_errors_by_level(paths[8], results)
    return list(paths.values())


def draw_times(path: Path, results: Results) -> None:
    """Figure 5: what a time step costs, by model and by rotation level, stage by stage."""
    figure = _figure(8.0, 4.9)
    ax = figure.add_axes((0.085, 0.235, 0.895, 0.61))
    runs = [results.runs[name] for name in (PEER, REFERENCE, "neo-hookean")]
    own, shared = results.runs[OWN], results.levels
    places = np.concatenate([np.arange(3.0), 3.6 + np.arange(len(shared)), [4.2 + len(shared)]])
    names = ["linear", "StVK", "neo-\nHookean", *(str(run.case.rotation_level) for run in shared), "own"]
    cuda = results.device.is_cuda
    highest = 0.0
    for x, run in zip(places, [*runs, *shared, own], strict=True):
        assert run.times is not None
        scale = 1e6 if cuda else 1.0
        t = run.times.seconds if cuda else run.times.relative
        force_color = _FUSED if run.times.fused else _FORCE
        bottom = 0.0
        for part, color in ((t.rest, _REST), (t.force, force_color), (t.rotation, _ROTATION)):
            ax.bar(x, scale * part, 0.72, bottom=scale * bottom, color=color, edgecolor="white", linewidth=0.6)
            bottom += part
        ax.plot([x - 0.36, x + 0.36], [scale * t.step] * 2, color=_INK, linewidth=1.4, solid_capstyle="butt")
        top = scale * max(bottom, t.step)
        highest = max(highest, top)
        ax.annotate(
            f"{scale * t.step:.1f}", (x, top), (0, 3), textcoords="offset points", ha="center", fontsize=8.5, color=_INK
        )
    ax.set_xticks(places, names)
    ax.set_xlim(-0.65, places[-1] + 0.65)
    ax.set_ylim(0.0, 1.1 * highest)
    _tidy(ax)
    ax.tick_params(axis="x", length=0)
    ax.set_ylabel("time of a step [µs]" if cuda else "time of a step\n(linear's force + rest = 1)")
    middle = ax.get_xaxis_transform()
    ax.text(
        3.6 + (len(shared) - 1) / 2,
        -0.165,
        "corotated, rotations shared at tree level",
        fontsize=9.5,
        color=_INK,
        transform=middle,
        ha="center",
    )
    ax.text(places[-1], -0.165, "corotated", fontsize=9.5, color=_INK, transform=middle, ha="center")
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    marks: list[Patch | Line2D] = [
        Patch(color=_ROTATION, label="rotation"),
        Patch(color=_FORCE, label="force"),
        Patch(color=_FUSED, label="rotation and force in one kernel"),
        Patch(color=_REST, label="rest (integration)"),
        Line2D([], [], color=_INK, linewidth=1.4, label="whole step as run (number)"),
    ]
    figure.legend(
        handles=marks, loc="lower left", bbox_to_anchor=(0.075, 0.005), ncols=5, frameon=False, fontsize=8.5,
        handlelength=1.2, columnspacing=1.3,
    )  # fmt: skip
    _head(figure, "Computation time of a step by model and rotation level", results)
    save(figure, path)


def draw_shapes(path: Path, results: Results) -> None:
    """Figure 6: the shapes at the end, each before its rest shape, and their outlines on one another."""
    mesh = results.mesh
    faces, _ = boundary_faces(mesh.tets, mesh.points)
    named = [(PEER, "linear"), (REFERENCE, "St. Venant–Kirchhoff"), ("neo-hookean", "neo-Hookean")]
    named += [(OWN, "corotated, own rotations"), (f"{OWN}-0", "corotated, level 0")]
    shown = np.concatenate([mesh.points, *(results.runs[name].positions for name, _ in named)])
    camera = Camera.fit(shown, mesh.up_axis, azimuth=68.0, elevation=12.0)
    figure = _figure(9.6, 6.4)
    width, height = 1.0 / 3.0, 0.335
    corners = [(column * width, 0.46 - row * 0.445) for row in range(2) for column in range(3)]
    window, _ = camera.project(shown)
    low, high = window.min(axis=0), window.max(axis=0)
    pad = 0.07 * (high - low)
    for (left, bottom), (name, label) in zip(corners, named, strict=False):
        run = results.runs[name]
        ax = figure.add_axes((left, bottom, width, height))
        draw_body(ax, run.positions, faces, rest=mesh.points, camera=camera, edges=True, ground=False)
        ax.set_xlim(low[0] - pad[0], high[0] + pad[0])
        ax.set_ylim(low[1] - pad[1], high[1] + pad[1])
        growth = f"{100 * run.growth[-1]:+.1f} %".replace("-", "−")
        strong = abs(run.growth[-1]) > VOLUME_KEPT
        _caption(figure, left + width / 2, bottom + height + 0.036, label, f"volume {growth}", strong)
    left, bottom = corners[-1]
    _draw_outlines(figure.add_axes((left + 0.025, bottom, width - 0.05, height + 0.03)), results)
    _head(figure, "Deformed shapes at the end", results)
    save(figure, path)


def draw_errors_by_model(path: Path, results: Results) -> None:
    """Figure 7: how far the observed node is from where it is under StVK, over time."""
    lines = [
        (results.runs[PEER], "linear", _LINEAR, 1.8),
        (results.runs["neo-hookean"], "neo-Hookean", _NEO, 1.3),
        (results.runs[OWN], "corotated, own", _OWN, 1.8),
    ]
    marks = [(PUBLISHED_LINEAR, "published, linear: 22 mm"), (PUBLISHED_COROTATED, "published, corotated: 3.6 mm")]
    _draw_errors(path, results, lines, marks, "Displacement error of the free end against StVK, by model")


def draw_errors_by_level(path: Path, results: Results) -> None:
    """Figure 8: the same by the tree level whose rotations are shared."""
    import matplotlib

    shared = results.levels
    colors = matplotlib.colormaps["viridis"](np.linspace(0.05, 0.92, len(shared)))[::-1]
    lines = [(run, f"level {run.case.rotation_level}", color, 1.5) for run, color in zip(shared, colors, strict=True)]
    marks = [(PUBLISHED_COROTATED, "published bound: 3.6 mm")]
    _draw_errors(path, results, lines, marks, "Displacement error of the free end against StVK, by rotation level")


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG, aside and renamed."""
    part = path.with_name(f".{path.name}.part")
    try:
        figure.savefig(part, format="png", dpi=DPI)
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


# --- pieces --------------------------------------------------------------------------------------------------------


def _draw_errors(
    path: Path,
    results: Results,
    lines: Sequence[tuple[Run, str, Any, float]],
    marks: Sequence[tuple[float, str]],
    title: str,
) -> None:
    """Errors over time in mm: the swing on a wide panel, and whatever follows it compressed on a narrow one."""
    figure = _figure(8.0, 4.4)
    end = float(results.times[-1])
    long = end > 2.0 * _SETTLED
    panels = [figure.add_axes((0.08, 0.13, 0.57 if long else 0.71, 0.7))]
    limits = [(0.0, _SETTLED if long else end)]
    if long:
        panels.append(figure.add_axes((0.66, 0.13, 0.13, 0.7), sharey=panels[0]))
        limits.append((_SETTLED, end))
    time = np.concatenate([[0.0], results.times])
    errors = [np.concatenate([[0.0], 1e3 * results.error(run.case.name)]) for run, *_ in lines]
    top = 1.1 * max(max(e.max() for e in errors), max(1e3 * m for m, _ in marks))
    for ax, (low, high) in zip(panels, limits, strict=True):
        inside = (time >= low) & (time <= high)
        for value, _ in marks:
            ax.axhline(1e3 * value, color=_FAINT, linewidth=0.9, linestyle=(0, (4, 3)), zorder=1)
        for error, (_, _, color, width) in zip(errors, lines, strict=True):
            ax.plot(time[inside], error[inside], color=color, linewidth=width, solid_joinstyle="round")
        ax.set_xlim(low, high)
        ax.set_ylim(0.0, top)
        _tidy(ax)
    for value, text in marks:
        panels[0].annotate(
            text,
            (limits[0][1], 1e3 * value),
            (-4, 3),
            textcoords="offset points",
            ha="right",
            fontsize=8.5,
            color=_FAINT,
        )
    panels[0].set_ylabel("error [mm]")
    panels[0].set_xlabel("time [s]")
    if long:
        panels[1].tick_params(axis="y", left=False, labelleft=False)
        panels[1].set_xticks([20.0, 40.0, 60.0, 80.0] if round(end) == 80 else np.linspace(low, high, 3)[1:])
        panels[1].spines["left"].set_color("#d8d6dc")
    _label_ends(panels[-1], [e[-1] for e in errors], [(label, color) for _, label, color, _ in lines], top)
    _head(figure, title, results)
    save(figure, path)


def _draw_outlines(ax: Axes, results: Results) -> None:
    """The beams' sides at x = 0 seen along the x axis."""
    mesh = results.mesh
    lines = ((None, "rest", "#c9c7ce", 1.0), (PEER, "linear", _LINEAR, 1.8), (REFERENCE, "StVK", _INK, 1.8),
             (OWN, "corotated, own", _OWN, 1.8))  # fmt: skip
    length, side = CELLS[2] * CELL_SIZE, CELL_SIZE
    corners = np.array([[0.0, 0.0], [length, 0.0], [length, side], [0.0, side]])
    near = np.flatnonzero(np.abs(mesh.points[:, 0]) < 1e-9)
    y, z = mesh.points[near, 1], mesh.points[near, 2]
    outline = []
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        along, across = (
            (z - a[0]) * (b - a)[0] + (y - a[1]) * (b - a)[1],
            (z - a[0]) * (b - a)[1] - (y - a[1]) * (b - a)[0],
        )
        on = np.flatnonzero(np.abs(across) < 1e-9)
        outline.append(near[on[np.argsort(along[on])]])
    loop = np.concatenate(outline)
    for name, label, color, width in lines:
        x = 1e3 * (mesh.points if name is None else results.runs[name].positions)[loop]
        style = (0, (3, 1.5)) if name == OWN else "-"
        ax.plot(-x[:, 2], x[:, 1], color=color, linewidth=width, linestyle=style, label=label)
    ax.plot([0, 0], [-12, 76], color=_INK, linewidth=3, solid_capstyle="butt")
    ax.set_aspect("equal")
    ax.set_axis_off()
    ax.set_ylim(-108, 82)
    ax.legend(
        loc="lower center", bbox_to_anchor=(0.5, -0.03), ncols=4, frameon=False, fontsize=8, labelcolor=_INK,
        handlelength=1.5, columnspacing=1.0, handletextpad=0.5,
    )  # fmt: skip


def _label_ends(ax: Axes, values: list[float], labels: list[tuple[str, object]], top: float) -> None:
    """Names beside the ends of lines, pushed apart where they would overlap."""
    gap = 0.052 * top
    order = np.argsort(values)
    places = np.array(values, dtype=float)[order]
    for _ in range(200):
        for i in range(1, len(places)):
            lack = gap - (places[i] - places[i - 1])
            if lack > 0:
                places[i] += lack / 2
                places[i - 1] -= lack / 2
        places = np.maximum(places, 0.02 * top)
    # In shares of the axes' width, so that the gap looks alike on a wide and on a narrow panel.
    unit = 0.01 / ax.get_position().width
    across = ax.get_yaxis_transform()
    for place, index in zip(places, order, strict=True):
        label, color = labels[index]
        ends = [1.0 + 0.4 * unit, 1.0 + 2.6 * unit]
        ax.plot(ends, [values[index], place], transform=across, color=color, linewidth=1.2, clip_on=False)
        text = f"{label}  {values[index]:.1f}"
        ax.text(1.0 + 3.0 * unit, place, text, transform=across, fontsize=9, color=_INK, va="center")
    ax.text(1.0 + 3.0 * unit, 0.96 * top, "at the end [mm]", transform=across, fontsize=8.5, color=_FAINT, va="bottom")


def _caption(figure: Figure, x: float, y: float, label: str, note: str, strong: bool) -> None:
    figure.text(x, y, label, fontsize=10, color=_INK, ha="center", va="bottom")
    figure.text(x, y - 0.008, note, fontsize=9, color=_LINEAR if strong else _FAINT, ha="center", va="top")


def _figure(width: float, height: float) -> Figure:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), dpi=DPI, facecolor="white")


def _head(figure: Figure, title: str, results: Results) -> None:
    mesh = results.mesh
    figure.text(0.012, 0.97, title, fontsize=12.5, color=_INK, va="top", weight="bold")
    about = (
        f"beam 64 × 64 × 192 mm under its weight, {len(mesh.points)} nodes, {len(mesh.tets)} tetrahedra, "
        f"{results.times[-1]:.1f} s simulated · {device_name(results)}"
    )
    figure.text(0.012, 0.912, about, fontsize=8.5, color=_FAINT, va="top")


def _tidy(ax: Axes) -> None:
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        ax.spines[side].set_color(_FAINT)
        ax.spines[side].set_linewidth(0.8)
    ax.tick_params(colors=_INK, labelsize=9, width=0.8, length=3)
    ax.yaxis.label.set_color(_INK)
    ax.xaxis.label.set_color(_INK)
    ax.grid(axis="y", color="#e9e8ec", linewidth=0.7)
    ax.set_axisbelow(True)
