"""Counterparts of the paper's figures 5 to 8, drawn with Matplotlib (an extra)."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_corot.errors import InputError

from .claims import PUBLISHED_COROTATED, PUBLISHED_LINEAR
from .paper import OWN, PEER, REFERENCE, Results, Run
from .shapes import draw_shapes
from .style import FAINT, INK, LINEAR, NEO, OWN_COLOR, head, new_figure, save, tidy

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FILES = {
    5: "figure5_computation_time.png",
    6: "figure6_deformed_shapes.png",
    7: "figure7_error_by_model.png",
    8: "figure8_error_by_rotation_level.png",
}

_ROTATION, _FORCE, _REST, _FUSED, _SHIPPED = "#d95f3b", "#3b7ea1", "#b9c3c9", "#8a6f8e", "#4c8c5f"
#: After this time nothing moves, and the axis of a long run is compressed [s].
_SETTLED = 3.0


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
    figure = new_figure(8.0, 4.9)
    ax = figure.add_axes((0.085, 0.255, 0.895, 0.59))
    runs = [results.runs[name] for name in (PEER, REFERENCE, "neo-hookean")]
    own, shared = results.runs[OWN], results.levels
    places = np.concatenate([np.arange(3.0), 3.6 + np.arange(len(shared)), [4.2 + len(shared)]])
    names = ["linear", "StVK", "neo-\nHookean", *(str(run.case.rotation_level) for run in shared), "own"]
    cuda = results.device.is_cuda
    highest, half = 0.0, 0.2

    def number(x: float, top: float, seconds: float) -> None:
        ax.annotate(f"{seconds:.1f}", (x, top), (0, 3), textcoords="offset points", ha="center", fontsize=8, color=INK)

    for place, run in zip(places, [*runs, *shared, own], strict=True):
        assert run.times is not None
        scale = 1e6 if cuda else 1.0
        t = run.times.seconds if cuda else run.times.relative
        force_color = _FUSED if run.times.fused else _FORCE
        corotated = run.case.name.startswith(OWN)
        x = place - 0.2 if corotated else place
        bottom = 0.0
        for part, color in ((t.rest, _REST), (t.force, force_color), (t.rotation, _ROTATION)):
            ax.bar(x, scale * part, 2 * half, bottom=scale * bottom, color=color, edgecolor="white", linewidth=0.6)
            bottom += part
        ax.plot([x - half, x + half], [scale * t.step] * 2, color=INK, linewidth=1.4, solid_capstyle="butt")
        top = scale * max(bottom, t.step)
        highest = max(highest, top, scale * t.shipped)
        number(x, top, scale * t.step)
        if corotated:
            ax.bar(place + 0.2, scale * t.shipped, 0.24, color=_SHIPPED)
            number(place + 0.2, scale * t.shipped, scale * t.shipped)
    ax.set_xticks(places, names)
    ax.set_xlim(-0.65, places[-1] + 0.65)
    ax.set_ylim(0.0, 1.1 * highest)
    tidy(ax)
    ax.tick_params(axis="x", length=0)
    ax.set_ylabel("time of a step [µs]" if cuda else "time of a step\n(linear's force + rest = 1)")
    middle = ax.get_xaxis_transform()
    ax.text(
        3.6 + (len(shared) - 1) / 2,
        -0.165,
        "corotated, rotations shared at tree level",
        fontsize=9.5,
        color=INK,
        transform=middle,
        ha="center",
    )
    ax.text(places[-1], -0.165, "corotated", fontsize=9.5, color=INK, transform=middle, ha="center")
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    marks: list[Patch | Line2D] = [
        Patch(color=_ROTATION, label="rotation"),
        Patch(color=_FORCE, label="force"),
        Patch(color=_FUSED, label="rotation and force in one kernel"),
        Patch(color=_REST, label="rest (integration)"),
        Line2D([], [], color=INK, linewidth=1.4, label="whole step, leaf by leaf"),
        Patch(color=_SHIPPED, label="whole step as shipped (by subtrees)"),
    ]
    figure.legend(
        handles=marks, loc="lower left", bbox_to_anchor=(0.075, 0.0), ncols=3, frameon=False, fontsize=8.5,
        handlelength=1.2, columnspacing=1.3,
    )  # fmt: skip
    head(figure, "Computation time of a step by model and rotation level", results)
    save(figure, path)


def draw_errors_by_model(path: Path, results: Results) -> None:
    """Figure 7: distance of the observed node from its place under StVK, over time."""
    lines = [
        (results.runs[PEER], "linear", LINEAR, 1.8),
        (results.runs["neo-hookean"], "neo-Hookean", NEO, 1.3),
        (results.runs[OWN], "corotated, own", OWN_COLOR, 1.8),
    ]
    marks = [(PUBLISHED_LINEAR, "published, linear: 22 mm"), (PUBLISHED_COROTATED, "published, corotated: 3.6 mm")]
    _draw_errors(path, results, lines, marks, "Displacement error of the free end against StVK, by model")


def draw_errors_by_level(path: Path, results: Results) -> None:
    """Figure 8: the same distance by the tree level whose rotations are shared."""
    import matplotlib

    shared = results.levels
    colors = matplotlib.colormaps["viridis"](np.linspace(0.05, 0.92, len(shared)))[::-1]
    lines = [(run, f"level {run.case.rotation_level}", color, 1.5) for run, color in zip(shared, colors, strict=True)]
    marks = [(PUBLISHED_COROTATED, "published bound: 3.6 mm")]
    _draw_errors(path, results, lines, marks, "Displacement error of the free end against StVK, by rotation level")


# --- pieces --------------------------------------------------------------------------------------------------------


def _draw_errors(
    path: Path,
    results: Results,
    lines: Sequence[tuple[Run, str, Any, float]],
    marks: Sequence[tuple[float, str]],
    title: str,
) -> None:
    """Errors over time in mm: the swing on a wide panel, and the rest compressed on a narrow one."""
    figure = new_figure(8.0, 4.4)
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
            ax.axhline(1e3 * value, color=FAINT, linewidth=0.9, linestyle=(0, (4, 3)), zorder=1)
        for error, (_, _, color, width) in zip(errors, lines, strict=True):
            ax.plot(time[inside], error[inside], color=color, linewidth=width, solid_joinstyle="round")
        ax.set_xlim(low, high)
        ax.set_ylim(0.0, top)
        tidy(ax)
    for value, text in marks:
        panels[0].annotate(
            text,
            (limits[0][1], 1e3 * value),
            (-4, 3),
            textcoords="offset points",
            ha="right",
            fontsize=8.5,
            color=FAINT,
        )
    panels[0].set_ylabel("error [mm]")
    panels[0].set_xlabel("time [s]")
    if long:
        panels[1].tick_params(axis="y", left=False, labelleft=False)
        panels[1].set_xticks([20.0, 40.0, 60.0, 80.0] if round(end) == 80 else np.linspace(low, high, 3)[1:])
        panels[1].spines["left"].set_color("#d8d6dc")
    _label_ends(panels[-1], [e[-1] for e in errors], [(label, color) for _, label, color, _ in lines], top)
    head(figure, title, results)
    save(figure, path)


def _label_ends(ax: Axes, values: list[float], labels: list[tuple[str, object]], top: float) -> None:
    """Write names beside the ends of lines, moved apart if they would overlap."""
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
    # The gap is a length on paper, not a fraction of the axes, so that it looks the same on wide and narrow panels.
    unit = 0.01 / ax.get_position().width
    across = ax.get_yaxis_transform()
    for place, index in zip(places, order, strict=True):
        label, color = labels[index]
        ends = [1.0 + 0.4 * unit, 1.0 + 2.6 * unit]
        ax.plot(ends, [values[index], place], transform=across, color=color, linewidth=1.2, clip_on=False)
        text = f"{label}  {values[index]:.1f}"
        ax.text(1.0 + 3.0 * unit, place, text, transform=across, fontsize=9, color=INK, va="center")
    ax.text(1.0 + 3.0 * unit, 0.96 * top, "at the end [mm]", transform=across, fontsize=8.5, color=FAINT, va="bottom")
