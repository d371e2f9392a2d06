"""Bodies, materials and motions that were not used to choose any constant of the stepping: they must pass, too.

``python tests/support/strangers.py [NAME ...]`` runs all, or those named, and prints a line for each.
"""

import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
import warp as wp

import warp_corot as wc

#: Sampling interval of a run [s], and its start: before, hardly anything has moved for comparison.
EVERY, FIRST = 0.04, 0.1
#: Energy may exceed the initial one, or that when supports came to rest, by this fraction of the largest energy from
#: gravity, loads or the beginning.
SURPLUS = 0.01

# --- shapes -----------------------------------------------------------------------------------------------------------


def smooth_union(*distances, width=0.01):
    """Signed distances joined with a fillet of about this width [m]."""
    joined = -width * np.log(sum(np.exp(-np.asarray(d) / width) for d in distances))
    return joined


def ball(x, centre, radius):
    return np.linalg.norm(x - np.array(centre), axis=1) - radius


def rod(x, a, b, radius):
    a, b = np.array(a), np.array(b)
    s = np.clip((x - a) @ (b - a) / np.dot(b - a, b - a), 0.0, 1.0)
    return np.linalg.norm(x - a - s[:, None] * (b - a), axis=1) - radius


def liver(x):
    return smooth_union(
        ball(x, (0.03, 0, 0), 0.045), ball(x, (-0.03, 0.01, 0), 0.03), ball(x, (0, 0.02, 0.03), 0.025), width=0.012
    )


def kidney(x):
    bent = smooth_union(
        rod(x, (0, -0.03, 0), (0.01, 0, 0), 0.02), rod(x, (0.01, 0, 0), (0, 0.03, 0), 0.02), width=0.006
    )
    return np.maximum(bent, -ball(x, (-0.022, 0, 0), 0.014))


def stomach(x):
    return smooth_union(rod(x, (0, -0.05, 0), (0.02, 0, 0), 0.018), rod(x, (0.02, 0, 0), (-0.03, 0.03, 0), 0.028))


def hollow(x):
    return np.abs(np.linalg.norm(x, axis=1) - 0.045) - 0.008


def gyroid(x):
    a, b, c = (2 * np.pi * x / 0.08).T
    sheet = np.sin(a) * np.cos(b) + np.sin(b) * np.cos(c) + np.sin(c) * np.cos(a)
    return np.maximum(np.abs(sheet) * 0.08 / (2 * np.pi * 1.5) - 0.006, np.abs(x).max(axis=1) - 0.04)


def hand(x):
    fingers = [rod(x, (0.012 * k, 0.03, 0), (0.017 * k, 0.08 - 0.004 * k * k, 0), 0.007) for k in (-2, -1, 0, 1, 2)]
    return smooth_union(rod(x, (-0.015, 0, 0), (0.015, 0, 0), 0.022), *fingers, width=0.004)


@cache
def organ(function, elements):
    """An adaptive mesh with about this many elements."""
    domain = wc.Domain.from_function(function, [[-0.1] * 3, [0.1] * 3], device="cpu")
    return wc.TetForest.from_domain(domain, 0.05, max_level=9, target_elements=elements, device="cpu")


def disk():
    """A disk 80 mm across, 4 mm thick: three cubes of the thickness contain a path from one face to the other."""
    x = np.linspace(-0.04, 0.04, 21)
    centres = np.stack(np.meshgrid(x, x, [0.0], indexing="ij"), -1).reshape(-1, 3)
    inside = (np.linalg.norm(centres, axis=1) < 0.04).reshape(21, 21, 1)
    box = wc.TetForest.box((21, 21, 1), 0.004, level=0, origin=(-0.042, -0.042, -0.002))
    kept = inside.ravel()[cube_of(box, 0.004, (21, 21, 1))]
    return wc.TetMesh(box.points, box.tets[kept])


