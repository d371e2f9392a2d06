"""How many tetrahedra a surface needs: adaptive and uniform meshes of a ball and of a body with fine features.

``python benchmarks/mesh_savings.py -o lod.png`` measures and draws it.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from paper_figures import FAINT, INK, LINEAR, OWN_COLOR, STYLE

from warp_corot.domain import Domain
from warp_corot.errors import InputError
from warp_corot.io.files.whole import check_output, written_whole
from warp_corot.mesh import TetForest

#: Edge of a root cube [m]; the bodies fit into one cube or a few.
CELL = 1.0
#: A mesh farther than this, the thickness of the spines, from the spiny body has lost most of a spine [m].
LOST = 0.02


@dataclass(frozen=True)
class Point:
    """A mesh of a body.

    Attributes:
        name: Name of the body.
        kind: "uniform", or "adaptive".
        level: The deepest level.
        tets: Number of tetrahedra.
        error: Largest distance between the marched surface and the body's, in either direction [m].
        seconds: Time to make the forest from the domain.
    """

    name: str
    kind: str
    level: int
    tets: int
    error: float
    seconds: float


def ball() -> Domain:
    """A ball of 40 cm."""
    return Domain.sphere(0.4, device="cpu")


def spiny() -> Domain:
    """The ball with three spines of 1 cm radius that protrude by 8 cm."""
    body = ball()
    for direction in ([1.0, 0.2, 0.1], [-0.3, 1.0, 0.2], [0.1, -0.2, -1.0]):
        unit = np.array(direction) / np.linalg.norm(direction)
        body = body | Domain.capsule(0.3 * unit, 0.47 * unit, 0.01, device="cpu")
    return body


def distance_between(mesh: TetForest, domain: Domain, samples: np.ndarray) -> float:
    """The largest distance between a mesh's marched surface and its body's [m].

    Args:
        mesh: A mesh made from the domain.
        domain: The domain; phi must be a distance near the surface.
        samples: Points on the body's surface [n, 3].
    """
    surface = mesh.surface()
    middles = surface.points[surface.triangles].mean(axis=1)
    off_body = np.abs(domain.phi(np.concatenate([surface.points, middles]))).max()
    marched = Domain.from_surface((surface.points, surface.triangles), device="cpu")
    return float(max(off_body, np.abs(marched.phi(samples)).max()))


def measured(name: str, kind: str, domain: Domain, samples: np.ndarray, **size: float | None) -> Point:
    """Make and measure a mesh; ``size`` are arguments of `TetForest.from_domain`."""
    started = time.perf_counter()
    mesh = TetForest.from_domain(domain, CELL, **size)  # type: ignore[arg-type]
    seconds = time.perf_counter() - started
    error = distance_between(mesh, domain, samples)
    return Point(name, kind, int(mesh.levels.max()), len(mesh.tets), error, seconds)


def sampled(domain: Domain, error: float) -> np.ndarray:
    """Points on the body's surface [n, 3]: points of a mesh with this surface error [m], moved along phi's gradient."""
    x = TetForest.from_domain(domain, CELL, max_level=36, surface_error=error).surface().points
    step = 1e-3 * np.eye(3)
    slope = np.stack([domain.phi(x + d) - domain.phi(x - d) for d in step], axis=1)
    slope /= np.linalg.norm(slope, axis=1, keepdims=True)
    x = x - domain.phi(x)[:, None] * slope
    return x[np.abs(domain.phi(x)) < 0.1 * error]


def study(
    levels: Sequence[int] = (9, 12, 15, 18, 21), errors: Sequence[float] = (16e-3, 8e-3, 4e-3, 2e-3, 1e-3)
) -> list[Point]:
    """Measure the meshes of both bodies.

    The ball has, at each level, a mesh refined at its surface and one refined everywhere. The spiny body has adaptive
    meshes for each surface error [m], and uniform meshes of the same levels.
    """
    points = []
    domain = ball()
    samples = sampled(domain, 4e-4)
    for level in levels:
        points.append(measured("ball", "adaptive", domain, samples, max_level=level))
        points.append(measured("ball", "uniform", domain, samples, min_level=level, max_level=level))
    domain = spiny()
    samples = sampled(domain, 4e-4)
    for error in errors:
        points.append(measured("spiny", "adaptive", domain, samples, max_level=36, surface_error=error))
    for level in levels:
        points.append(measured("spiny", "uniform", domain, samples, min_level=level, max_level=level))
    return points


def ratios_by_level(points: Sequence[Point]) -> dict[int, float]:
    """Adaptive over uniform numbers of tetrahedra of the ball, by level."""
    count = {(p.kind, p.level): p.tets for p in points if p.name == "ball"}
    levels = sorted({level for _, level in count})
    return {level: count["adaptive", level] / count["uniform", level] for level in levels}


def ratios_by_error(points: Sequence[Point]) -> dict[float, float]:
    """Adaptive over uniform numbers of tetrahedra of the spiny body, by the uniform mesh's error [m].

    Each uniform mesh that has the spines is compared with the smallest adaptive mesh that is at least as close.
    """
    found = {}
    for mesh in (p for p in points if (p.name, p.kind) == ("spiny", "uniform") and p.error < LOST):
        enough = [p.tets for p in points if (p.name, p.kind) == ("spiny", "adaptive") and p.error <= mesh.error]
        if enough:
            found[mesh.error] = min(enough) / mesh.tets
    return found


KINDS = {"uniform": LINEAR, "adaptive": OWN_COLOR}


def draw(points: Sequence[Point], path: Path) -> None:
    """Draw tetrahedra over level for the ball, with the ratio, and over the distance for the spiny body.

    Raises:
        OSError: The picture cannot be written.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(STYLE), written_whole(path) as part:
        figure = Figure((9.0, 3.8), dpi=200)
        _draw(figure, points)
        figure.savefig(part, format="png")


