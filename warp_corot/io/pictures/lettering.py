"""Text in pictures: the colour bar with its numbers, and titles that fit."""

import re
from typing import TYPE_CHECKING, Any

from .colors import stress_colors
from .drawing import INK

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Pixels an inch, on which sizes of type depend; and the width of the colour bar in pixels.
DPI, BAR = 150.0, 16


def draw_color_bar(figure: "Figure", limits: tuple[float, float], label: str) -> "Axes":
    label, limits = _readable(label, limits)
    ax = figure.add_axes((0.0, 0.2, BAR / (figure.get_figwidth() * DPI), 0.55))
    ax.imshow(stress_colors()[:, None, :], aspect="auto", origin="lower", extent=(0.0, 1.0, *limits))
    ax.set_xticks([])
    ax.yaxis.tick_right()
    ax.yaxis.set_label_position("right")
    ax.set_ylabel(label, fontsize=9, color=INK, labelpad=6)
    ax.yaxis.set_major_formatter(lambda value, _: f"{value:,.6g}".replace(",", " "))
    ax.tick_params(labelsize=8, colors=INK, length=2, width=0.6)
    for spine in ax.spines.values():
        spine.set_visible(False)
    return ax


def _readable(label: str, limits: tuple[float, float]) -> tuple[str, tuple[float, float]]:
    """A label and limits in kPa, MPa or GPa in place of so many Pa."""
    largest = max(map(abs, limits))
    for unit, size in (("GPa", 1e9), ("MPa", 1e6), ("kPa", 1e3)):
        if label.endswith("[Pa]") and largest >= size:
            return f"{label[:-4]}[{unit}]", (limits[0] / size, limits[1] / size)
    return label, limits


def needed_width(legend: "Axes", width: int) -> float:
    """Pixels that the colour bar and its text need; text that is too high is made smaller."""
    renderer = legend.figure.canvas.get_renderer()  # type: ignore[attr-defined]
    height, pixel = legend.figure.bbox.height, legend.figure.dpi / DPI
    label = legend.yaxis.label
    for points in (8.0, 7.0, 6.0, 5.0):
        if label.get_window_extent(renderer).height <= 0.95 * height:
            break
        label.set_fontsize(points)
    box = legend.get_tightbbox(renderer)
    needed = 0.0 if box is None else (box.x1 - legend.get_window_extent(renderer).x0) / pixel + 22.0
    return min(max(needed, 130.0), 0.7 * width)


def fit_line(text: Any, width: float) -> None:
    """Make a line smaller, and if necessary shorter, until it is no wider than a number of pixels.

    A short text after its last semicolon is kept.
    """
    renderer = text.figure.canvas.get_renderer()

    def is_wide() -> bool:
        return text.get_window_extent(renderer).width > width * text.figure.dpi / DPI

    while is_wide() and text.get_fontsize() > 7.0:
        text.set_fontsize(text.get_fontsize() - 0.5)
    end = "".join(re.findall(r"; [^;]{1,12}$", text.get_text()))
    words = text.get_text().removesuffix(end)
    while is_wide() and len(words) > 8:
        words = words[:-2]
        text.set_text(f"{words.rstrip()} …{end}")
