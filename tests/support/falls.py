"""Checks of soft bodies that fall, swing and are shaken: energy from gravity and supports only, and no position out of
reach. ``STRANGERS`` are bodies, materials and motions that were not used to choose any constant of the stepping.

``python tests/support/falls.py`` runs all bodies of ``loaded`` and all strangers, and prints a line for each.
"""

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache

import numpy as np
import warp as wp
from loaded import DENSITY, DOZEN, FEW, GRAVITY, LONG, MANY, SHORT, THIRTY

import warp_corot as wc

#: Interval of the checks [s].
EVERY = 0.05
#: How far waves may push part of a body ahead of a fall, as a fraction of its length.
AHEAD = 0.1
#: E_kin + E_el may exceed what was given by this fraction of the largest energy given so far. The scheme keeps the
#: energy of a mode omega to (omega dt)^2 / 4, and fast modes hold little of it: runs with a fifth of the stable step at
#: rest stay below 0.008, and those that hardly deform below 0.004 with four fifths of it.
SURPLUS = 0.01


@dataclass
class Fall:
    """A run, sampled every EVERY seconds.

    Attributes:
        length: The body's largest extent [m]; softness: its weight's pressure over Young's modulus, rho g length / E.
            None: how far the body may move is not known.
        lengthens: Whether rotation alone makes it longer, as in linear elasticity.
        begins: Time when supports come to rest [s]; energy is compared with that of the first sample from then on.
        times: Times [s].
        kinetic, elastic: Energies; dropped: potential energy lost since the start [J].
        farthest: Largest displacement of any node [m].
        error: The error that ended the run early, if any.
        elements, steps, seconds: Numbers of elements and of steps, and wall time of the steps.
    """

    length: float | None = None
    softness: float = 0.0
    lengthens: bool = False
    begins: float = 0.0
    times: list = field(default_factory=list)
    kinetic: list = field(default_factory=list)
    elastic: list = field(default_factory=list)
    dropped: list = field(default_factory=list)
    farthest: list = field(default_factory=list)
    error: str = ""
    elements: int = 0
    steps: int = 0
    seconds: float = 0.0

    @property
    def reach(self):
        """Maximum displacements of a falling body [m], at each time.

        The tip of a rod that turns about its end falls with 3/2 g, of a cone that turns about its base with 5/2 g;
        waves that meet may push it ahead slightly. A body may come to hang below its support, which moves its far
        end by twice the length, and stretch: statically by at most rho g L^2 / (2 E / 3) (the stiffness of long
        neo-Hookean bodies falls to E / 3), and twice that during the swing. Linear bodies lengthen as they turn: only
        the first bound applies to them.
        """
        t = np.array(self.times)
        if self.length is None:
            return np.full(len(t), np.inf)
        falling = 2.5 * 0.5 * GRAVITY * t**2 + AHEAD * self.length
        hanging = self.length * (2.0 + 3.0 * self.softness)
        return falling if self.lengthens else np.minimum(falling, hanging)

    def look(self, sim, first):
        """Sample the current state; ``first`` is the body's initial height times its weight [J]."""
        body, gravity = sim.body, np.array(sim.gravity)
        masses = body.masses[:, None] * ~body.constrained[:, None]
        with np.errstate(all="ignore"):  # squares of diverged values
            moved = body.displacements.numpy().astype(float)
            # Velocities belong to half a step before the positions.
            forces = sim.forces().numpy().astype(float) / np.maximum(body.masses[:, None], 1e-30)
            later = body.velocities.numpy() + 0.5 * sim.pace.dt * (forces + gravity)
            self.times.append(sim.time)
            self.kinetic.append(0.5 * float(np.sum(masses * later**2)))
            self.elastic.append(sim.energy().elastic)
            self.dropped.append(height(body, gravity) - first)
            self.farthest.append(float(np.linalg.norm(moved, axis=1).max()))


def height(body, gravity):
    """What gravity has done on the free nodes since they were at the origin [J]."""
    places = body.rest_positions + body.displacements.numpy().astype(float)
    return float((body.masses * ~body.constrained) @ places @ gravity)


