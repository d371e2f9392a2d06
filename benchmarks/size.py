"""Cost of a mesh by size: time to build, memory on the device, and a step's time.

    python benchmarks/size.py [--device cuda:0] [--level 21] [--from-level 15] [--deterministic] [--json FILE]

The body is one root cube, bisected to every third level in turn, corotated with own rotations. The force is checked
against float64.
"""

from __future__ import annotations

import gc
import sys
import time
import warnings
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
import warp as wp
from measure import WRONG, Stopwatch, checked, machine, parser, save, table, tell
from problem import JITTER, MATERIAL, Sample, oracle, relative_error

import warp_corot as wc

HEADER = ["level", "tets", "nodes", "mesh s", "body s", "sim s", "B/tet", "B/node", "GB", "measured", "Gtet/s", "error"]
STEPS = 64
ROUNDS = 5
LEVELS = range(3, 29)


def device_arrays(thing: Any, seen: set[int]) -> Iterator[wp.array]:
    """All Warp arrays that an object refers to, each once."""
    if isinstance(thing, wp.array):
        if thing.ptr and thing.ptr not in seen:
            seen.add(thing.ptr)
            yield thing
        return
    if id(thing) in seen:
        return
    seen.add(id(thing))
    if isinstance(thing, list | tuple):
        parts = list(thing)
    elif isinstance(thing, dict):
        parts = list(thing.values())
    elif hasattr(thing, "_cls"):  # a Warp struct
        parts = [getattr(thing, name) for name in thing._cls.vars]
    elif is_dataclass(thing) and not isinstance(thing, type):
        parts = [getattr(thing, field.name) for field in fields(thing)]
    elif type(thing).__module__.startswith("warp_corot") and not isinstance(thing, wc.TetForest | wc.TetMesh):
        parts = list(vars(thing).values())
    else:
        return
    for part in parts:
        yield from device_arrays(part, seen)


def size(arrays: Iterator[wp.array]) -> int:
    return sum(a.capacity for a in arrays)


def used_memory(device: wp.Device) -> int | None:
    """Bytes that Warp has allocated on the device, if it can tell."""
    return wp.get_mempool_used_mem_current(device) if device.is_cuda and device.is_mempool_enabled else None


def report_of(level: int, device: wp.Device, deterministic: bool) -> dict[str, Any]:
    before = used_memory(device)
    watch = Stopwatch(device)
    started = time.perf_counter()
    mesh = wc.TetForest.box((1, 1, 1), 1.0, level)
    meshed = time.perf_counter()
    body = wc.SoftBody(mesh, wc.Isotropic(**MATERIAL), device=device)
    body.fix(mesh.points[:, 2] < 1e-9)
    wp.synchronize_device(device)
    bodied = time.perf_counter()
    sim = wc.Simulation(body, deterministic=deterministic)
    wp.synchronize_device(device)
    ready = time.perf_counter()
    after = used_memory(device)
    of_nodes = [array for array in vars(body.conditions).values() if isinstance(array, wp.array)]
    node_bytes = size(device_arrays([body.state, of_nodes], set()))
    total = size(device_arrays([body, sim.fields], set()))
    count, nodes = len(mesh.tets), len(mesh.points)
    found = {
        "level": level,
        "tets": count,
        "nodes": nodes,
        "mesh_seconds": meshed - started,
        "body_seconds": bodied - meshed,
        "simulation_seconds": ready - bodied,
        "bytes_per_tet": (total - node_bytes) / count,
        "bytes_per_node": node_bytes / nodes,
        "bytes": total,
        "measured_bytes": None if before is None or after is None else after - before,
        "error": force_error(sim),
    }
    sim.advance_steps(STEPS)
    seconds = [watch.seconds(lambda: sim.advance_steps(STEPS)) / STEPS for _ in range(ROUNDS)]
    return found | {
        "seconds_per_step": float(np.median(seconds)),
        "gtet_per_s": count / float(np.median(seconds)) / 1e9,
    }


def force_error(sim: wc.Simulation) -> float:
    """Error of the forces on a thousand nodes in a jittered state, against float64."""
    body, mesh = sim.body, sim.body.mesh
    edge = mesh.cell_size / 2 ** (int(mesh.levels[0]) // 3)
    u = np.random.default_rng(0).random((len(mesh.points), 4), np.float32)
    u -= np.float32(0.5)
    u *= np.float32(2.0 * JITTER * edge)
    sample = Sample(mesh.points, mesh.tets)
    forces = sim.fields[0].elastic_forces(wp.array(u, dtype=wp.vec4, device=body.device)).numpy()[sample.nodes, :3]
    x = mesh.points[sample.used] + u[sample.used, :3]
    mu, lam = (float(value) for value in oracle.lame(MATERIAL["young"], MATERIAL["poisson"]))
    return relative_error(forces, oracle.evaluate("corotated", sample.mesh, x, mu, lam)[1][sample.rows])


def row(found: dict[str, Any]) -> list[str]:
    measured = found["measured_bytes"]
    return [
        str(found["level"]),
        str(found["tets"]),
        str(found["nodes"]),
        *(f"{found[name]:.2f}" for name in ("mesh_seconds", "body_seconds", "simulation_seconds")),
        f"{found['bytes_per_tet']:.1f}",
        f"{found['bytes_per_node']:.0f}",
        f"{found['bytes'] / 1e9:.3f}",
        "-" if measured is None else f"{measured / 1e9:.3f}",
        f"{found['gtet_per_s']:.3g}",
        f"{found['error']:.1e}",
    ]


def main() -> int:
    of = parser(__doc__.split("\n\n")[0], "size.py")
    of.add_argument("--from-level", type=int, help="also every third level from this one on (default: --level alone)")
    of.add_argument("--deterministic", action="store_true", help="sums of forces in one order (CUDA)")
    options = of.parse_args()
    device = checked(options, of, LEVELS)
    first = options.level if options.from_level is None else options.from_level
    if not LEVELS.start <= first <= options.level:
        of.error(f"--from-level is {first}; it must be from {LEVELS.start} to --level, {options.level}")
    warnings.simplefilter("ignore", wc.StabilityWarning)
    about = machine(device)
    report_of(LEVELS.start, device, options.deterministic)  # compiles the kernels
    results = []
    for level in range(options.level, first - 1, -3)[::-1]:
        tell(f"level {level}")
        results.append(report_of(level, device, options.deterministic))
        gc.collect()
    tell("")
    print(f"{about['name']} ({device}), Warp {about['warp']}")
    print(table(HEADER, [row(found) for found in results], 1))
    if options.json is not None:
        save(options.json, {"benchmark": "size", **about, "rows": results})
    return int(any(not found["error"] <= WRONG for found in results))


if __name__ == "__main__":
    sys.exit(main())
