"""Pictures of deformed bodies as PNG files: one body, or several side by side."""

import io
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ..errors import InputError
from .colors import stress_colors
from .drawing import INK, Array, Camera, checked_surface, draw_body, value_limits
from .whole import written_whole

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["Camera", "Picture", "check_picture_path", "draw_body", "render_preview", "render_strip", "value_limits"]


@dataclass
class Picture:
    """One body in a strip: see `draw_body` for what the fields mean."""

    positions: ArrayLike
    faces: ArrayLike
    scalars: ArrayLike | None = None
    rest: ArrayLike | None = None
    title: str = ""
    options: dict[str, Any] = field(default_factory=dict)


def render_preview(
    path: str | Path,
    positions: ArrayLike,
    faces: ArrayLike,
    *,
    scalars: ArrayLike | None = None,
    scalar_label: str = "von Mises stress [Pa]",
    value_range: tuple[float, float] | None = None,
    rest: ArrayLike | None = None,
    up_axis: str = "Y",
    azimuth: float = 35.0,
    elevation: float = 14.0,
    title: str | None = None,
    size: tuple[int, int] = (1200, 900),
    **options: Any,
) -> None:
    """Renders one body to a PNG file of ``size`` pixels, with a colour bar where it has scalars; see `draw_body`.

    Raises:
        InputError: Not a .png path in a folder that is there, Matplotlib is not installed, or as `draw_body`.
        OSError: Could not be written; a picture that was there before stays.
    """
    picture = Picture(positions, faces, scalars, rest, title or "", options)
    render_strip(
        path,
        [picture],
        scalar_label=scalar_label,
        value_range=value_range,
        up_axis=up_axis,
        azimuth=azimuth,
        elevation=elevation,
        size=size,
    )


def render_strip(
    path: str | Path,
    pictures: Sequence[Picture],
    *,
    scalar_label: str = "von Mises stress [Pa]",
    value_range: tuple[float, float] | None = None,
    up_axis: str = "Y",
    azimuth: float = 35.0,
    elevation: float = 14.0,
    title: str | None = None,
    size: tuple[int, int] | None = None,
) -> None:
    """Renders several bodies, or one at several times, side by side: same view, same scale, same colours.

    Args:
        path: A .png file.
        pictures: From left to right; each may have its own title.
        scalar_label: What the colour bar says.
        value_range: Values at the ends of the colour map; None: 0 to the highest 99th percentile, rounded up.
        up_axis: "X", "Y" or "Z".
        azimuth: View round the up axis [°], see `Camera.fit`.
        elevation: View from above [°].
        title: Above all.
        size: Pixels; None: 600 a picture, as high as they need.

    Raises:
        InputError, OSError: as `render_preview`.
    """
    target = check_picture_path(path)
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise InputError('pictures need Matplotlib: pip install "warp-corot[plot]"') from None
    if not pictures:
        raise InputError("pictures is empty, should name at least one body")

    corners = [
        checked_surface(x, p.faces, "positions") for p in pictures for x in (p.positions, p.rest) if x is not None
    ]
    camera = Camera.fit(np.concatenate([x[tri].reshape(-1, 3) for x, tri in corners]), up_axis, azimuth, elevation)
    lowest_node = min(float((x[tri].reshape(-1, 3) @ camera.world_up).min()) for x, tri in corners)
    with_scalars = [p.scalars for p in pictures if p.scalars is not None]
    if with_scalars and value_range is None:
        value_range = (0.0, max(value_limits(scalars)[1] for scalars in with_scalars))

    # Pixels: the panels side by side below their titles, the colour bar at the right.
    width, height = size or (600 * len(pictures), 600)
    bar = 130 if with_scalars else 0
    head = 56 * (title is not None) + 40 * any(p.title for p in pictures)
    step = (width - bar) / len(pictures)
    figure = Figure(dpi=150, facecolor="white")
    all_axes = []
    for picture in pictures:
        ax = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        options = {"ground": lowest_node, **picture.options}
        draw_body(
            ax,
            picture.positions,
            picture.faces,
            scalars=picture.scalars,
            value_range=value_range,
            rest=picture.rest,
            camera=camera,
            **options,
        )
        if picture.title:
            ax.set_title(picture.title, fontsize=11, color=INK, pad=4)
        all_axes.append(ax)
    limits = np.array([[ax.get_xlim(), ax.get_ylim()] for ax in all_axes], dtype=np.float64)
    low, high = limits[..., 0].min(axis=0), limits[..., 1].max(axis=0)
    if size is None:
        height = int(step * np.clip((high[1] - low[1]) / (high[0] - low[0]), 0.3, 1.6)) + head
    figure.set_size_inches(width / 150.0, height / 150.0)
    _same_window(all_axes, low, high, step / (height - head))
    for index, ax in enumerate(all_axes):
        ax.set_position((index * step / width, 0.0, step / width, 1.0 - head / height))
    if with_scalars and value_range is not None:
        place = ((width - bar + 10) / width, 0.2, 16 / width, 0.55)
        _draw_color_bar(figure, place, value_range, scalar_label)
    if title:
        x_middle = (width - bar) / (2.0 * width)
        figure.text(x_middle, 1.0 - 14 / height, title, ha="center", va="top", fontsize=13, color=INK)
    _save(figure, target)


def check_picture_path(path: str | Path) -> Path:
    """Says before a long run whether a picture can be written there.

    Raises:
        InputError: Not a .png name, a folder in the way, or no folder to write to.
    """
    target = Path(path)
    if target.suffix.lower() != ".png":
        raise InputError(f"{target}: extension {target.suffix or '(none)'}, should be .png")
    if target.is_dir():
        raise InputError(f"{target}: is a folder, should be a file name")
    if not target.parent.is_dir():
        raise InputError(f"{target}: output folder {target.parent} is not there")
    if not os.access(target if target.exists() else target.parent, os.W_OK):
        raise InputError(f"{target}: cannot be written to")
    return target


def _same_window(all_axes: Sequence["Axes"], low: Array, high: Array, aspect: float) -> None:
    """One window for all, round ``low`` to ``high``, of the axes' aspect (width to height)."""
    center, half = (low + high) / 2.0, (high - low) / 2.0
    half_height = max(half[1], half[0] / aspect)
    for ax in all_axes:
        ax.set_xlim(center[0] - half_height * aspect, center[0] + half_height * aspect)
        ax.set_ylim(center[1] - half_height, center[1] + half_height)


def _draw_color_bar(
    figure: "Figure", place: tuple[float, float, float, float], limits: tuple[float, float], label: str
) -> None:
    ax = figure.add_axes(place)
    ax.imshow(stress_colors()[:, None, :], aspect="auto", origin="lower", extent=(0.0, 1.0, *limits))
    ax.set_xticks([])
    ax.yaxis.tick_right()
    ax.yaxis.set_label_position("right")
    ax.set_ylabel(label, fontsize=9, color=INK, labelpad=6)
    ax.yaxis.set_major_formatter(lambda value, _: f"{value:,.6g}".replace(",", " "))
    ax.tick_params(labelsize=8, colors=INK, length=2, width=0.6)
    for spine in ax.spines.values():
        spine.set_visible(False)


def _save(figure: "Figure", target: Path) -> None:
    """Writes aside and renames, so that a good picture is not lost to a failed one."""
    from PIL import Image

    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=2 * figure.dpi)  # twice as fine and averaged: smooth edges
    try:
        with Image.open(drawn) as fine, written_whole(target) as part:
            fine.convert("RGB").reduce(2).save(part, format="PNG")
    except OSError as error:
        raise OSError(f"{target}: cannot be written: {error.strerror or error}") from None
