"""A cube for tests of pictures, and the content of a picture."""

import numpy as np
from PIL import Image

from warp_corot.io.pictures.drawing import checked_surface, value_limits
from warp_corot.io.pictures.preview import Picture, Strip, save_picture
from warp_corot.mesh.topology import boundary_faces

# A cube of side 1 about the origin.
CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float) - 0.5
TETS = np.array([[0, 4, 6, 7], [0, 6, 2, 7], [0, 2, 3, 7], [0, 3, 1, 7], [0, 1, 5, 7], [0, 5, 4, 7]])
FACES, _ = boundary_faces(TETS, CUBE)
SIZE = (300, 240)


def picture_of(path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"), dtype=int)


def render_strip(path, pictures, up_axis="Y", title="", **options) -> None:
    """Draw bodies side by side into a file."""
    given = [(x, each.faces) for each in pictures for x in (each.positions, each.rest) if x is not None]
    seen = [x[faces].reshape(-1, 3) for x, faces in (checked_surface(*each, "positions") for each in given)]
    highest = [value_limits(each.scalars)[1] for each in pictures if each.scalars is not None]
    options = {"value_range": (0.0, max(highest)) if highest else None, "titled": bool(title), **options}
    save_picture(Strip(pictures, np.concatenate(seen), up_axis, **options).draw(pictures, title), path)


def render_preview(
    path, positions, faces, scalars=None, rest=None, title="", size=(1200, 900), view=(35.0, 14.0), **options
) -> None:
    """Draw one body into a file; options that are not those of a strip are those of its drawing."""
    of_strip = ("up_axis", "value_range", "scalar_label")
    given = {name: options.pop(name) for name in of_strip if name in options}
    picture = Picture(positions, faces, scalars, rest, title, options, view)
    render_strip(path, [picture], size=size, **given)
