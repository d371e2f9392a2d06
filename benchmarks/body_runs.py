"""Measurements of one body for ``bodies.py``, in a separate process: the fidelity of its mesh, and its fall."""

from __future__ import annotations

import contextlib
import functools
import io
import tempfile
import time
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from warp_corot.domain.fidelity import Fidelity

FALL_SECONDS = 2.0


def measured(path: Path, options: list[str], tets: int, device: str) -> dict[str, Any]:
    """The results of meshing for ``bodies_table.Row``.

    Args:
        path: Its file.
        options: Options of the command line.
        tets: Number of elements.
        device: The device for meshing.
    """
    import warp as wp

    from warp_corot.cli import make_parser
    from warp_corot.cli.input_file import bodies_in, open_input
    from warp_corot.cli.input_mesh import find_organ
    from warp_corot.errors import InputError
    from warp_corot.io.read.meshes import load_tets

    wp.config.log_level = wp.LOG_ERROR
    line = ["simulate", str(path), "-o", "out.usd", "--tets", str(tets), "--device", device, *options]
    _load_kernels(device)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            args = make_parser().parse_args(line)
            wall, cpu, own = time.perf_counter(), time.process_time(), time.thread_time()
            opened = open_input(str(path))
            if opened.kind == "tets":
                return {"tets": len(load_tets(path).cells)}
            subjects = [find_organ(part, own) for part, own in bodies_in(opened, args)]
            seconds, cpu_seconds = time.perf_counter() - wall, time.process_time() - cpu
            own_seconds = time.thread_time() - own
        except InputError as error:
            return {"refused": str(error)}
    size = float(np.ptp(np.concatenate([s.domain.bounds for s in subjects]), axis=0).max())
    return {
        **together([subject.fidelity for subject in subjects], size, tets),
        "bodies": len(subjects),
        "size": size,
        "seconds": seconds,
        "cpu_seconds": cpu_seconds,
        "own_seconds": own_seconds,
        "times": {stage: sum(s.times[stage] for s in subjects) for stage in subjects[0].times},
        "notes": [*(note for s in subjects for note in s.notes), *(str(warning.message) for warning in said)],
        "doubts": [doubt for s in subjects for doubt in s.fidelity.doubts()],
    }


def together(found: list[Fidelity], size: float, tets: int) -> dict[str, Any]:
    """Several bodies of one file as one: sums, and the largest distances, relative to the size [m]."""
    return {
        "elements": (elements := sum(f.elements for f in found)),
        "share": elements / tets,
        "volume": sum(f.volume for f in found) / sum(f.input_volume for f in found),
        "mean": [max(f.distance_mean[way] for f in found) / size for way in (0, 1)],
        "far": [max(f.distance_95[way] for f in found) / size for way in (0, 1)],
        "pieces": sum(f.pieces for f in found),
        "input_pieces": sum(f.input_pieces for f in found),
        "lost_pieces": sum(f.lost_pieces for f in found),
        "lost_labels": sum(len(f.lost_labels) for f in found),
        "watertight": all(f.watertight for f in found),
        "dihedral": min(f.smallest_dihedral for f in found),
    }


@functools.cache
def _load_kernels(device: str) -> None:
    """Mesh a small ball in the same way, to load kernels and libraries."""
    import trimesh

    from warp_corot.cli import make_parser
    from warp_corot.cli.input_file import open_input
    from warp_corot.cli.input_mesh import find_organ

    with warnings.catch_warnings(), tempfile.TemporaryDirectory() as folder:
        warnings.simplefilter("ignore")
        path = Path(folder) / "warm.ply"
        trimesh.creation.icosphere(3, radius=0.1).export(path)
        line = ["simulate", str(path), "-o", "warm.usd", "--tets", "500", "--unit", "m", "--device", device]
        find_organ(open_input(str(path)), make_parser().parse_args(line))


def fallen(path: Path, options: list[str], tets: int, device: str, previews: Path | None = None) -> dict[str, Any]:
    """The fall of a body with defaults: its displacement over its height, and whether the command called it free.

    Args:
        path: Its file.
        options: Options of the command line.
        tets: Number of elements.
        device: The device of the simulation.
        previews: A folder for a picture of the first and last frame; None: no picture.
    """
    from warp_corot.cli import main

    folder = tempfile.TemporaryDirectory()
    out, said = Path(folder.name) / "fall.usd", io.StringIO()
    line = ["simulate", str(path), "-o", str(out), "--duration", str(FALL_SECONDS), "--device", device, *options]
    if not _has_tets(path):
        line += ["--tets", str(tets)]
    if previews is not None:
        picture = previews.resolve() / f"{path.name}.png"
        line += ["--preview", str(picture), "--preview-frames", "0,-1"]
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        status = main(line)
    text = said.getvalue()
    if status or not out.exists():
        return {"fall_failed": text.strip().splitlines()[-1][:200] if text.strip() else f"status {status}"}
    held = [line.split(None, 1)[1] for line in text.splitlines() if line.startswith("  fixed")]
    notes = [line for line in text.splitlines() if line.startswith("warp-corot: ")]
    with folder:
        fall = largest_displacement(out)
    return {"fall": fall, "free": "nothing is held" in text, "held": held, "fall_notes": notes}


def largest_displacement(path: Path) -> float:
    """The largest displacement of any drawn point, over the height of the whole drawing."""
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(path))
    up = "XYZ".index(UsdGeom.GetStageUpAxis(stage))
    largest, low, high = 0.0, np.inf, -np.inf
    for prim in stage.Traverse():
        points = UsdGeom.PointBased(prim).GetPointsAttr() if prim.IsA(UsdGeom.PointBased) else None
        if not points or points.GetNumTimeSamples() < 2:
            continue
        codes = points.GetTimeSamples()
        first = np.array(points.Get(codes[0]))
        low, high = min(low, first[:, up].min()), max(high, first[:, up].max())
        largest = max(largest, *(float(np.linalg.norm(np.array(points.Get(c)) - first, axis=1).max()) for c in codes))
    return float(largest / (high - low))


def _has_tets(path: Path) -> bool:
    from warp_corot.cli.input_file import open_input

    return open_input(str(path)).kind == "tets"
