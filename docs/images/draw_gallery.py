"""Draws the thumbnails of the gallery and of the notebooks: gallery/*.png, in a few minutes on a CPU.

python docs/images/draw_gallery.py [NAME ...]: all, or some by name; with matplotlib, nibabel and newton. Pictures of
long runs are made smaller only; the pages with the large ones say which commands make them.
"""

import io
import os
import runpy
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

import warp_corot as wc
from warp_corot.cli import main as warp_corot
from warp_corot.cli.results import DrawnBodies
from warp_corot.io.pictures.drawing import Camera, draw_body

ROOT = Path(__file__).resolve().parents[2]
IMAGES, EXAMPLES = ROOT / "docs" / "images", ROOT / "examples"
#: Pixels of a thumbnail's longer side, and the most bytes of its file.
SIDE, BYTES = 640, 60_000


def command(*words):
    """The preview of a command."""

    def draw(name):
        warp_corot(["simulate", *words, "-o", f"{name}.usd", "--preview", f"{name}.png", "--device", "cpu"])
        return Image.open(f"{name}.png")

    return draw


def example(script, duration, up_axis="Y", azimuth=35.0, elevation=14.0, **options):
    """An example's bodies, tools and stresses after a time [s]; options of `draw_body`."""

    def draw(name):
        seen = []

        def advance(sim, path, **options):
            sim.advance(duration)
            seen.append(sim)

        kept, wc.record, sys.argv = wc.record, advance, [script, "--device", "cpu"]
        try:
            runpy.run_path(str(EXAMPLES / script), run_name="__main__")
        finally:
            wc.record = kept
        (sim,) = seen
        bodies = [
            SimpleNamespace(soft=body, subject=SimpleNamespace(mesh=body.mesh, drawn=lambda _: None))
            for body in sim.bodies
        ]
        shown = DrawnBodies(bodies, sim).frame(sim)
        points = shown.positions
        camera = Camera.fit(np.stack([points.min(axis=0), points.max(axis=0)]), up_axis, azimuth, elevation)
        figure = plt.figure(figsize=(6.4, 4.8), layout="constrained")
        draw_body(figure.subplots(), points, shown.faces, scalars=shown.scalars, camera=camera, **options)
        return saved(figure)

    return draw


def notebook(stem):
    """The figure of a notebook."""

    def draw(name):
        sys.path.insert(0, str(ROOT / "tests" / "support"))
        from pages import run_python

        plt.close("all")
        run_python(EXAMPLES / "notebooks" / f"{stem}.ipynb", Path.cwd())
        return saved(plt.figure(plt.get_fignums()[-1]))

    return draw


def picture(file):
    """A picture of these pages."""
    return lambda name: Image.open(IMAGES / file)


def saved(figure):
    data = io.BytesIO()
    figure.savefig(data, dpi=200)
    return Image.open(data)


THUMBNAILS = {
    "bunny": picture("bunny.png"),
    "falls": command("warp:bunny", "--tets", "6000", "--drop", "5cm", "--duration", "0.25", "--preview-frames", "2,4"),
    "twist": example("twist.py", 2.2, elevation=25.0),
    "press": example("press.py", 0.8, "Z", elevation=25.0),
    "pile": example("pile.py", 1.2, "Z", elevation=40.0, ground=False),
    "models": example("models.py", 1.0, azimuth=50.0),
    "organ": notebook("press_an_organ"),
    "modulus": notebook("find_a_modulus"),
    "scan": notebook("from_a_scan"),
    "newton_scene": notebook("newton_scene"),
    "brain": picture("brain.png"),
    "remesh": picture("remesh.png"),
}


def write(picture, path):
    """Write a thumbnail with as many colours as its file may take."""
    small = picture.convert("RGB")
    small.thumbnail((SIDE, SIDE), Image.Resampling.LANCZOS)
    for colors in (256, 128, 64, 32):
        small.quantize(colors, dither=Image.Dither.NONE).save(path, optimize=True)
        if path.stat().st_size <= BYTES:
            print(f"{path.name}: {small.width} x {small.height}, {colors} colours, {path.stat().st_size} bytes")
            return
    raise SystemExit(f"{path} has more than {BYTES} bytes")


def main(names):
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        for name in names or THUMBNAILS:
            write(THUMBNAILS[name](name), IMAGES / "gallery" / f"{name}.png")


if __name__ == "__main__":
    main(sys.argv[1:])