def fall(case, seconds, count, device="cpu", dt=None):
    """Run a case; errors are recorded, not raised."""
    sim = case.simulation(count, device, dt)
    found = Fall(begins=getattr(case, "rests", 0.0), elements=sim.body.element_count)
    if not isinstance(case, Stranger):
        points = sim.body.mesh.points
        found.length = float(np.ptp(points[np.unique(sim.body.mesh.tets)], axis=0).max())
        found.softness = DENSITY * GRAVITY * found.length / (1e3 * case.kilopascals)
        found.lengthens = case.law == "linear"
    first, started = height(sim.body, np.array(sim.gravity)), time.perf_counter()
    try:
        found.look(sim, first)
        for number in range(1, round(seconds / EVERY) + 1):
            sim.advance_until(number * EVERY)
            found.look(sim, first)
    except wc.UnstableError as error:
        found.error = str(error)
    found.steps, found.seconds = sim.steps, time.perf_counter() - started
    return found


def violations(found):
    """The violated checks, one line each; empty if there are none."""
    said = []
    numbers = np.array([found.kinetic, found.elastic, found.dropped, found.farthest])
    finite = np.isfinite(numbers).all(axis=0)
    if found.error:
        said.append(f"ended: {found.error}")
    if not finite.all():
        said.append(f"not finite at {found.times[np.argmin(finite)]:.2f} s")
    if len(found.times) and finite.all():
        kinetic, elastic, dropped, farthest = numbers
        held = kinetic + elastic
        start = int(np.searchsorted(found.times, found.begins - 1e-9))
        gained, fallen = held - held[start], dropped - dropped[start]
        given = np.maximum.accumulate(np.abs(dropped)) + held[: start + 1].max()
        much = (gained > fallen + SURPLUS * given) & (np.arange(len(held)) > start)
        if much.any():
            worst = np.argmax(much)
            said.append(f"energy {gained[worst]:.3g} J of {fallen[worst]:.3g} J at {found.times[worst]:.2f} s")
        far = farthest > found.reach
        if far.any():
            worst = np.argmax(far)
            said.append(
                f"a node moved {farthest[worst]:.3g} m by {found.times[worst]:.2f} s, beyond {found.reach[worst]:.3g}"
            )
    return said


# --- strangers --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Stranger:
    """A body and its motion.

    Attributes:
        name: Short name.
        mesh: Makes its mesh, of about so many elements.
        young, poisson, density: Of its material.
        law: Its law.
        axis: The axis along which its lowest tenth is held.
        act: What is done to the body before it is released.
        gravity: [m/s^2].
        options: Further options of its simulation.
        rests: Time when its supports come to rest [s].
    """

    name: str
    mesh: Callable
    young: float | Callable
    poisson: float = 0.45
    density: float = 1000.0
    law: object = None
    axis: int = 1
    act: Callable = lambda body: None
    gravity: tuple = (0.0, -GRAVITY, 0.0)
    options: Callable = dict
    rests: float = 0.0

    def __str__(self):
        return self.name

    def simulation(self, count, device="cpu", dt=None):
        mesh = self.mesh(count)
        body = wc.SoftBody(mesh, wc.Isotropic(self.young, self.poisson, self.density), device=device)
        body.fix(~above(mesh.points, self.axis, 0.1))
        self.act(body)
        options = {"integrator": wc.SymplecticEuler(dt)} | self.options()
        return wc.Simulation(body, model=self.law, gravity=self.gravity, **options)


def above(points, axis, share):
    """The nodes above a share of the height."""
    heights = points[:, axis]
    return heights >= heights.min() + share * np.ptp(heights)


def ball(x, centre, radius):
    return np.linalg.norm(x - np.array(centre), axis=1) - radius


def rod(x, a, b, radius):
    a, b = np.array(a), np.array(b)
    s = np.clip((x - a) @ (b - a) / np.dot(b - a, b - a), 0.0, 1.0)
    return np.linalg.norm(x - a - s[:, None] * (b - a), axis=1) - radius


def smooth_union(*distances, width=0.01):
    """Signed distances joined with a fillet of about this width [m]."""
    return -width * np.log(sum(np.exp(-np.asarray(d) / width) for d in distances))


def liver(x):
    return smooth_union(
        ball(x, (0.03, 0, 0), 0.045), ball(x, (-0.03, 0.01, 0), 0.03), ball(x, (0, 0.02, 0.03), 0.025), width=0.012
    )


def hollow(x):
    return np.abs(np.linalg.norm(x, axis=1) - 0.045) - 0.008


def gyroid(x):
    a, b, c = (2 * np.pi * x / 0.08).T
    sheet = np.sin(a) * np.cos(b) + np.sin(b) * np.cos(c) + np.sin(c) * np.cos(a)
    return np.maximum(np.abs(sheet) * 0.08 / (2 * np.pi * 1.5) - 0.006, np.abs(x).max(axis=1) - 0.04)


