"""Checks of falling and swinging soft bodies: energy only from gravity, and no position out of reach.

``python tests/support/falls.py`` runs all bodies of ``loaded`` for 2 s each and prints a line for each.
"""

import sys
import time
from dataclasses import dataclass, field

import numpy as np
import warp as wp
from loaded import DENSITY, DOZEN, FEW, GRAVITY, LONG, MANY, SHORT, THIRTY

import warp_corot as wc

#: Interval of the checks [s].
EVERY = 0.05


@dataclass
class Fall:
    """A run, sampled every EVERY seconds.

    Attributes:
        elements: Number of elements.
        length: The body's largest extent [m]; softness: its weight's pressure over Young's modulus, rho g length / E.
        lengthens: Whether rotation alone makes it longer, as in linear elasticity.
        times: Times [s].
        kinetic, elastic: Energies; dropped: potential energy lost since the start [J].
        farthest: Largest displacement of any node [m].
        error: The error that ended the run early, if any.
        steps: Time steps done.
        seconds: Wall time of the steps.
    """

    elements: int
    length: float
    softness: float
    lengthens: bool
    times: list = field(default_factory=list)
    kinetic: list = field(default_factory=list)
    elastic: list = field(default_factory=list)
    dropped: list = field(default_factory=list)
    farthest: list = field(default_factory=list)
    error: str = ""
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
        falling = 2.5 * 0.5 * GRAVITY * t**2 + AHEAD * self.length
        hanging = self.length * (2.0 + 3.0 * self.softness)
        return falling if self.lengthens else np.minimum(falling, hanging)

    def look(self, sim, start):
        """Sample the current state; ``start`` is the initial potential energy [J]."""
        with np.errstate(all="ignore"):  # squares of diverged values
            energy = sim.energy()
            moved = sim.body.displacements.numpy().astype(float)
            self.times.append(sim.time)
            self.kinetic.append(kinetic_energy(sim))
            self.elastic.append(energy.elastic)
            self.dropped.append(start - energy.gravitational)
            self.farthest.append(float(np.linalg.norm(moved, axis=1).max()))


#: How far waves may push part of a body ahead of a fall, as a fraction of its length.
AHEAD = 0.1


def kinetic_energy(sim):
    """Kinetic energy [J] at the time of the positions; velocities belong to half a step before."""
    body = sim.body
    masses, forces = body.masses[:, None], sim.forces().numpy().astype(float)
    later = body.velocities.numpy() + 0.5 * sim.pace.dt * (forces / np.maximum(masses, 1e-30) + np.array(sim.gravity))
    return 0.5 * float(np.sum(masses * later**2 * ~body.constrained[:, None]))


def fall(case, seconds, count, device="cpu", dt=None):
    """Run a case; errors are recorded, not raised."""
    sim = case.simulation(count, device, dt)
    points = sim.body.mesh.points
    length = float(np.ptp(points[np.unique(sim.body.mesh.tets)], axis=0).max())
    softness = DENSITY * GRAVITY * length / (1e3 * case.kilopascals)
    found = Fall(sim.body.element_count, length, softness, lengthens=case.law == "linear")
    start = sim.energy().gravitational
    started = time.perf_counter()
    try:
        for number in range(1, round(seconds / EVERY) + 1):
            sim.advance(number * EVERY - sim.time)
            found.look(sim, start)
    except wc.UnstableError as error:
        found.error = str(error)
    found.steps, found.seconds = sim.steps, time.perf_counter() - started
    return found


#: E_kin + E_el may exceed the drop by this fraction of the largest drop so far. The scheme keeps the energy of a mode
#: omega to (omega dt)^2 / 4, and fast modes hold little of it: runs with a fifth of the stable step at rest stay below
#: 0.008, and those that hardly deform below 0.004 with four fifths of it.
SURPLUS = 0.01


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
        gained, given = kinetic + elastic, np.maximum.accumulate(dropped)
        much = gained > dropped + SURPLUS * given
        if much.any():
            first = np.argmax(much)
            said.append(
                f"energy {gained[first]:.3g} J of {dropped[first]:.3g} J at {found.times[first]:.2f} s, "
                f"at most {np.max(gained / given):.3g} times what gravity gave"
            )
        far = farthest > found.reach
        if far.any():
            first = np.argmax(far)
            said.append(
                f"a node moved {farthest[first]:.3g} m by {found.times[first]:.2f} s, beyond {found.reach[first]:.3g}"
            )
    return said


def main():
    """``[--short] [DEVICE]``: a line for each body."""
    wp.config.log_level = wp.LOG_ERROR
    names = [word for word in sys.argv[1:] if not word.startswith("--")]
    short = "--short" in sys.argv
    for case in DOZEN if short else THIRTY:
        found = fall(case, SHORT if short else LONG, FEW if short else MANY, *names)
        said = "; ".join(violations(found)) or "all laws hold"
        print(f"{case}: {found.elements} elements, {found.steps} steps, {found.seconds:.1f} s: {said}", flush=True)


if __name__ == "__main__":
    main()
