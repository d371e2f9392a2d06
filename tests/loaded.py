"""Soft bodies under their own weight, made by defaults, and what must hold while they fall and swing.

``python tests/loaded.py`` runs all of them for 2 s each and prints a line for each.
"""

import sys
import time
from dataclasses import dataclass, field
from functools import cache

import numpy as np
import warp as wp

import warp_corot as wc
from warp_corot.io.formats import load_tets

DENSITY = 1000.0
GRAVITY = 9.81
#: How often the laws are checked [s].
EVERY = 0.05

LAWS = {
    "corotated": wc.Corotated,
    "leaf by leaf": lambda: wc.Corotated(subtrees=False),
    "linear": wc.Linear,
    "stvk": wc.StVenantKirchhoff,
    "neo-hookean": wc.NeoHookean,
    "edge-stvk": wc.EdgeStVK,
    "mass-spring": wc.MassSpring,
    "fibres": wc.Corotated,
}

# --- shapes: a mesh of about so many elements, and the axis along which its lowest tenth is held ----------------------


def _adaptive(domain, count):
    """As the command line meshes organs."""
    size = float(np.ptp(domain.bounds, axis=0).max()) * 1.001 / max(1, round((count / 30) ** (1 / 3)))
    return wc.TetForest.from_domain(domain, size, max_level=7, target_elements=count, device="cpu")


def _capsule(count):
    """112 mm long, of radius 15 mm, leaning by 25 degrees."""
    along = 0.082 * np.array([np.sin(np.radians(25)), np.cos(np.radians(25)), 0.0])
    return _adaptive(wc.Domain.capsule((0.0, 0.0, 0.0), along, 0.015, device="cpu"), count)


def _plate(count):
    """60 x 5 x 60 mm, one cube thick."""
    return wc.TetForest.box((12, 1, 12), 0.005, level=int(np.log2(count / (6 * 144))))


def _bear(_):
    bear = load_tets("warp:bear", scale=0.1)
    return wc.TetMesh(bear.points, bear.tets, up_axis=bear.up_axis)


SHAPES = {
    "sphere": (lambda count: _adaptive(wc.Domain.sphere(0.05, device="cpu"), count), 1),
    "capsule": (_capsule, 1),
    "torus": (lambda count: _adaptive(wc.Domain.torus(0.04, 0.015, axis="X", device="cpu"), count), 1),
    "bunny": (lambda count: _adaptive(wc.Domain.from_surface("warp:bunny", device="cpu"), count), 1),
    "bear": (_bear, 1),
    "plate": (_plate, 2),
    "core": (lambda count: _adaptive(wc.Domain.sphere(0.05, device="cpu"), count), 1),
}


@cache
def _mesh(shape, count, general):
    mesh = SHAPES[shape][0](count)
    return wc.TetMesh(mesh.points, mesh.tets, up_axis=mesh.up_axis) if general else mesh


# --- bodies -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Loaded:
    """A body with the lowest tenth of its height held (of a plate one edge), at rest, under gravity from then on.

    Attributes:
        shape, law: Names in SHAPES and LAWS.
        kilopascals: Young's modulus [kPa].
        general: Whether the elements go as a general mesh.
        damping: [1/s].
        poisson: Poisson's ratio.
    """

    shape: str
    kilopascals: float
    law: str
    general: bool = False
    damping: float = 0.0
    poisson: float = 0.45

    def __str__(self):
        mesh = "general" if self.general or self.shape == "bear" else "forest"
        damped = f"-{self.damping:g}/s" if self.damping else ""
        return f"{self.shape}-{self.kilopascals:g}kPa-{self.law.replace(' ', '-')}-{mesh}{damped}"

    def simulation(self, count, device="cpu", dt=None):
        mesh = _mesh(self.shape, count, self.general)
        body = wc.SoftBody(mesh, self.material, device=device)
        heights = mesh.points[:, SHAPES[self.shape][1]]
        body.fix(heights < heights.min() + 0.1 * np.ptp(heights))
        return wc.Simulation(body, model=LAWS[self.law](), integrator=wc.SymplecticEuler(dt, self.damping))

    @property
    def material(self):
        young = 1e3 * self.kilopascals
        if self.law == "fibres":
                    return wc.TransverselyIsotropic(3 * young, young, 0.4, 0.45, young / 3, direction=axis, density=DENSITY)
        if self.shape == "core":
            # A core of half the radius, a hundred times as stiff as the flesh around it.
            return wc.Isotropic(
                lambda x: young * np.where(np.linalg.norm(x, axis=1) < 0.025, 100.0, 1.0), self.poisson, DENSITY
            )
        return wc.Isotropic(young, self.poisson, DENSITY)


# --- what must hold ---------------------------------------------------------------------------------------------------


