"""Draws six of the cases of ``warp-corot verify``: verify.png, in half a minute on a CPU.

python docs/images/draw_verify.py, with matplotlib and Pillow. Colours are displacements, each from zero to its largest.
"""

import io
from pathlib import Path

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

from warp_corot.experiments import CASES, Setup
from warp_corot.io.pictures.drawing import Camera, draw_body
from warp_corot.io.write.skins import poses_of, shape_of, solid_of

#: Cases, and azimuth and elevation of the camera [°].
SHOWN = {
    "cantilever": ("Y", 68.0, 12.0),
    "cook": ("Y", 20.0, 20.0),
    "cattaneo-mindlin": ("Z", 30.0, 22.0),
    "nafems-roller": ("Z", 68.0, 14.0),
    "ring": ("Z", 40.0, 25.0),
    "ironing": ("Z", 55.0, 25.0),
}


def draw(ax, name, up_axis, azimuth, elevation):
    setup = Setup("cpu")
    CASES[name].run(setup)
    bodies, obstacles = setup.shown
    points, faces, values = [], [], []

    def add(x, triangles, value):
        faces.append(triangles + sum(map(len, points)))
        points.append(x)
        values.append(value)

    for body in bodies:
        u = body.displacements.numpy()
        add(body.positions.numpy(), body.surface_triangles, np.linalg.norm(u, axis=1))
    for each, pose in zip(obstacles, poses_of(obstacles), strict=True):
        solid = solid_of(shape_of(each))
        if solid is not None:
            add(solid.at(pose), solid.triangles, np.full(len(solid.points), np.nan))
    camera = Camera.fit(np.concatenate(points[: len(bodies)]), up_axis, azimuth, elevation)
    arrays = (np.concatenate(each) for each in (points, faces, values))
    x, triangles, scalars = arrays
    draw_body(ax, x, triangles, scalars=scalars, camera=camera, edges=True, ground=False)
    ax.set_title(name, fontsize=9)


def main():
    figure, axes = plt.subplots(2, 3, figsize=(9.6, 6.0), layout="constrained")
    for ax, (name, view) in zip(axes.flat, SHOWN.items(), strict=True):
        draw(ax, name, *view)
    data = io.BytesIO()
    figure.savefig(data, dpi=130)
    path = Path(__file__).with_name("verify.png")
    Image.open(data).convert("RGB").quantize(64, dither=Image.Dither.NONE).save(path, optimize=True)
    print(f"{path.name}: {path.stat().st_size} bytes")


if __name__ == "__main__":
    main()
