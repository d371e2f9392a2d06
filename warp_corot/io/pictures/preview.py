"""Pictures of deformed bodies as PNG files, side by side, with titles and a colour bar; films by Pillow or imageio."""

from __future__ import annotations

import functools
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from warp_corot.errors import InputError
from warp_corot.io.files.whole import written_whole

from .colors import stress_colors
from .drawing import INK, Array, Camera, Window, framed, render, silhouette

if TYPE_CHECKING:
    from PIL.Image import Image

#: Pixels of the colour bar's width, of large, middle and small type, and of the smallest.
BAR, LARGE, MIDDLE, SMALL, SMALLEST = 16, 27, 23, 17, 10
#: Pixels drawn along each side of one, which are then averaged.
FINENESS = 2


@functools.cache
def font_of(size: int) -> Any:
    """The type of Matplotlib's wheel, which has most alphabets, in a size [pixels]."""
    from PIL import ImageFont

    found = find_spec("matplotlib")
    if found is None or found.origin is None:
        raise InputError('pictures need Matplotlib: pip install "warp-corot[plot]"')
    return ImageFont.truetype(str(Path(found.origin).parent / "mpl-data" / "fonts" / "ttf" / "DejaVuSans.ttf"), size)


def fit_line(words: str, width: float, size: int) -> tuple[str, Any]:
    """A line and its type, made smaller, and if necessary shorter, until it is no wider than a number of pixels.

    A short text after its last semicolon is kept.
    """
    while font_of(size).getlength(words) > width and size > SMALL - 3:
        size -= 1
    end = "".join(re.findall(r"; [^;]{1,12}$", words))
    begun, line = words.removesuffix(end), words
    while font_of(size).getlength(line) > width and len(begun) > 8:
        begun = begun[:-2]
        line = f"{begun.rstrip()} …{end}"
    return line, font_of(size)


def color_bar(limits: tuple[float, float], label: str, width: int, height: int) -> Image:
    """The colour bar with its numbers and its label, in kPa, MPa or GPa in place of so many Pa."""
    from PIL import Image, ImageDraw

    for unit, size in (("GPa", 1e9), ("MPa", 1e6), ("kPa", 1e3)):
        if label.endswith("[Pa]") and max(map(abs, limits)) >= size:
            label, limits = f"{label[:-4]}[{unit}]", (limits[0] / size, limits[1] / size)
    (low, high), top, tall = limits, round(0.25 * height), round(0.55 * height)
    least = max(high - low, 1e-30) / 6.0
    power = 10.0 ** np.floor(np.log10(least))
    step = next(power * each for each in (1.0, 2.0, 2.5, 5.0, 10.0) if power * each >= least * (1.0 - 1e-9))
    ticks = low + step * np.arange(int((high - low) / step * (1.0 + 1e-9)) + 1)
    numbers = [f"{value:,.6g}".replace(",", " ") for value in ticks.tolist()]
    small, size = font_of(SMALL - 2), SMALL + 1
    while font_of(size).getlength(label) > 0.9 * height and size > SMALLEST:
        size -= 1
    beside = BAR + 8 + round(max(map(small.getlength, numbers)))
    needed = min(max(beside + 2 * size + 22, 130), round(0.7 * width))
    image = Image.new("RGB", (needed, height), "white")
    colors = np.rint(255.0 * stress_colors(tall)[::-1]).astype(np.uint8)
    image.paste(Image.fromarray(np.repeat(colors[:, None], BAR, axis=1)), (0, top))
    drawing = ImageDraw.Draw(image)
    for value, number in zip(ticks.tolist(), numbers, strict=True):
        drawing.text((BAR + 6, top + tall * (high - value) / (high - low)), number, INK, small, anchor="lm")
    words = Image.new("RGB", (round(font_of(size).getlength(label)) + 4, round(1.4 * size)), "white")
    ImageDraw.Draw(words).text((2, 0), label, INK, font_of(size))
    turned = words.rotate(90, expand=True)
    middle = top + tall // 2 - turned.height // 2
    image.paste(turned, (beside + 6, min(max(middle, 3), max(height - turned.height - 3, 3))))
    return image


