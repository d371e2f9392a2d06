"""Films: a GIF by Pillow, or an MP4 by imageio."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_corot.errors import InputError
from warp_corot.io.files.whole import written_whole

if TYPE_CHECKING:
    from PIL.Image import Image

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


def frames_shown(path: Path, frames: list[int], fps: float) -> tuple[list[int], float]:
    """The frames that a film shows, and their number per second."""
    every = max(int(np.ceil(fps / GIF_FPS - 1e-9)), 1) if path.suffix.lower() == ".gif" else 1
    return frames[::every], fps / every


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
        (_write_gif if path.suffix.lower() == ".gif" else _write_mp4)(part, images, fps)


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


def _write_mp4(path: Path, images: Iterator[Image], fps: float) -> None:
    from imageio.v2 import get_writer

    options = {"codec": "libx264", "quality": 8, "macro_block_size": 2, "ffmpeg_log_level": "error"}
    named = path.with_name(f"{path.name}.mp4")  # FFmpeg chooses the format by the name
    try:
        writer: Any
        with get_writer(named, format="FFMPEG", mode="I", fps=fps, **options) as writer:
            for image in images:
                writer.append_data(np.asarray(image))
        named.replace(path)
    finally:
        named.unlink(missing_ok=True)
