"""The common style of the figures: colours, headings, axes, and output."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from warp_corot.io.files.whole import written_whole

from .paper import Results
from .report import device_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI = 200
INK, FAINT = "#2b2730", "#8a8590"
LINEAR, OWN_COLOR, NEO = "#c8452f", "#1f6f8b", "#8a8590"


def new_figure(width: float, height: float) -> Figure:
    """An empty figure with this size in inches, without pyplot and its global state."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), dpi=DPI, facecolor="white")


def head(figure: Figure, title: str, results: Results) -> None:
    """Write the title, and below it the simulation and the device."""
    mesh = results.mesh
    figure.text(0.012, 0.97, title, fontsize=12.5, color=INK, va="top", weight="bold")
    about = (
        f"beam 64 × 64 × 192 mm under its weight, {len(mesh.points)} nodes, {len(mesh.tets)} tetrahedra, "
        f"{results.times[-1]:.1f} s simulated · {device_name(results.device)}"
    )
    figure.text(0.012, 0.912, about, fontsize=8.5, color=FAINT, va="top")


def tidy(ax: Axes) -> None:
    """Draw two thin axes and faint grid lines."""
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        ax.spines[side].set_color(FAINT)
        ax.spines[side].set_linewidth(0.8)
    ax.tick_params(colors=INK, labelsize=9, width=0.8, length=3)
    ax.yaxis.label.set_color(INK)
    ax.xaxis.label.set_color(INK)
    ax.grid(axis="y", color="#e9e8ec", linewidth=0.7)
    ax.set_axisbelow(True)


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG to a temporary file and rename it."""
    with written_whole(path) as part:
        figure.savefig(part, format="png", dpi=DPI)
