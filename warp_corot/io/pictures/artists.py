"""What pictures draw that Matplotlib has no class for; the only module here that cannot be imported without it."""

from typing import Any

import numpy as np
from matplotlib.artist import Artist
from numpy.typing import NDArray

from .drawing import Array


class Triangles(Artist):
    """Filled triangles, the first ones farthest back.

    Between their corners colours are interpolated, and neighbours leave no seams. They take a third of the time of
    polygons.

    Args:
        corners: Coordinates in the axes [n, 3, 2].
        colors: sRGB colours at the corners [n, 3, 3].
        order: Artists of a higher order are drawn later.
    """

    def __init__(self, corners: Array, colors: Array, order: int):
        super().__init__()
        self.set_zorder(order)
        self._corners = corners
        self._colors = np.concatenate([colors, np.ones((*colors.shape[:2], 1))], axis=2)

    def draw(self, renderer: Any) -> None:
        drawing = renderer.new_gc()
        self._set_gc_clip(drawing)  # type: ignore[attr-defined]
        transform = self.axes.transData.frozen()  # type: ignore[union-attr]
        renderer.draw_gouraud_triangles(drawing, self._corners, self._colors, transform)
        drawing.restore()


class Pixels(Artist):
    """A drawing of the whole figure, of which axes show the part that lies in them.

    Args:
        pixels: RGBA, uint8 [height, width, 4].
        order: Artists of a higher order are drawn later.
    """

    def __init__(self, pixels: NDArray[np.uint8], order: int):
        super().__init__()
        self.set_zorder(order)
        self._pixels = pixels[::-1]

    def draw(self, renderer: Any) -> None:
        drawing = renderer.new_gc()
        self._set_gc_clip(drawing)  # type: ignore[attr-defined]
        renderer.draw_image(drawing, 0, 0, self._pixels)
        drawing.restore()
