"""A cube for tests of pictures, and the content of a picture."""

import numpy as np
from PIL import Image

from warp_corot.mesh.surfaces.boundary import boundary_faces

# A cube of side 1 about the origin.
CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float) - 0.5
TETS = np.array([[0, 4, 6, 7], [0, 6, 2, 7], [0, 2, 3, 7], [0, 3, 1, 7], [0, 1, 5, 7], [0, 5, 4, 7]])
FACES, _ = boundary_faces(TETS, CUBE)
SIZE = (300, 240)


def picture_of(path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"), dtype=int)
