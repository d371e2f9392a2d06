"""Pictures of deformed bodies as PNG files: one body, or several side by side."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from warp_corot.errors import InputError
from warp_corot.io.files.whole import written_whole

from .colors import stress_colors
from .drawing import INK, Array, Camera, checked_surface, draw_body, draw_silhouette, dropped_shadow, value_limits

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from PIL.Image import Image

# --- text: the colour bar with its numbers, and titles that fit ------------------------------------------------------

#: Pixels an inch, on which sizes of type depend; and the width of the colour bar in pixels.
DPI, BAR = 150.0, 16


def draw_color_bar(figure: Figure, limits: tuple[float, float], label: str) -> Axes:
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


def needed_width(legend: Axes, width: int) -> float:
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


# --- pictures --------------------------------------------------------------------------------------------------------

__all__ = ["Camera", "Picture", "draw_body", "value_limits"]

#: Margin around what is drawn, over its size.
ROOM = 0.06


@dataclass
class Picture:
    """One body in a strip: `draw_body` explains the fields; ``view`` is azimuth and elevation [°]."""

    positions: ArrayLike
    faces: ArrayLike
    scalars: ArrayLike | None = None
    rest: ArrayLike | None = None
    title: str = ""
    options: dict[str, Any] = field(default_factory=dict)
    view: tuple[float, float] = (35.0, 14.0)


class Strip:
    """Pictures side by side with one scale and one colour bar, drawn again for each frame of a film.

    Args:
        pictures: Those of the first frame, from left to right, and row after row.
        seen: The points of all frames that lie farthest out [m], [n, 3].
        up_axis: "X", "Y" or "Z".
        titled: Whether frames have a title.
        scalar_label: Label of the colour bar.
        value_range: Values at the ends of the colour map; None: no colour bar.
        size: Pixels; None: 600 a picture, with the height that they need.
        fineness: Factor on the pixels drawn along each side, which are then averaged.
        columns: Pictures in a row; None: all.

    Raises:
        InputError: Matplotlib is not installed.
    """

    def __init__(
        self,
        pictures: Sequence[Picture],
        seen: Array,
        up_axis: str = "Y",
        *,
        titled: bool = False,
        scalar_label: str = "von Mises stress [Pa]",
        value_range: tuple[float, float] | None = None,
        size: tuple[int, int] | None = None,
        fineness: int = 2,
        columns: int | None = None,
    ):
        try:
            from matplotlib.backends.backend_agg import FigureCanvasAgg
            from matplotlib.figure import Figure
        except ImportError:
            raise InputError('pictures need Matplotlib: pip install "warp-corot[plot]"') from None
        self._cameras = [Camera.fit(seen, up_axis, *each.view) for each in pictures]
        squares = [each.options["square"] for each in pictures if "square" in each.options]
        self._ground = float((np.concatenate([seen, *squares]) @ self._cameras[0].world_up).min())
        low, high = self._window(np.concatenate([seen, *squares]), seen)
        columns = columns or len(pictures)
        rows = -(-len(pictures) // columns)
        head, own_head = 56 * titled, 40 * any(each.title for each in pictures)
        width, height = size or (600 * columns, 600 * rows)
        self._figure = Figure((width / DPI, height / DPI), dpi=fineness * DPI, facecolor="white")
        self._canvas = FigureCanvasAgg(self._figure)
        self._limits, self._fineness, bar = value_range, fineness, 0.0
        if value_range is not None:
            legend = draw_color_bar(self._figure, value_range, scalar_label)
            bar = needed_width(legend, width)
            legend.set_position(((width - bar + 10) / width, 0.2, BAR / width, 0.55))
        self._width, self._step = width - bar, (width - bar) / columns
        if size is None:
            height = rows * (int(self._step * np.clip((high - low)[1] / (high - low)[0], 0.3, 1.6)) + own_head) + head
            self._figure.set_size_inches(width / DPI, height / DPI)
        row = (height - head) / rows
        tall = row - own_head
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        half = max(half[1], half[0] * tall / self._step) * np.array([self._step / tall, 1.0])
        self._panels = []
        for index in range(len(pictures)):
            place = (index % columns * self._step / width, (rows - 1 - index // columns) * row / height)
            ax = self._figure.add_axes((*place, self._step / width, tall / height))
            (left, bottom), (right, top) = middle - half, middle + half
            ax.set(xlim=(left, right), ylim=(bottom, top))
            self._panels.append(ax)
        self._title = self._figure.text(0.5 * self._width / width, 1.0 - 14 / height, "", ha="center", va="top")
        self._rest: list[ArrayLike] = []
        self._rest_pixels: Any = None

    def draw(self, pictures: Sequence[Picture], title: str = "") -> Image:
        """Draw a frame: as many pictures as the first one has, and its title.

        Raises:
            InputError: Positions or faces as in `draw_body`.
        """
        from PIL import Image

        from .artists import Pixels

        self._draw_rest(pictures)
        for ax, picture, camera in self._cleared(pictures):
            ax.add_artist(Pixels(self._rest_pixels, order=2))
            draw_body(
                ax,
                picture.positions,
                picture.faces,
                scalars=picture.scalars,
                value_range=self._limits,
                camera=camera,
                **{"ground": self._ground, **picture.options},
            )
            if picture.title:
                fit_line(ax.set_title(picture.title, fontsize=11, color=INK, pad=4), self._step - 16)
        if title:
            self._title.set(text=title, fontsize=13, color=INK)
            fit_line(self._title, self._width - 16)
        self._canvas.draw()
        return Image.fromarray(np.asarray(self._canvas.buffer_rgba())[..., :3]).reduce(self._fineness)

    def _draw_rest(self, pictures: Sequence[Picture]) -> None:
        """Draw the rest shapes to pixels, which frames show until the shapes change."""
        shapes = [each for p in pictures if p.rest is not None for each in (p.rest, p.faces)]
        unchanged = len(shapes) == len(self._rest) and all(map(np.array_equal, shapes, self._rest))
        if self._rest_pixels is not None and unchanged:
            return
        self._rest = shapes
        for ax, picture, camera in self._cleared(pictures):
            ax.set_axis_off()
            if picture.rest is not None:
                draw_silhouette(ax, *checked_surface(picture.rest, picture.faces, "rest"), camera)
        self._figure.patch.set_visible(False)
        self._canvas.draw()
        self._rest_pixels = np.array(self._canvas.buffer_rgba())
        self._figure.patch.set_visible(True)

    def _cleared(self, pictures: Sequence[Picture]) -> Iterator[tuple[Axes, Picture, Camera]]:
        """The empty axes of each picture, and its camera."""
        for ax, picture, camera in zip(self._panels, pictures, self._cameras, strict=True):
            for artist in [*ax.collections, *ax.lines, *ax.patches, *ax.artists]:
                artist.remove()
            yield ax, picture, camera

    def _window(self, points: Array, seen: Array) -> tuple[Array, Array]:
        """Lowest and highest picture coordinates of points and of their shadows on the ground, with a margin."""
        flat = [
            camera.project(np.concatenate([points, dropped_shadow(seen, camera, self._ground)]))[0]
            for camera in self._cameras
        ]
        low, high = np.min(flat, axis=(0, 1)), np.max(flat, axis=(0, 1))
        room = ROOM * float((high - low).max()) + 1e-12
        return low - room, high + room


def save_picture(picture: Image, target: Path) -> None:
    """Write to a temporary file and rename it, so that a failure does not destroy a good picture."""
    with written_whole(target) as part:
        picture.save(part, format="PNG")
