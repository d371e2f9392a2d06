"""How well meshes approximate their bodies: every triangle mesh and scan that comes with Warp, PyVista, nilearn, Newton
and MuJoCo (``body_files.py``), and deliberately difficult shapes (``body_shapes.py``).

Each body is meshed as by ``warp-corot simulate BODY --tets N``, in a separate process with limits on time and memory,
so that a body that hangs or exhausts memory does not end the table:

    python benchmarks/bodies.py                           all of them, at 20,000 elements
    python benchmarks/bodies.py knot sheet pyvista/       those whose names contain one of these words
    python benchmarks/bodies.py --fall                    and each with defaults for 2 s: does it topple?
    python benchmarks/bodies.py -o after.md --json after.json --before before.json

With ``--together`` one process measures all meshes. It loads libraries only once, but does not limit the time.

Falls have 5,000 elements (``--fall-tets``). Numbers already in the ``--json`` file stay there unless a run
finds them again, so ``--no-mesh --fall`` adds the falls and ``--no-mesh -o table.md`` only writes the table.

It needs ``pip install "warp-corot[surface,scans,vti,mesh]" pyvista nilearn newton mujoco``; the table leaves out
bodies of packages that are missing. A legend above the table explains the columns.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

from bodies_table import Row, table, totals
from body_files import Body, all_bodies, as_input

TETS, FALL_TETS = 20_000, 5_000
SECONDS, GIGABYTES = 300.0, 8.0
#: Results of a fall; all others belong to the mesh.
FALL = ("fall", "fall_failed", "free", "held", "fall_notes")


def limited(gigabytes: float) -> None:
    """Limit the memory of this process."""
    import resource

    size = int(gigabytes * 2**30)
    resource.setrlimit(resource.RLIMIT_DATA, (size, size))


def run_one(options: argparse.Namespace) -> int:
    """Measure one body in this process and print the results, a line of JSON for the mesh and one for the fall."""
    from body_runs import fallen, measured

    limited(options.gigabytes)
    body = Body(options.one, options.path)
    with tempfile.TemporaryDirectory() as folder:
        path, given = as_input(body, Path(folder))
        found: dict[str, Any] = {}
        if not options.no_mesh:
            found = measured(path, given, options.tets, options.device)
            print("\n" + json.dumps(found), flush=True)
        if options.fall and (options.no_mesh or {"elements", "tets"} & found.keys()):
            found = fallen(path, given, options.fall_tets, options.device, options.previews)
            print("\n" + json.dumps(found), flush=True)
    return 0


def together(body: Body, options: argparse.Namespace) -> dict[str, Any]:
    """The results for the mesh of a body from this process."""
    from body_runs import measured

    with tempfile.TemporaryDirectory() as folder:
        try:
            path, given = as_input(body, Path(folder))
            return measured(path, given, options.tets, options.device)
        except Exception as error:
            return {"failed": f"{type(error).__name__}: {error}"[:200]}


def in_process(body: Body, options: argparse.Namespace) -> dict[str, Any]:
    """The results for a body from a separate process, and how it ended if it failed."""
    command = [sys.executable, __file__, "--one", body.name, "--tets", str(options.tets), "--device", options.device]
    command += ["--gigabytes", str(options.gigabytes), "--fall-tets", str(options.fall_tets)]
    for name in ("path", "previews"):
        value = body.path if name == "path" else options.previews
        command += [f"--{name}", str(value)] if value else []
    command += [f"--{name.replace('_', '-')}" for name in ("fall", "no_mesh") if getattr(options, name)]
    why = ""
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=options.seconds, env=os.environ)
        printed = done.stdout
        if done.returncode:
            why = (done.stderr.strip().splitlines() or [f"ended with status {done.returncode}"])[-1][:200]
    except subprocess.TimeoutExpired as late:
        printed, why = (late.stdout or b"").decode(), f"takes more than {options.seconds:g} s"
    found: dict[str, Any] = {}
    for line in printed.splitlines():
        found |= json.loads(line) if line.startswith("{") else {}
    if why:
        found["fall_failed" if options.no_mesh or found else "failed"] = why
    return found


def found_of(body: Body, earlier: dict[str, Any], options: argparse.Namespace) -> dict[str, Any]:
    """The new results for a body, with the earlier ones that were not measured again."""
    kept = {name: value for name, value in earlier.items() if (not options.fall if name in FALL else options.no_mesh)}
    if options.no_mesh and not (options.fall and {"elements", "tets"} & earlier.keys()):
        return kept
    return kept | (together if options.together else in_process)(body, options)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("words", nargs="*", help="only bodies whose names contain one of these")
    parser.add_argument("--tets", type=int, default=TETS, help=f"number of elements (default: {TETS})")
    parser.add_argument("--fall", action="store_true", help="also let each fall with defaults for 2 s")
    parser.add_argument("--fall-tets", type=int, default=FALL_TETS, help=f"elements of falls (default: {FALL_TETS})")
    parser.add_argument("--no-mesh", action="store_true", help="keep the results of meshes in --json")
    parser.add_argument("--together", action="store_true", help="one process for all meshes, without falls")
    parser.add_argument("--previews", type=Path, help="a folder for pictures of the first and last frame of each fall")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="time limit for a body (default: 300)")
    parser.add_argument("--gigabytes", type=float, default=GIGABYTES, help="memory limit for a body (default: 8)")
    parser.add_argument("-o", "--output", type=Path, help="Markdown file for the table (default: printed at the end)")
    parser.add_argument("--json", type=Path, help="also write the numbers")
    parser.add_argument("--before", type=Path, help="numbers of an earlier run for comparison")
    parser.add_argument("--list", action="store_true", help="name the bodies and stop")
    parser.add_argument("--new", action="store_true", help="only bodies that --json does not have")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    parser.add_argument("--path", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        return run_one(options)
    chosen = [b for b in all_bodies() if not options.words or any(word in b.name for word in options.words)]
    if options.list or not chosen:
        print("\n".join(body.name for body in chosen) or "no body has such a name")
        return 0 if chosen else 2
    numbers = json.loads(options.json.read_text()) if options.json and options.json.exists() else {}
    waiting = [body for body in chosen if not (options.new and body.name in numbers)]
    for index, body in enumerate(waiting):
        print(f"{index + 1} of {len(waiting)}: {body.name}", end=" ", file=sys.stderr, flush=True)
        started = time.perf_counter()
        numbers[body.name] = found_of(body, numbers.get(body.name, {}), options)
        print(f"({time.perf_counter() - started:.0f} s)", file=sys.stderr, flush=True)
        if options.json:
            options.json.write_text(json.dumps(numbers, indent=1), encoding="utf-8")
    rows = [Row(body.name, numbers[body.name]) for body in chosen]
    before = json.loads(options.before.read_text(encoding="utf-8")) if options.before else None
    text = f"{totals(rows, options.tets)}\n\n{table(rows, before)}\n"
    if options.output:
        options.output.write_text(text, encoding="utf-8")
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
