"""A cube for tests of pictures, and the content of a picture."""

import numpy as np
from PIL import Image

from warp_corot.io.pictures.preview import Picture, cameras_of, draw_strip, save_picture
from warp_corot.mesh.surfaces.boundary import boundary_faces

# A cube of side 1 about the origin.
CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float) - 0.5
TETS = np.array([[0, 4, 6, 7], [0, 6, 2, 7], [0, 2, 3, 7], [0, 3, 1, 7], [0, 1, 5, 7], [0, 5, 4, 7]])
FACES, _ = boundary_faces(TETS, CUBE)
SIZE = (300, 240)


def picture_of(path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"), dtype=int)


def render_strip(path, pictures, up_axis="Y", azimuth=35.0, elevation=14.0, **options) -> None:
    """Draw bodies side by side into a file, from one side."""
    save_picture(draw_strip(pictures, cameras_of(pictures, up_axis, azimuth, elevation), **options), path)


def render_preview(path, positions, faces, scalars=None, rest=None, title="", size=(1200, 900), **options) -> None:
    """Draw one body into a file; options that are not those of a strip are those of its drawing."""
    of_strip = ("up_axis", "azimuth", "elevation", "value_range", "scalar_label")
    given = {name: options.pop(name) for name in of_strip if name in options}
    render_strip(path, [Picture(positions, faces, scalars, rest, title, options=options)], size=size, **given)