@dataclass
class Fall:
    """A run, looked at every EVERY seconds.

    Attributes:
        elements: How many.
        length: The body's largest extent [m]; softness: its weight's pressure over Young's modulus, rho g length / E.
        lengthens: Whether turning alone makes it longer, as linear elasticity has it.
        times: [s].
        kinetic, elastic: Energies; dropped: potential energy lost since the start [J].
        farthest: Largest displacement of any node [m].
        error: What ended the run early, if anything did.
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
        """Displacements that a falling body cannot exceed [m], at each time.

        The tip of a rod that turns about its end falls with 3/2 g, of a cone that turns about its base with 5/2 g; waves
        that meet may push it ahead by a little. A body may come to hang below its support, which moves its far end by
        twice the length, and stretch: statically by at most rho g L^2 / (2 E / 3) (neo-Hookean bodies have E / 3 once
        they are long), and twice that as it swings. Linear ones lengthen as they turn, and have the first bound only.
        """
        t = np.array(self.times)
        falling = 2.5 * 0.5 * GRAVITY * t**2 + AHEAD * self.length
        hanging = self.length * (2.0 + 3.0 * self.softness)
        return falling if self.lengthens else np.minimum(falling, hanging)


#: How far waves may push part of a body ahead of a fall, as a share of its length.
AHEAD = 0.1


def kinetic_energy(sim):
    """Kinetic energy [J] at the time of the positions; velocities belong to half a step before."""
    body = sim.body
    masses, forces = body.masses[:, None], sim.forces().numpy().astype(float)
    later = body.velocities.numpy() + 0.5 * sim.dt * (forces / masses + np.array(sim.gravity))
    return 0.5 * float(np.sum(masses * later**2 * ~body.constrained[:, None]))


def fall(case, seconds, count, device="cpu", dt=None):
    """Run a case; errors are kept, not raised."""
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
            energy = sim.energy()
            found.times.append(sim.time)
            found.kinetic.append(kinetic_energy(sim))
            found.elastic.append(energy.elastic)
            found.dropped.append(start - energy.gravitational)
            moved = sim.body.displacements.numpy().astype(float)
            found.farthest.append(float(np.linalg.norm(moved, axis=1).max()))
    except wc.UnstableError as error:
        found.error = str(error)
    found.steps, found.seconds = sim.steps, time.perf_counter() - started
    return found


#: E_kin + E_el may exceed the drop by this share of the largest drop so far. The scheme keeps the energy of a mode
#: omega to (omega dt)^2 / 4, and fast modes hold little of it: runs with a fifth of the stable step at rest stay below
#: 0.008, and those that hardly deform below 0.004 with four fifths of it.
SURPLUS = 0.01


def violations(found):
    """What did not hold, one line each; nothing if all did."""
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


# --- thirty bodies ----------------------------------------------------------------------------------------------------

#: About how many elements, and how long they move [s].
MANY, LONG = 5000, 2.0
FEW, SHORT = 1500, 0.5

#: All shapes at 1, 3, 5, 10 and 30 kPa. StVK stands only where it is hardly compressed: its energy has no barrier.
THIRTY = [
    Loaded("sphere", 1, "corotated"),
    Loaded("sphere", 3, "neo-hookean"),
    Loaded("sphere", 5, "corotated", general=True),
    Loaded("sphere", 10, "mass-spring"),
    Loaded("sphere", 30, "stvk"),
    Loaded("capsule", 1, "neo-hookean"),
    Loaded("capsule", 3, "fibres"),
    Loaded("capsule", 5, "corotated"),
    Loaded("capsule", 5, "neo-hookean", general=True),
    Loaded("capsule", 10, "corotated", poisson=0.49),
    Loaded("capsule", 30, "leaf by leaf"),
    Loaded("torus", 1, "linear"),
    Loaded("torus", 3, "corotated", general=True),
    Loaded("torus", 5, "neo-hookean", damping=2.0),
    Loaded("torus", 10, "corotated"),
    Loaded("torus", 30, "stvk"),
    Loaded("bunny", 1, "corotated", damping=2.0),
    Loaded("bunny", 3, "corotated", damping=2.0),
    Loaded("bunny", 3, "neo-hookean"),
    Loaded("bunny", 5, "linear"),
    Loaded("bunny", 10, "neo-hookean", general=True),
    Loaded("bunny", 30, "fibres", general=True),
    Loaded("bear", 1, "corotated"),
    Loaded("bear", 3, "neo-hookean"),
    Loaded("bear", 5, "corotated", damping=2.0),
    Loaded("bear", 10, "linear"),
    Loaded("bear", 30, "fibres"),
    Loaded("plate", 1, "neo-hookean"),
    Loaded("plate", 3, "corotated"),
    Loaded("plate", 5, "stvk"),
    Loaded("plate", 10, "neo-hookean", general=True),
    Loaded("plate", 30, "edge-stvk"),
    Loaded("core", 1, "neo-hookean"),
    Loaded("core", 3, "corotated"),
    Loaded("core", 5, "corotated", general=True),
    Loaded("core", 10, "mass-spring"),
    Loaded("core", 30, "neo-hookean", damping=2.0),
]

#: The shapes and laws again, those in which trouble comes early.
DOZEN = [
    Loaded("sphere", 1, "corotated"),
    Loaded("sphere", 1, "neo-hookean", general=True),
    Loaded("capsule", 1, "corotated", general=True),
    Loaded("capsule", 3, "neo-hookean"),
    Loaded("torus", 1, "corotated", damping=2.0),
    Loaded("torus", 3, "neo-hookean"),
    Loaded("bunny", 1, "corotated"),
    Loaded("bunny", 3, "neo-hookean"),
    Loaded("bear", 3, "neo-hookean"),
    Loaded("bear", 1, "fibres"),
    Loaded("plate", 5, "stvk"),
    Loaded("core", 3, "corotated"),
]


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
