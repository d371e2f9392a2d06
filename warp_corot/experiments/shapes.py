"""The counterpart of the paper's figure 6: deformed shapes side by side."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from warp_corot.io.pictures.preview import Camera, draw_body
from warp_corot.mesh.surfaces.boundary import boundary_faces

from .claims import VOLUME_KEPT
from .paper import CELL_SIZE, CELLS, OWN, PEER, REFERENCE, Results
from .style import FAINT, INK, LINEAR, OWN_COLOR, head, new_figure, save

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def draw_shapes(path: Path, results: Results) -> None:
    """Figure 6: the shapes at the end, each in front of its rest shape, and their outlines superimposed."""
    mesh = results.mesh
    faces, _ = boundary_faces(mesh.tets, mesh.points)
    named = [(PEER, "linear"), (REFERENCE, "St. Venant–Kirchhoff"), ("neo-hookean", "neo-Hookean")]
    named += [(OWN, "corotated, own rotations"), (f"{OWN}-0", "corotated, level 0")]
    shown = np.concatenate([mesh.points, *(results.runs[name].positions for name, _ in named)])
    camera = Camera.fit(shown, mesh.up_axis, azimuth=68.0, elevation=12.0)
    figure = new_figure(9.6, 6.4)
    width, height = 1.0 / 3.0, 0.335
    corners = [(column * width, 0.46 - row * 0.445) for row in range(2) for column in range(3)]
    window, _ = camera.project(shown)
    low, high = window.min(axis=0), window.max(axis=0)
    pad = 0.07 * (high - low)
    for (left, bottom), (name, label) in zip(corners, named, strict=False):
        run = results.runs[name]
        ax = figure.add_axes((left, bottom, width, height))
        draw_body(ax, run.positions, faces, rest=mesh.points, camera=camera, edges=True, ground=False)
        ax.set_xlim(low[0] - pad[0], high[0] + pad[0])
        ax.set_ylim(low[1] - pad[1], high[1] + pad[1])
        growth = f"{100 * run.growth[-1]:+.1f} %".replace("-", "−")
        strong = abs(run.growth[-1]) > VOLUME_KEPT
        _caption(figure, left + width / 2, bottom + height + 0.036, label, f"volume {growth}", strong)
    left, bottom = corners[-1]
    _draw_outlines(figure.add_axes((left + 0.025, bottom, width - 0.05, height + 0.03)), results)
    head(figure, "Deformed shapes at the end", results)
    save(figure, path)


def _draw_outlines(ax: Axes, results: Results) -> None:
    """Draw the beams' sides at x = 0, seen along the x axis."""
    mesh = results.mesh
    lines = ((None, "rest", "#c9c7ce", 1.0), (PEER, "linear", LINEAR, 1.8), (REFERENCE, "StVK", INK, 1.8),
             (OWN, "corotated, own", OWN_COLOR, 1.8))  # fmt: skip
    length, side = CELLS[2] * CELL_SIZE, CELL_SIZE
    corners = np.array([[0.0, 0.0], [length, 0.0], [length, side], [0.0, side]])
    near = np.flatnonzero(np.abs(mesh.points[:, 0]) < 1e-9)
    y, z = mesh.points[near, 1], mesh.points[near, 2]
    outline = []
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        along, across = (
            (z - a[0]) * (b - a)[0] + (y - a[1]) * (b - a)[1],
            (z - a[0]) * (b - a)[1] - (y - a[1]) * (b - a)[0],
        )
        on = np.flatnonzero(np.abs(across) < 1e-9)
        outline.append(near[on[np.argsort(along[on])]])
    loop = np.concatenate(outline)
    for name, label, color, width in lines:
        x = 1e3 * (mesh.points if name is None else results.runs[name].positions)[loop]
        style = (0, (3, 1.5)) if name == OWN else "-"
        ax.plot(-x[:, 2], x[:, 1], color=color, linewidth=width, linestyle=style, label=label)
    ax.plot([0, 0], [-12, 76], color=INK, linewidth=3, solid_capstyle="butt")
    ax.set_aspect("equal")
    ax.set_axis_off()
    ax.set_ylim(-108, 82)
    ax.legend(
        loc="lower center", bbox_to_anchor=(0.5, -0.03), ncols=4, frameon=False, fontsize=8, labelcolor=INK,
        handlelength=1.5, columnspacing=1.0, handletextpad=0.5,
    )  # fmt: skip


def _caption(figure: Figure, x: float, y: float, label: str, note: str, strong: bool) -> None:
    figure.text(x, y, label, fontsize=10, color=INK, ha="center", va="bottom")
    figure.text(x, y - 0.008, note, fontsize=9, color=LINEAR if strong else FAINT, ha="center", va="top")
