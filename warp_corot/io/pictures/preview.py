"""Pictures of deformed bodies as PNG files: one body, or several side by side."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from warp_corot.errors import InputError
from warp_corot.io.files.whole import written_whole

from .camera import Array, Camera
from .drawing import INK, checked_surface, draw_body, draw_silhouette, value_limits
from .lettering import BAR, draw_color_bar, fit_line, needed_width
from .shadow import dropped_shadow

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from PIL.Image import Image

__all__ = ["Camera", "Picture", "draw_body", "value_limits"]

#: Pixels an inch, on which sizes of type depend; and the margin of a film's window.
DPI, ROOM = 150.0, 0.06


@dataclass
class Picture:
    """One body in a strip: `draw_body` explains the fields; ``view`` is azimuth and elevation [°]."""

    positions: ArrayLike
    faces: ArrayLike
    scalars: ArrayLike | None = None
    rest: ArrayLike | None = None
    title: str = ""
    options: dict[str, Any] = field(default_factory=dict)
    view: tuple[float, float] | None = None


def cameras_of(
    pictures: Sequence[Picture], up_axis: str, azimuth: float, elevation: float, box: Array | None = None
) -> list[Camera]:
    """A camera for each picture, all at the same distance from one point.

    Args:
        pictures: Those without their own view are seen from ``azimuth`` and ``elevation`` [°].
        up_axis: "X", "Y" or "Z".
        azimuth, elevation: See `Camera.fit`.
        box: Lowest and highest coordinates to be seen [2, 3]; None: those of the pictures.
    """
    if box is None:
        box = bounds_of(pictures)
    views = [p.view or (azimuth, elevation) for p in pictures]
    return [Camera.fit(box, up_axis, *view) for view in views]


def bounds_of(pictures: Sequence[Picture]) -> Array:
    """Lowest and highest visible coordinates of bodies [2, 3].

    Raises:
        InputError: Invalid positions or faces.
    """
    given = [(x, p.faces) for p in pictures for x in (p.positions, p.rest) if x is not None]
    seen = [x[tri].reshape(-1, 3) for x, tri in (checked_surface(*each, "positions") for each in given)]
    return np.stack([np.min([x.min(axis=0) for x in seen], axis=0), np.max([x.max(axis=0) for x in seen], axis=0)])


def draw_strip(
    pictures: Sequence[Picture], cameras: Sequence[Camera], *, title: str | None = None, **options: Any
) -> "Image":
    """Draw pictures side by side once; the options are those of `Strip`."""
    return Strip(pictures, cameras, titled=title is not None, **options).draw(pictures, title)


class Strip:
    """Pictures side by side with one scale and one colour bar, drawn again for each frame of a film.

    Args:
        pictures: Those of the first frame, from left to right, and row after row.
        cameras: One for each picture.
        titled: Whether frames have a title.
        scalar_label: Label of the colour bar.
        value_range: Values at the ends of the colour map; None: 0 to the highest 99th percentile, rounded up.
        size: Pixels; None: 600 a picture, with the height that they need.
        window: Lowest and highest picture coordinates of the panels, see `window_of`; None: those of the pictures.
        ground: Height of the ground; None: below the lowest node.
        fineness: Factor on the pixels drawn along each side, which are then averaged.
        columns: Pictures in a row; None: all.

    Raises:
        InputError: Matplotlib is not installed, or positions or faces as in `draw_body`.
    """

    def __init__(
        self,
        pictures: Sequence[Picture],
        cameras: Sequence[Camera],
        *,
        titled: bool = False,
        scalar_label: str = "von Mises stress [Pa]",
        value_range: tuple[float, float] | None = None,
        size: tuple[int, int] | None = None,
        window: tuple[Array, Array] | None = None,
        ground: float | None = None,
        fineness: int = 2,
        columns: int | None = None,
    ):
        try:
            from matplotlib.backends.backend_agg import FigureCanvasAgg
            from matplotlib.figure import Figure
        except ImportError:
            raise InputError('pictures need Matplotlib: pip install "warp-corot[plot]"') from None
        if ground is None:
            ground = float(bounds_of(pictures)[0] @ cameras[0].world_up)
        with_scalars = [p.scalars for p in pictures if p.scalars is not None]
        if with_scalars and value_range is None:
            value_range = (0.0, max(value_limits(scalars)[1] for scalars in with_scalars))
        self._cameras, self._limits, self._ground, self._fineness = cameras, value_range, ground, fineness
        self._window, self._fixed_size = window, size is not None
        self._columns = columns or len(pictures)
        self._rows = -(-len(pictures) // self._columns)
        self._head, self._own_head = 56 * titled, 40 * any(p.title for p in pictures)
        self._width, self._height = size or (600 * self._columns, 600 * self._rows)
        self._figure = Figure((self._width / DPI, self._height / DPI), dpi=DPI, facecolor="white")
        self._canvas = FigureCanvasAgg(self._figure)
        self._legend, self._bar = None, 0.0
        if with_scalars and value_range is not None:
            self._legend = draw_color_bar(self._figure, value_range, scalar_label)
            self._bar = needed_width(self._legend, self._width)
        self._step = (self._width - self._bar) / self._columns
        self._panels = [self._figure.add_axes((0.0, 0.0, 1.0, 1.0), label=f"panel {k}") for k in range(len(pictures))]
        self._title = self._figure.text(0.5, 1.0, "", ha="center", va="top", color=INK)
        self._is_laid_out = False
        self._rest: list[ArrayLike] = []
        self._rest_pixels: Any = None

    def draw(self, pictures: Sequence[Picture], title: str | None = None) -> "Image":
        """Draw a frame: as many pictures as the first one has, and its title."""
        from PIL import Image

        from .artists import Pixels

        self._figure.set_dpi(DPI)
        if self._window is not None:
            self._lay_out(*self._window)
            self._draw_rest(pictures)
        self._clear()
        for ax, picture, camera in zip(self._panels, pictures, self._cameras, strict=True):
            if self._rest_pixels is not None:
                ax.add_artist(Pixels(self._rest_pixels, order=2))
            draw_body(
                ax,
                picture.positions,
                picture.faces,
                scalars=picture.scalars,
                value_range=self._limits,
                rest=picture.rest if self._window is None else None,
                camera=camera,
                **{"ground": self._ground, **picture.options},
            )
            if picture.title:
                fit_line(ax.set_title(picture.title, fontsize=11, color=INK, pad=4), self._step - 16)
        if self._window is None:
            limits = np.array([[ax.get_xlim(), ax.get_ylim()] for ax in self._panels], dtype=np.float64)
            self._lay_out(limits[..., 0].min(axis=0), limits[..., 1].max(axis=0))
        if title:
            self._title.set(text=title, fontsize=13)
            fit_line(self._title, self._width - self._bar - 16)
        self._figure.set_dpi(self._fineness * DPI)
        self._canvas.draw()
        return Image.fromarray(np.asarray(self._canvas.buffer_rgba())[..., :3]).reduce(self._fineness)

    def _clear(self) -> None:
        for ax in self._panels:
            for artist in [*ax.collections, *ax.lines, *ax.patches, *ax.artists]:
                artist.remove()

    def _draw_rest(self, pictures: Sequence[Picture]) -> None:
        """Draw the rest shapes and the colour bar to pixels, which frames show until the shapes change."""
        shapes = [each for p in pictures if p.rest is not None for each in (p.rest, p.faces)]
        if len(shapes) == len(self._rest) and all(map(np.array_equal, shapes, self._rest)):
            return
        from .artists import Pixels

        self._rest = shapes
        self._clear()
        for ax, picture, camera in zip(self._panels, pictures, self._cameras, strict=True):
            ax.set_axis_off()
            if picture.rest is not None:
                draw_silhouette(ax, *checked_surface(picture.rest, picture.faces, "rest"), camera)
        for each in (self._figure.patch, self._title):
            each.set_visible(False)
        for former in self._figure.artists:
            former.remove()
        if self._legend is not None:
            self._legend.set_visible(True)
        self._figure.set_dpi(self._fineness * DPI)
        self._canvas.draw()
        self._rest_pixels = np.array(self._canvas.buffer_rgba())
        self._figure.set_dpi(DPI)
        for each in (self._figure.patch, self._title):
            each.set_visible(True)
        self._figure.add_artist(Pixels(self._rest_pixels, order=0))
        if self._legend is not None:
            self._legend.set_visible(False)

    def _lay_out(self, low: Array, high: Array) -> None:
        """Place the panels side by side below their titles, and the colour bar at the right, in pixels; once."""
        if self._is_laid_out:
            return
        self._is_laid_out = True
        width, step, rows = self._width, self._step, self._rows
        if not self._fixed_size:
            picture_height = int(step * np.clip((high[1] - low[1]) / (high[0] - low[0]), 0.3, 1.6))
            self._height = rows * (picture_height + self._own_head) + self._head
            self._figure.set_size_inches(width / DPI, self._height / DPI)
        height = self._height
        row_height = (height - self._head) / rows
        _same_window(self._panels, low, high, step / (row_height - self._own_head))
        for index, ax in enumerate(self._panels):
            row, column = divmod(index, self._columns)
            place = (column * step / width, (rows - 1 - row) * row_height / height)
            ax.set_position((*place, step / width, (row_height - self._own_head) / height))
        if self._legend is not None:
            self._legend.set_position(((width - self._bar + 10) / width, 0.2, BAR / width, 0.55))
        self._title.set_position(((width - self._bar) / (2.0 * width), 1.0 - 14 / height))


def window_of(points: Array, square: Array, cameras: Sequence[Camera], ground: float) -> tuple[Array, Array]:
    """Lowest and highest picture coordinates of the panels of a film, with a margin, [2] and [2].

    Args:
        points: The outermost points of all frames [m], [n, 3].
        square: Corners of the ground [m], [4, 3] or [0, 3].
        cameras: Cameras of the panels.
        ground: Height of the ground, with the shadows on it.
    """
    flat = [
        camera.project(np.concatenate([points, square, dropped_shadow(points, camera, ground)]))[0]
        for camera in cameras
    ]
    low, high = np.min(flat, axis=(0, 1)), np.max(flat, axis=(0, 1))
    room = ROOM * float((high - low).max())
    return low - room, high + room


def _same_window(all_axes: Sequence["Axes"], low: Array, high: Array, aspect: float) -> None:
    """Set one window for all axes, around ``low`` to ``high``, with the axes' aspect (width to height)."""
    center, half = (low + high) / 2.0, (high - low) / 2.0
    half_height = max(half[1], half[0] / aspect)
    for ax in all_axes:
        ax.set_xlim(center[0] - half_height * aspect, center[0] + half_height * aspect)
        ax.set_ylim(center[1] - half_height, center[1] + half_height)


def save_picture(picture: "Image", target: Path) -> None:
    """Write to a temporary file and rename it, so that a failure does not destroy a good picture."""
    with written_whole(target) as part:
        picture.save(part, format="PNG")