def cube_of(mesh, size, counts):
    at = ((mesh.points[mesh.tets].mean(axis=1) - mesh.points.min(axis=0)) // size).astype(int)
    return np.ravel_multi_index(tuple(at.T), counts)


# --- bodies -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Stranger:
    """A body and its motion.

    Attributes:
        name: Short name.
        make: Makes the simulation.
        seconds: Duration of the run.
        rests: Time when its supports come to rest [s].
    """

    name: str
    make: Callable
    seconds: float = 1.0
    rests: float = 0.0

    def __str__(self):
        return self.name


def lowest(mesh, axis=1, share=0.1):
    heights = mesh.points[:, axis]
    return heights < heights.min() + share * np.ptp(heights)


def highest(mesh, axis=1, share=0.1):
    heights = mesh.points[:, axis]
    return heights > heights.max() - share * np.ptp(heights)


def simulated(mesh, material, device, *, held=lowest, law=None, damping=0.0, act=None, **options):
    body = wc.SoftBody(mesh, material, device=device)
    if held is not None:
        body.fix(held(mesh))
    if act is not None:
        act(body)
    return wc.Simulation(body, model=law, integrator=wc.SymplecticEuler(damping=damping), **options)


def soft(young, poisson=0.45, density=1000.0):
    return wc.Isotropic(young, poisson, density)


def layered(x):
    return 2e3 * np.where(x[:, 1] > 0.0, 1000.0, 1.0)


def thrown(speed):
    def act(body):
        free = ~body.constrained[:, None]
        body.velocities = np.broadcast_to([0.0, -speed, 0.0], (body.node_count, 3)) * free

    return act


def shaken(body):
    """The top moves back and forth by 2 cm five times in half a second."""
    times = np.linspace(0.0, 0.5, 41)
    moved = np.zeros((41, 3))
    moved[:, 0] = 0.02 * np.sin(2 * np.pi * 10 * times)
    body.prescribe(highest(body.mesh), times=times, displacements=moved)


def twisted(body):
    """The top turns by pi in a second."""
    nodes = np.flatnonzero(highest(body.mesh))
    points = body.mesh.points[nodes]
    centre = points.mean(axis=0)
    times = np.linspace(0.0, 1.0, 33)
    frames = []
    for turn in np.pi * times:
        c, s = np.cos(turn), np.sin(turn)
        x, z = (points - centre)[:, 0], (points - centre)[:, 2]
        frames.append(np.stack([c * x + s * z - x, 0 * x, c * z - s * x - z], axis=1))
    body.prescribe(nodes, times=times, displacements=np.array(frames))


def beam(cells=(1, 3, 1), size=0.04, level=3):
    return wc.TetForest.box(cells, size, level)


STRANGERS = [
    Stranger("liver", lambda d: simulated(organ(liver, 2000), soft(3e3), d)),
    Stranger("liver, light", lambda d: simulated(organ(liver, 2000), soft(1e3, density=300.0), d, law=wc.NeoHookean())),
    Stranger("kidney, nu 0.49", lambda d: simulated(organ(kidney, 1500), soft(4e3, 0.49), d)),
    Stranger("kidney, heavy", lambda d: simulated(organ(kidney, 1500), soft(6e3, density=3000.0), d)),
    Stranger("stomach", lambda d: simulated(organ(stomach, 2000), soft(2e3), d, law=wc.NeoHookean())),
    Stranger("stomach on its side", lambda d: simulated(organ(stomach, 2000), soft(5e3), d, gravity=(9.81, 0, 3.0))),
    Stranger("hollow sphere", lambda d: simulated(organ(hollow, 2500), soft(8e3), d)),
    Stranger("hollow sphere, nu 0.3", lambda d: simulated(organ(hollow, 2500), soft(3e3, 0.3), d, law=wc.NeoHookean())),
    Stranger("gyroid", lambda d: simulated(organ(gyroid, 3000), soft(2e4), d)),
    Stranger("hand", lambda d: simulated(organ(hand, 2500), soft(1e4), d, gravity=(0, 0, -9.81))),
    Stranger("hand on Jupiter", lambda d: simulated(organ(hand, 2500), soft(2e4), d, gravity=(0, 0, -24.8))),
    Stranger(
        "rod of 100 to 1", lambda d: simulated(beam((1, 100, 1), 0.004, 0), soft(1e6), d, gravity=(9.81, 0, 0)), 2.0
    ),
    Stranger("disk", lambda d: simulated(disk(), soft(5e4), d, held=lambda m: lowest(m, 0))),
    Stranger(
        "disk, neo-Hookean", lambda d: simulated(disk(), soft(2e4), d, held=lambda m: lowest(m, 0), law=wc.NeoHookean())
    ),
    Stranger(
        "modulus jump of 1000",
        lambda d: simulated(organ(liver, 2000), wc.Isotropic(layered, 0.45, 1000.0), d),
    ),
    Stranger(
        "modulus jump of 1000, neo-Hookean",
        lambda d: simulated(organ(stomach, 1500), wc.Isotropic(layered, 0.45, 1000.0), d, law=wc.NeoHookean()),
    ),
    Stranger("shaken", lambda d: simulated(beam(), soft(1e4), d, act=shaken), rests=0.5),
    Stranger(
        "shaken, neo-Hookean", lambda d: simulated(beam(), soft(3e3), d, act=shaken, law=wc.NeoHookean()), rests=0.5
    ),
    Stranger("thrown at 5 m/s", lambda d: simulated(organ(liver, 1500), soft(2e4), d, act=thrown(5.0))),
    Stranger(
        "thrown at 5 m/s, neo-Hookean",
        lambda d: simulated(beam(level=5), soft(1e4), d, act=thrown(5.0), law=wc.NeoHookean()),
    ),
    Stranger("twisted", lambda d: simulated(beam(level=5), soft(5e3), d, act=twisted, gravity=(0, 0, 0)), 1.5, 1.0),
    Stranger(
        "twisted, neo-Hookean",
        lambda d: simulated(beam(level=5), soft(5e3), d, act=twisted, gravity=(0, 0, 0), law=wc.NeoHookean()),
        1.5,
        1.0,
    ),
    Stranger(
        "remeshed",
        lambda d: simulated(
            beam(level=4), soft(5e3), d, gravity=(9.81, 0, 0), damping=2.0, remesh=wc.OnlineRemesh(max_level=6)
        ),
    ),
]

# --- what must hold ---------------------------------------------------------------------------------------------------


@dataclass
class Run:
    """The result of a run: the largest surplus of energy as a fraction of the supplied one, steps, and the error."""

    surplus: float = -np.inf
    given: float = 0.0
    steps: int = 0
    seconds: float = 0.0
    said: int = 0
    error: str = ""


def energy(sim):
    """Energy of free nodes, at the time of the positions: velocities belong to half a step before [J]."""
    body = sim.body
    free, masses = ~body.constrained, body.masses
    gravity = np.array(sim.gravity)
    forces = sim.forces().numpy().astype(float)
    later = body.velocities.numpy() + 0.5 * sim.pace.dt * (forces / np.maximum(masses, 1e-30)[:, None] + gravity)
    kinetic = 0.5 * float(masses[free] @ np.einsum("ni,ni->n", later, later)[free])
    moved = body.displacements.numpy().astype(float)
    height = -float(masses[free] @ (body.rest_positions + moved)[free] @ gravity)
    return kinetic, sim.energy().elastic, height


def run(stranger, device="cpu", seconds=None):
    seconds = stranger.seconds if seconds is None else seconds
    found, started = Run(), time.perf_counter()
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        sim = stranger.make(device)
        kinetic, elastic, first = energy(sim)
        start, found.given = kinetic + elastic + first, kinetic + elastic
        has_rested = stranger.rests == 0.0
        try:
            for number in range(1, round(seconds / EVERY) + 1):
                sim.advance_until(number * EVERY)
                kinetic, elastic, height = energy(sim)
                found.given = max(found.given, abs(first - height), 0.0 if has_rested else kinetic + elastic)
                if not has_rested:
                    has_rested, start = sim.time >= stranger.rests, kinetic + elastic + height
                elif sim.time >= FIRST:
                    found.surplus = max(found.surplus, (kinetic + elastic + height - start) / found.given)
        except wc.UnstableError as error:
            found.error = str(error)
    found.said = sum(issubclass(each.category, wc.StabilityWarning) for each in said)
    found.steps, found.seconds = sim.steps, time.perf_counter() - started
    return found


def violations(found):
    """The violated checks, one line each."""
    said = [f"ended: {found.error}"] if found.error else []
    if not found.surplus <= SURPLUS:
        said.append(f"energy {found.surplus:.2%} of {found.given:.3g} J more than was given")
    return said


def main():
    wp.config.log_level = wp.LOG_ERROR
    names = sys.argv[1:]
    for stranger in STRANGERS:
        if not names or stranger.name in names:
            found = run(stranger)
            said = "; ".join(violations(found)) or "all laws hold"
            went = ", went back" if found.said else ""
            print(
                f"{stranger}: {found.steps} steps, {found.seconds:.1f} s, surplus {found.surplus:+.4f}{went}: {said}",
                flush=True,
            )


if __name__ == "__main__":
    main()