@dataclass
class Picture:
    """One body in a strip: `render` explains the fields; ``view`` is azimuth and elevation [°]."""

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
        columns: int | None = None,
    ):
        font_of(LARGE)
        self._cameras = [Camera.fit(seen, up_axis, *each.view) for each in pictures]
        squares = [each.options["square"] for each in pictures if "square" in each.options]
        points = np.concatenate([seen, *squares])
        self._ground = float((points @ self._cameras[0].world_up).min())
        windows = [framed(camera, points, self._ground) for camera in self._cameras]
        low, high = np.min([each.low for each in windows], axis=0), np.max([each.high for each in windows], axis=0)
        self._columns = columns or len(pictures)
        rows = -(-len(pictures) // self._columns)
        self._head, self._own_head = 56 * titled, 40 * any(each.title for each in pictures)
        width, height = size or (600 * self._columns, 600 * rows)
        self._limits, self._legend = value_range, None
        step = width // self._columns
        if value_range is not None:
            needed = color_bar(value_range, scalar_label, width, height).width
            step = (width - needed) // self._columns
        if size is None:
            tall = int(step * np.clip((high - low)[1] / (high - low)[0], 0.3, 1.6))
            height = rows * (tall + self._own_head) + self._head
        if value_range is not None:
            self._legend = color_bar(value_range, scalar_label, width, height)
        self._size, self._row = (width, height), (height - self._head) // rows
        tall = self._row - self._own_head
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        half = max(half[1], half[0] * tall / step) * np.array([step / tall, 1.0])
        self._window = Window(middle - half, middle + half, (FINENESS * step, FINENESS * tall), 1.6 * FINENESS)
        self._step = step
        self._ghosts: dict[int, tuple[NDArray[Any], NDArray[Any], NDArray[np.uint8]]] = {}

    def draw(self, pictures: Sequence[Picture], title: str = "") -> Image:
        """Draw a frame: as many pictures as the first one has, and its title.

        Raises:
            InputError: Positions or faces as in `render`.
        """
        from PIL import Image, ImageDraw

        image = Image.new("RGB", self._size, "white")
        drawing = ImageDraw.Draw(image)
        for index, (picture, camera) in enumerate(zip(pictures, self._cameras, strict=True)):
            left, top = index % self._columns * self._step, self._head + index // self._columns * self._row
            options = {"ground": self._ground, **picture.options}
            options["ground"] = None if options["ground"] is False else options["ground"]
            ghost = None
            if picture.rest is not None:  # its silhouette is drawn again only if it changes
                given = np.asarray(picture.rest), np.asarray(picture.faces)
                if index not in self._ghosts or not all(map(np.array_equal, given, self._ghosts[index][:2])):
                    self._ghosts[index] = (*given, silhouette(self._window, camera, *given))
                ghost = self._ghosts[index][2]
            options = {"scalars": picture.scalars, "value_range": self._limits, "ghost": ghost} | options
            panel = render(self._window, camera, picture.positions, picture.faces, **options)
            image.paste(Image.fromarray(panel).reduce(FINENESS), (left, top + self._own_head))
            if picture.title:
                line, font = fit_line(picture.title, self._step - 16, MIDDLE)
                drawing.text((left + self._step // 2, top + self._own_head // 2 + 8), line, INK, font, anchor="mm")
        room = self._size[0]
        if self._legend is not None:
            room -= self._legend.width
            image.paste(self._legend, (room, 0))
        if title:
            line, font = fit_line(title, room - 16, LARGE)
            drawing.text((room // 2, self._head // 2), line, INK, font, anchor="mm")
        return image


def save_picture(picture: Image, target: Path) -> None:
    """Write to a temporary file and rename it, so that a failure does not destroy a good picture."""
    with written_whole(target) as part:
        picture.save(part, format="PNG")


# --- films -----------------------------------------------------------------------------------------------------------

FILMS = (".gif", ".mp4")
#: Viewers show at most this many frames of a GIF a second; frames in between are left out.
GIF_FPS = 25.0
#: About this many frames determine the colours of a GIF.
PALETTE_FRAMES = 16


def check_film(path: Path) -> None:
    """Check that the package for a film is installed.

    Raises:
        InputError: It is not.
    """
    if path.suffix.lower() == ".mp4" and not (find_spec("imageio") and find_spec("imageio_ffmpeg")):
        raise InputError(f'{path}: films as .mp4 need: pip install "warp-corot[film]"; a .gif needs no package')


def write_film(path: Path, images: Iterator[Image], fps: float) -> None:
    """Write a film, completely or not at all.

    Args:
        path: A .gif or .mp4 file.
        images: Images of equal size.
        fps: Images per second.

    Raises:
        OSError: It cannot be written; a former film stays.
    """
    with written_whole(path) as part:
        if path.suffix.lower() == ".gif":
            _write_gif(part, images, fps)
            return
        from imageio.v2 import get_writer

        options = {"codec": "libx264", "quality": 8, "macro_block_size": 2, "ffmpeg_log_level": "error"}
        writer: Any
        with get_writer(part, format="FFMPEG", mode="I", fps=fps, **options) as writer:
            for image in images:
                writer.append_data(np.asarray(image))


def _write_gif(path: Path, images: Iterator[Image], fps: float) -> None:
    from PIL import Image

    # One palette for all, to avoid flicker; from pictures of the whole film, since their colours differ.
    frames = list(images)
    some = [frame.reduce(2) for frame in frames[:: -(-len(frames) // PALETTE_FRAMES)]]
    together = Image.new("RGB", (some[0].width, some[0].height * len(some)))
    for number, frame in enumerate(some):
        together.paste(frame, (0, number * frame.height))
    palette = together.quantize(colors=256, method=Image.Quantize.MEDIANCUT)
    flat = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    hundredths = max(round(100.0 / fps), 2)
    flat[0].save(
        path, format="GIF", save_all=True, append_images=flat[1:], duration=10 * hundredths, loop=0, optimize=True
    )