def hand(x):
    fingers = [rod(x, (0.012 * k, 0.03, 0), (0.017 * k, 0.08 - 0.004 * k * k, 0), 0.007) for k in (-2, -1, 0, 1, 2)]
    return smooth_union(rod(x, (-0.015, 0, 0), (0.015, 0, 0), 0.022), *fingers, width=0.004)


def organ(function):
    """Makes adaptive meshes of a shape."""

    @cache
    def make(count):
        domain = wc.Domain.from_function(function, [[-0.1] * 3, [0.1] * 3], device="cpu")
        return wc.TetForest.from_domain(domain, 0.05, max_level=9, target_elements=count, device="cpu")

    return make


def beam(level=3, cells=(1, 3, 1), size=0.04):
    return lambda count: wc.TetForest.box(cells, size, level)


def layered(x):
    return 2e3 * np.where(x[:, 1] > 0.0, 1000.0, 1.0)


def thrown(body):
    free = ~body.constrained[:, None]
    body.velocities = np.broadcast_to([0.0, -5.0, 0.0], (body.node_count, 3)) * free


def shaken(body):
    """The top moves back and forth by 2 cm five times in half a second."""
    times = np.linspace(0.0, 0.5, 41)
    moved = np.outer(0.02 * np.sin(2 * np.pi * 10 * times), [1.0, 0.0, 0.0])
    body.prescribe(above(body.mesh.points, 1, 0.9), times=times, displacements=moved)


def twisted(body):
    """The top turns by pi in a second."""
    nodes, times = np.flatnonzero(above(body.mesh.points, 1, 0.9)), np.linspace(0.0, 1.0, 33)
    x, _, z = (body.mesh.points[nodes] - body.mesh.points[nodes].mean(axis=0)).T
    turns = [(np.cos(turn), np.sin(turn)) for turn in np.pi * times]
    frames = [np.stack([c * x + s * z - x, 0 * x, c * z - s * x - z], axis=1) for c, s in turns]
    body.prescribe(nodes, times=times, displacements=np.array(frames))


def remeshed():
    return {"integrator": wc.SymplecticEuler(damping=2.0), "remesh": wc.OnlineRemesh(max_level=6)}


NEO, NONE, ASIDE = wc.NeoHookean(), (0.0, 0.0, 0.0), (GRAVITY, 0.0, 0.0)
STRANGERS = [
    Stranger("liver", organ(liver), 3e3),
    Stranger("liver, light", organ(liver), 1e3, density=300.0, law=NEO),
    Stranger("liver, nu 0.49", organ(liver), 4e3, 0.49),
    Stranger("liver, thrown", organ(liver), 2e4, act=thrown),
    Stranger("liver, modulus jump of 1000", organ(liver), layered),
    Stranger("hollow sphere", organ(hollow), 8e3),
    Stranger("hollow sphere, nu 0.3", organ(hollow), 3e3, 0.3, law=NEO),
    Stranger("gyroid", organ(gyroid), 2e4),
    Stranger("hand on Jupiter", organ(hand), 2e4, gravity=(0.0, 0.0, -24.8)),
    Stranger("rod of 100 to 1", beam(0, (1, 100, 1), 0.004), 1e6, gravity=ASIDE),
    Stranger("shaken, neo-Hookean", beam(), 3e3, act=shaken, law=NEO, rests=0.5),
    Stranger("thrown, neo-Hookean", beam(5), 1e4, act=thrown, law=NEO),
    Stranger("twisted", beam(5), 5e3, act=twisted, gravity=NONE, rests=1.0),
    Stranger("twisted, neo-Hookean", beam(5), 5e3, act=twisted, gravity=NONE, law=NEO, rests=1.0),
    Stranger("remeshed", beam(4), 5e3, gravity=ASIDE, options=remeshed),
]


def main():
    """``[--short] [DEVICE]``: a line for each body."""
    wp.config.log_level = wp.LOG_ERROR
    names = [word for word in sys.argv[1:] if not word.startswith("--")]
    short = "--short" in sys.argv
    for case in [*(DOZEN if short else THIRTY), *STRANGERS]:
        found = fall(case, SHORT if short else LONG, FEW if short else MANY, *names)
        said = "; ".join(violations(found)) or "all laws hold"
        print(f"{case}: {found.elements} elements, {found.steps} steps, {found.seconds:.1f} s: {said}", flush=True)


if __name__ == "__main__":
    main()
