"""Draws the films of cuts: cut_slice.gif, cut_bar.gif and cut_tear.gif, in some minutes on a CPU.

python docs/images/draw_cuts.py [NAME ...] [--sheet FOLDER]: all, or some by name. A sheet shows all frames of a film.
"""

import argparse
import io
from pathlib import Path

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

import warp_corot as wc
from warp_corot.io.pictures.drawing import Camera, draw_body

IMAGES = Path(__file__).resolve().parent
#: Pixels of a frame's sides, colours of a film, and the time that each frame is shown [ms].
SIZE, COLORS, SHOWN = (480, 360), 48, 120


def sliced():
    """A lobe of a liver, pulled apart by two hands while a blade goes down through it."""

    def lobe(x):
        radius = np.linalg.norm(x / [0.06, 0.04, 0.02], axis=1)
        dent = np.linalg.norm((x - [0.0, 0.055, 0.0]) / [0.03, 0.025, 0.04], axis=1)
        return 0.02 * np.maximum(radius - 1.0, 1.0 - dent)

    organ = wc.Domain.from_function(lobe, bounds=[(-0.06, -0.04, -0.02), (0.06, 0.04, 0.02)])
    mesh = wc.TetForest.from_domain(organ, cell_size=0.02, max_level=4)
    body = wc.SoftBody(mesh, wc.Isotropic(young=8e3, poisson=0.4, density=1060.0, toughness=3.0), device="cpu")
    for side, pull in ((-1.0, "x < xmin + 0.02"), (1.0, "x > xmax - 0.02")):
        body.prescribe(pull, times=[0.0, 0.9], displacements=[[0, 0, 0], [side * 0.015, 0, 0]])
    blade = wc.Blade(edge=[(0, 0, -0.03), (0, 0, 0.03)], position=(0.002, 0.04, 0.0))
    blade.follow(times=[0.0, 0.7], positions=[(0.002, 0.04, 0.0), (0.002, -0.05, 0.0)])
    steps = wc.SymplecticEuler(damping=10.0)
    return wc.Simulation(body, cuts=[blade], gravity=(0, 0, 0), integrator=steps), (0.0, 0.9), 30.0


def bar():
    """A bar between two walls that move apart; a slanted blade cuts it through."""
    body = wc.SoftBody(
        wc.TetForest.box((4, 1, 1), 0.03, 6), wc.Isotropic(3e4, 0.4, 1000.0, toughness=3.0), device="cpu"
    )
    body.fix("x == xmin")
    body.prescribe("x == xmax", times=[0.0, 0.4], displacements=[[0, 0, 0], [0.015, 0, 0]])
    blade = wc.Blade([(0, 0, -0.01), (0, 0, 0.04)], position=(0.055, 0.035, 0))
    blade.follow([0.0, 0.3], [(0.055, 0.035, 0), (0.07, -0.035, 0)])
    steps = wc.SymplecticEuler(damping=8.0)
    return wc.Simulation(body, cuts=[blade], gravity=(0, -5.0, 0), integrator=steps), (0.0, 0.4), 15.0


def torn():
    """A strip with a slit that is pulled along its length: beyond a stress, the slit runs."""
    body = wc.SoftBody(
        wc.TetForest.box((4, 3, 1), 0.02, 5), wc.Isotropic(3e4, 0.4, 1000.0, toughness=0.0), device="cpu"
    )
    body.fix("x == xmin")
    blade = wc.Blade([(0, 0, -0.01), (0, 0, 0.03)], position=(0.041, 0.07, 0))
    blade.follow([0.0, 0.03, 0.06], [(0.041, 0.07, 0), (0.041, 0.045, 0), (0.041, 0.08, 0)])
    body.prescribe("x == xmax", times=[0.06, 0.7], displacements=[[0, 0, 0], [0.014, 0, 0]])
    sim = wc.Simulation(body, cuts=[blade], gravity=(0, 0, 0), integrator=wc.SymplecticEuler(damping=60.0))
    sim.on_step(lambda sim: sim.tear(6e3) if sim.time > 0.08 else None, every=10)
    return sim, (0.49, 0.6), 20.0


FILMS = {"slice": sliced, "bar": bar, "tear": torn}


def frames(sim, times, azimuth, count):
    """Pictures of the drawn surface between two times [s]."""
    camera = None
    for time in np.linspace(*times, count):
        sim.advance_until(time)
        (body,) = sim.bodies
        surface = body.mesh.surface()
        x = surface.moved(body.displacements.numpy())
        if camera is None:
            grown = 1.2 * (x - x.mean(axis=0)) + x.mean(axis=0)
            camera = Camera.fit(grown, "Y", azimuth, 22.0)
        figure = plt.figure(figsize=(SIZE[0] / 100, SIZE[1] / 100), dpi=100, layout="constrained")
        draw_body(figure.subplots(), x, surface.triangles, camera=camera, edges=True, ground=False)
        data = io.BytesIO()
        figure.savefig(data, dpi=100)
        plt.close(figure)
        print(f"{sim.time:.3f} s, {body.pieces} piece(s), {1e4 * body.cut_area:.2f} cm²", flush=True)
        yield Image.open(data).convert("RGB")


def sheet(pictures, path):
    """All frames beside one another."""
    across = 4
    down = -(-len(pictures) // across)
    whole = Image.new("RGB", (across * SIZE[0], down * SIZE[1]), "white")
    for k, picture in enumerate(pictures):
        whole.paste(picture, (k % across * SIZE[0], k // across * SIZE[1]))
    whole.save(path)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", choices=[[], *FILMS], help="films")
    parser.add_argument("--frames", type=int, default=16, help="frames of a film")
    parser.add_argument("--sheet", help="folder for sheets of all frames")
    args = parser.parse_args()
    for name in args.names or FILMS:
        pictures = list(frames(*FILMS[name](), args.frames))
        small = [picture.quantize(COLORS, dither=Image.Dither.NONE) for picture in pictures]
        path = IMAGES / f"cut_{name}.gif"
        small[0].save(path, save_all=True, append_images=small[1:], duration=SHOWN, loop=0, optimize=True)
        print(f"wrote {path.name}, {path.stat().st_size / 1000:.0f} kB")
        if args.sheet:
            sheet(pictures, Path(args.sheet) / f"cut_{name}.png")


if __name__ == "__main__":
    main()