def _draw(figure: Any, points: Sequence[Point]) -> None:
    left, right = (figure.add_axes((x, 0.15, 0.4, 0.62)) for x in (0.075, 0.58))
    for kind, color in KINDS.items():
        chosen = [p for p in points if p.kind == kind]
        by_level = [(p.level, p.tets) for p in chosen if p.name == "ball"]
        by_error = [(1e3 * p.error, p.tets) for p in chosen if p.name == "spiny"]
        left.semilogy([x for x, _ in by_level], [y for _, y in by_level], "o-", color=color, markersize=4, label=kind)
        right.loglog([x for x, _ in by_error], [y for _, y in by_error], "o-", color=color, markersize=4, label=kind)
        if kind == "adaptive":
            for (level, tets), ratio in zip(by_level, ratios_by_level(points).values(), strict=True):
                left.annotate(f"{ratio:.2f}", (level, tets), (8, -9), textcoords="offset points", fontsize=8, color=INK)
    left.set(xlabel="level of the surface", ylabel="tetrahedra", xticks=list(ratios_by_level(points)))
    right.set(xlabel="largest distance of the surfaces [mm]", ylabel="tetrahedra")
    right.axvline(1e3 * LOST, color=FAINT, linewidth=0.9, linestyle=(0, (4, 3)))
    right.annotate("spines lost", (1e3 * LOST, 1e3), (4, 0), textcoords="offset points", fontsize=8, color=FAINT)
    for ax, title in ((left, "a ball; numbers: adaptive over uniform"), (right, "a ball with three spines 2 cm thick")):
        ax.legend(frameon=False, fontsize=9)
        ax.set_title(title, fontsize=9.5, color=INK, loc="left")
    figure.text(0.012, 0.97, "What a surface costs in tetrahedra", fontsize=12.5, color=INK, va="top", weight="bold")


def table(points: Sequence[Point]) -> list[str]:
    """The numbers, one line for each mesh."""
    lines = [f"{'body':6} {'mesh':9} {'level':>5} {'tetrahedra':>11} {'error, mm':>10} {'seconds':>8}"]
    for p in points:
        lines.append(f"{p.name:6} {p.kind:9} {p.level:5} {p.tets:11} {1e3 * p.error:10.2f} {p.seconds:8.2f}")
    shown = ", ".join(f"level {level}: {ratio:.2f}" for level, ratio in ratios_by_level(points).items())
    lines.append(f"ball, adaptive over uniform tetrahedra: {shown}")
    shown = ", ".join(f"{1e3 * error:.2f} mm: {ratio:.3f}" for error, ratio in ratios_by_error(points).items())
    lines.append(f"spiny, adaptive over uniform tetrahedra that are as near: {shown}")
    return lines


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("-o", "--output", default="lod.png", type=Path, help="the picture")
    args = parser.parse_args(arguments)
    try:
        check_output(args.output, (".png",))
        points = study()
        print(*table(points), sep="\n")
        draw(points, args.output)
    except (InputError, OSError) as error:
        print(error, file=sys.stderr)
        return 2
    print(f"wrote {args.output}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
