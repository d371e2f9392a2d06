"""How true meshes are to their bodies: every triangle mesh and scan that installs with Warp, PyVista, nilearn, Newton
and MuJoCo, and shapes made for trouble (``body_shapes.py``).

Each body goes the way of the command line, ``warp-corot simulate BODY --tets N``, in a process of its own with limits
of time and memory, so that one that hangs or bursts does not end the table:

    python benchmarks/bodies.py                           all of them, at 20,000 elements
    python benchmarks/bodies.py knot sheet pyvista/       those whose names hold one of these words
    python benchmarks/bodies.py --tets 5000 --fall        and each by defaults for 2 s: does it topple?
    python benchmarks/bodies.py -o after.md --json after.json --before before.json

It needs ``pip install "warp-corot[surface,scans,vti,mesh]" pyvista nilearn newton mujoco``; of what is not there
nothing is in the table. Columns are explained above the table.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from bodies_table import Row, table, totals

#: Where packages keep bodies, and what is a triangle mesh or a scan there.
PACKAGES = ("warp", "pyvista", "trimesh", "nilearn", "newton", "mujoco")
SUFFIXES = (".stl", ".obj", ".ply", ".off", ".glb", ".gltf", ".usd", ".usda", ".usdc", ".msh", ".gii.gz")
SUFFIXES += (".vtk", ".vtp", ".vtu", ".vti", ".nii.gz", ".nii", ".nrrd", ".mha")
#: Values at vertices, pictures of functions, surfaces without an inside.
NO_BODIES = ("area_", "curv_", "sulc", "thick_", "flat_", "_t1_", "image_10426", "spm_dmtx")
TETS = 20_000
SECONDS, GIGABYTES = 300.0, 8.0
FALL_SECONDS = 2.0


@dataclass(frozen=True)
class Body:
    """Something to be meshed.

    Attributes:
        name: In the table.
        path: The file; None for a shape, which is written to one.
    """

    name: str
    path: Path | None = None


def packaged() -> list[Body]:
    """The files with triangles or voxels that come with packages, each once."""
    found, seen = [], set()
    for package in PACKAGES:
        spec = find_spec(package)
        for folder in (spec.submodule_search_locations or []) if spec else []:
            for path in sorted(Path(folder).rglob("*")):
                if not path.name.lower().endswith(SUFFIXES) or any(word in path.name for word in NO_BODIES):
                    continue
                digest = hashlib.sha256(path.read_bytes()).digest()
                if digest in seen or (".usd" in path.suffix and not has_faces(path)):
                    continue
                seen.add(digest)
                found.append(Body(f"{package}/{path.name}", path))
    return found


def has_faces(path: Path) -> bool:
    """Whether a stage has a Mesh prim of its own, so that it is about a shape and not about joints."""
    from pxr import Usd, UsdGeom

    try:
        stage = Usd.Stage.Open(str(path))
    except Exception:
        return False
    meshes = [UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]
    return any(len(mesh.GetFaceVertexCountsAttr().Get() or []) >= 4 for mesh in meshes)


def all_bodies() -> list[Body]:
    from body_shapes import SHAPES

    return [*packaged(), *(Body(name) for name in SHAPES)]


# --- one body, in a process of its own -------------------------------------------------------------------------------


def as_input(name: str, folder: Path) -> tuple[Path, list[str]]:
    """The file that the command line is given, and the options that a person would give with it."""
    body = next(b for b in all_bodies() if b.name == name)
    if body.path is None:
        from body_shapes import SHAPES
        from trimesh import Trimesh

        path = folder / f"{name}.ply"
        Trimesh(*SHAPES[name](), process=False).export(path)
        return path, ["--unit", "m"]
    if body.path.name.endswith(".gii.gz"):
        import nibabel
        from trimesh import Trimesh

        points, triangles = nibabel.load(body.path).agg_data(("pointset", "triangle"))
        path = folder / body.path.name.replace(".gii.gz", ".ply")
        Trimesh(points, triangles, process=False).export(path)
        return path, ["--unit", "mm"]
    if body.path.name.endswith("_converted.nii.gz"):  # probabilities from 0 to 255
        import nibabel
        import numpy as np

        image = nibabel.load(body.path)
        path = folder / body.path.name
        nibabel.save(nibabel.Nifti1Image((np.asarray(image.dataobj) > 127).astype(np.uint8), image.affine), path)
        return path, ["--unit", "mm"]
    scan = body.path.name.endswith((".nii.gz", ".nii", ".nrrd", ".mha"))
    stage = ".usd" in body.path.suffix
    return body.path, [] if scan or stage else ["--unit", "mm"]


def measured(name: str, tets: int, device: str, folder: Path) -> dict:
    """What ``bodies_table.Row`` says of a body, as far as meshing goes."""
    import warnings

    import numpy as np
    import warp as wp

    import warp_corot as wc
    from warp_corot.cli import make_parser
    from warp_corot.cli.opened import open_input
    from warp_corot.cli.organs import find_organ
    from warp_corot.domain.fidelity import fidelity
    from warp_corot.errors import InputError
    from warp_corot.io.read.tetrahedra import load_tets

    wp.config.log_level = wp.LOG_ERROR
    wc.TetForest.from_domain(wc.Domain.sphere(0.1), 0.1, max_level=3, device=device).surface()  # kernels are there
    path, options = as_input(name, folder)
    line = ["simulate", str(path), "-o", str(folder / "out.usd"), "--tets", str(tets), "--device", device, *options]
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            args = make_parser().parse_args(line)
            started = time.perf_counter()
            opened = open_input(str(path))
            if opened.kind == "tets":
                return {"tets": len(load_tets(path).tets)}
            subject = find_organ(opened, args)
            seconds = time.perf_counter() - started
        except InputError as error:
            return {"refused": str(error)}
    found = fidelity(subject.mesh, subject.domain, surface=subject.surface)
    size = float(np.ptp(subject.domain.bounds, axis=0).max())
    notes = [*subject.notes, *(str(warning.message) for warning in said)]
    return {
        "elements": found.elements,
        "share": found.elements / tets,
        "volume": found.volume / found.input_volume,
        "mean": [d / size for d in found.distance_mean],
        "far": [d / size for d in found.distance_95],
        "pieces": found.pieces,
        "input_pieces": found.input_pieces,
        "lost_pieces": found.lost_pieces,
        "lost_labels": len(found.lost_labels),
        "watertight": found.watertight,
        "dihedral": found.smallest_dihedral,
        "size": size,
        "seconds": seconds,
        "notes": notes,
        "doubts": found.doubts(),
    }


def fallen(name: str, tets: int, device: str, folder: Path) -> dict:
    """What becomes of a body by defaults: how far it goes, over its height, and whether it was said to be free."""
    import contextlib
    import io

    import numpy as np
    from pxr import Usd, UsdGeom

    from warp_corot.cli import main

    path, options = as_input(name, folder)
    out, said = folder / "fall.usd", io.StringIO()
    line = ["simulate", str(path), "-o", str(out), "--duration", str(FALL_SECONDS), "--device", device, *options]
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        status = main([*line, "--tets", str(tets)])
    text = said.getvalue()
    if status or not out.exists():
        return {"fall_failed": text.strip().splitlines()[-1][:200] if text.strip() else f"status {status}"}
    stage = Usd.Stage.Open(str(out))
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
    return {"fall": float(largest / (high - low)), "free": "free" in text.lower()}


def limited(gigabytes: float) -> None:
    """Let this process have no more memory."""
    import resource

    size = int(gigabytes * 2**30)
    resource.setrlimit(resource.RLIMIT_DATA, (size, size))


def run_one(options: argparse.Namespace) -> int:
    """Measure one body in this process and print what was found as JSON."""
    limited(options.gigabytes)
    with tempfile.TemporaryDirectory() as folder:
        work = fallen if options.fall else measured
        print("\n" + json.dumps(work(options.one, options.tets, options.device, Path(folder))), flush=True)
    return 0


# --- all of them -----------------------------------------------------------------------------------------------------


def in_process(body: Body, options: argparse.Namespace, fall: bool = False) -> dict:
    """What a process of its own found of a body, or how it ended."""
    command = [sys.executable, __file__, "--one", body.name, "--tets", str(options.tets), "--device", options.device]
    command += ["--gigabytes", str(options.gigabytes), *(["--fall"] if fall else [])]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=options.seconds, env=os.environ)
    except subprocess.TimeoutExpired:
        return {"failed": f"takes more than {options.seconds:g} s"}
    if done.returncode:
        last = (done.stderr.strip().splitlines() or [f"ended with status {done.returncode}"])[-1]
        return {"failed": last[:200]}
    return json.loads(done.stdout.strip().splitlines()[-1])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("words", nargs="*", help="only bodies whose names hold one of these")
    parser.add_argument("--tets", type=int, default=TETS, help=f"elements asked for (default: {TETS})")
    parser.add_argument("--fall", action="store_true", help="also let each fall by defaults for 2 s")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="most a body may take (default: 300)")
    parser.add_argument("--gigabytes", type=float, default=GIGABYTES, help="most memory it may take (default: 8)")
    parser.add_argument("-o", "--output", type=Path, help="Markdown file for the table (default: printed at the end)")
    parser.add_argument("--json", type=Path, help="also write the numbers")
    parser.add_argument("--before", type=Path, help="numbers of an earlier run, to stand beside")
    parser.add_argument("--list", action="store_true", help="name the bodies and stop")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        return run_one(options)
    chosen = [b for b in all_bodies() if not options.words or any(word in b.name for word in options.words)]
    if options.list or not chosen:
        print("\n".join(body.name for body in chosen) or "no body has such a name")
        return 0 if chosen else 2
    rows: list[Row] = []
    for index, body in enumerate(chosen):
        print(f"{index + 1} of {len(chosen)}: {body.name}", end=" ", file=sys.stderr, flush=True)
        started = time.perf_counter()
        found = in_process(body, options)
        if options.fall and "elements" in found:
            found |= in_process(body, options, fall=True)
        rows.append(Row.of(body.name, found))
        print(f"({time.perf_counter() - started:.0f} s)", file=sys.stderr)
        if options.json:
            options.json.write_text(json.dumps({row.name: row.found for row in rows}, indent=1))
    before = json.loads(options.before.read_text(encoding="utf-8")) if options.before else None
    text = f"{totals(rows, options.tets)}\n\n{table(rows, before, fall=options.fall)}\n"
    if options.output:
        options.output.write_text(text)
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
