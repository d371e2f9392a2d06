"""Friction, stacks, impacts and tools that slide: bodies in motion."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from warp_corot.body.soft_body import SoftBody
from warp_corot.contact.options import Contact
from warp_corot.contact.shapes import Capsule, Ground, SignedDistance
from warp_corot.contact.tool import Tool
from warp_corot.elasticity import Linear
from warp_corot.materials.isotropic import Isotropic
from warp_corot.mesh import TetForest
from warp_corot.simulation.simulation import Simulation
from warp_corot.solvers import BackwardEuler, SymplecticEuler
from warp_corot.solvers.system import Integrator

from .case import Row, Setup, case
from .elastic import faces_where, mapped_grid, spread

Array = npt.NDArray[np.float64]

NONE, GRAVITY = (0.0, 0.0, 0.0), 9.81
DOWN = (0.0, 0.0, -GRAVITY)
SOFT = Isotropic(young=2e4, poisson=0.4, density=1000.0)
INTEGRATORS: dict[str, Integrator] = {
    "explicit": SymplecticEuler(viscosity=1e-3),
    "implicit": BackwardEuler(dt=0.016),
}


def block(setup: Setup, z: float = 0.0, cells: tuple[int, int, int] = (2, 2, 1), young: float = 2e4) -> SoftBody:
    mesh = TetForest.box(cells, 0.02, 3, origin=(0.0, 0.0, z))
    return SoftBody(mesh, Isotropic(young, 0.3, 1e3), device=setup.device)


def mean_velocity(body: SoftBody) -> Array:
    """Velocity of the centre of mass [m/s], [3]."""
    return body.masses @ body.velocities.numpy().astype(np.float64) / body.masses.sum()


def force_on(body: SoftBody) -> Array:
    """Sum of the contact forces on a body [N], [3]."""
    return body.contact_forces.numpy().astype(np.float64).sum(axis=0)


@case("slope", "Coulomb")
def slope(setup: Setup) -> list[Row]:
    """A block on a slope: at rest at 0.99 of the angle of friction, and sliding at 1.01 of it."""
    friction, rows = 0.3, []
    for name, integrator in INTEGRATORS.items():
        for share in (0.99, 1.01):
            angle = share * np.arctan(friction)
            gravity = GRAVITY * np.array([np.sin(angle), 0.0, -np.cos(angle)])
            body = block(setup, young=1e5)
            contact = Contact(friction=friction)
            sim = Simulation(body, obstacles=Ground(), gravity=gravity, integrator=integrator, contact=contact)
            sim.advance(0.2)
            began, time = mean_velocity(body)[0], sim.time
            sim.advance(1.0 if setup.full else 0.1)
            gained = mean_velocity(body)[0] - began
            if share < 1.0:
                rows.append(Row(f"speed at 0.99, {name}", 1e3 * (began + gained), 0.0, 1e-5, "mm/s", scale=1e3))
            else:
                slides = float(GRAVITY * (np.sin(angle) - friction * np.cos(angle)))
                rows.append(Row(f"acceleration at 1.01, {name}", gained / (sim.time - time), slides, 0.01, "m/s2"))
    return rows


@case("contact-patch", "even stress; Taylor and Papadopoulos 1991")
def contact_patch(setup: Setup) -> list[Row]:
    """Pressure on a block that lies on another goes through the contact evenly, on four pairs of meshes.

    The blocks begin at nine tenths of the answer: nothing holds them sideways, and what they drift by while they settle
    sets their sides apart.
    """
    pressure, young, poisson, rows = 200.0, 2e4, 0.3, []
    for name, cells, level, bound in (
        ("alike", (2, 2, 1), 3, 1e-5),
        ("3 : 2", (3, 3, 1), 3, 1e-4),
        ("turned", (3, 3, 2), 1, 0.05),
        ("turned, flat_edges", (3, 3, 2), 1, 1e-4),
    ):
        size = 0.04 / cells[0]
        meshes = [
            TetForest.box(cells, size, level),
            TetForest.box((2, 2, 1), 0.02, 3, origin=(0.0, 0.0, cells[2] * size)),
        ]
        both = [SoftBody(mesh, Isotropic(young, poisson, 1e3), device=setup.device) for mesh in meshes]
        top = both[1].mesh.points[:, 2]
        spread(both[1], faces_where(both[1], top > top.max() - 1e-9), (0.0, 0.0, -pressure))
        for body in both:
            at = body.mesh.points - [0.02, 0.02, 0.0]
            body.displacements = 0.9 * pressure / young * at * [poisson, poisson, -1.0]
        sim = Simulation(
            both,
            model=Linear(),
            obstacles=Ground(),
            contact=Contact(friction=0.0, flat_edges="flat" in name),
            gravity=NONE,
            integrator=SymplecticEuler(viscosity=2e-3, damping=60.0),
        )
        sim.advance(0.3)
        stresses = np.concatenate([np.asarray(sim.von_mises(body), dtype=np.float64) for body in both])
        worst = stresses[np.abs(stresses - pressure).argmax()]
        rows.append(Row(f"stress farthest off, {name}", float(worst), pressure, bound, "Pa"))
        setup.shown = both, []
    return rows


@case("stack", "weights above")
def stack(setup: Setup) -> list[Row]:
    """Slabs with two sizes of elements lie on one another, each a little to one side: 5 of them (full: 20)."""
    count = 20 if setup.full else 5
    beside = np.random.default_rng(0).uniform(-5e-4, 5e-4, (count, 2))
    slabs = [
        SoftBody(
            TetForest.box((4, 4, 1), 0.01, k % 2, origin=(*beside[k], 0.01002 * k)),
            Isotropic(2e5, 0.3, 1e3),
            device=setup.device,
        )
        for k in range(count)
    ]
    ground, integrator = Ground(), SymplecticEuler(viscosity=1e-3, damping=2.0)
    sim = Simulation(slabs, obstacles=ground, contact=Contact(friction=0.5), gravity=DOWN, integrator=integrator)
    sim.advance(0.05 * count)
    before = np.array([slab.positions.numpy().mean(axis=0) for slab in slabs])
    sim.advance(0.2)
    moved = np.array([slab.positions.numpy().mean(axis=0) for slab in slabs]) - before
    weights = GRAVITY * np.array([slab.masses.sum() for slab in slabs])
    borne = np.array([force_on(slab)[2] for slab in slabs]) / weights
    setup.shown = slabs, [ground]
    return [
        Row("force on a slab over its weight", borne[np.abs(borne - 1.0).argmax()], 1.0, 0.01),
        Row("force on the ground", -float(ground.wrench.numpy()[0, 2]), weights.sum(), 0.01, "N"),
        Row("motion in 0.2 s", 1e3 * float(np.abs(moved).max()), 0.0, 0.05, "mm", scale=10.0),
    ]


@case("bar", "waves: 2 L / c, rho c v A, v; Carpenter, Taylor, Katona 1991")
def bar(setup: Setup) -> list[Row]:
    """An elastic bar hits a wall with its end and leaves with its speed when the wave has come back."""
    side, count, young, density, speed = 0.005, 16, 1e5, 1e3, 0.1
    mesh = TetForest.box((1, 1, count), side, 6 if setup.full else 3)
    body = SoftBody(mesh, Isotropic(young, 0.0, density), device=setup.device)
    body.velocities = np.tile((0.0, 0.0, -speed), (body.node_count, 1))
    wave, length = float(np.sqrt(young / density)), side * count
    sim = Simulation(body, model=Linear(), obstacles=Ground(friction=0.0), gravity=NONE)
    lasts, every, felt = 2.0 * length / wave, 1e-4, []
    while sim.time < 1.5 * lasts:
        sim.advance(every)
        felt.append(force_on(body)[2])
    force = density * wave * speed * side**2
    return [
        Row(
            "duration of contact", 1e3 * every * np.count_nonzero(np.array(felt) > 0.1 * force), 1e3 * lasts, 0.05, "ms"
        ),
        Row("impulse", 1e3 * every * sum(felt), 2e3 * speed * body.masses.sum(), 0.03, "N ms"),
        Row("speed after", mean_velocity(body)[2], speed, 0.05, "m/s"),
    ]


@case("rebound", "conservation of energy")
def rebound(setup: Setup) -> list[Row]:
    """A soft ball falls by 20 mm and rebounds, in explicit steps without loss: no energy from nowhere."""
    from warp_corot.domain import Domain

    radius, fall = 0.02, 0.02
    mesh = TetForest.from_domain(Domain.sphere(radius), target_elements=6000 if setup.full else 1500)
    body = SoftBody(mesh, SOFT, device=setup.device)
    ground = Ground((0.0, 0.0, 1.0), -radius - fall)
    sim = Simulation(body, obstacles=ground, gravity=DOWN)
    began = given = sim.energy().total
    for _ in range(40):
        sim.advance(0.005)
        given = max(given, sim.energy().total)
    lowest = body.contact_surface.moved(body.displacements.numpy())[:, 2].min() + radius + fall
    weight = GRAVITY * body.masses.sum()
    setup.shown = [body], [ground]
    return [
        Row("energy gained, of the fall's", (given - began) / (weight * fall), 0.0, 0.01, scale=1.0),
        Row("below the ground", 1e3 * max(-float(lowest), 0.0), 0.0, 1e-3, "mm", scale=1e3 * radius),
    ]


@case("ironing", "Coulomb; scene after Puso and Laursen 2004")
def ironing(setup: Setup) -> list[Row]:
    """A rigid roller that does not turn is pressed 0.75 mm into a slab and drawn over 12 elements of it (full: 24)."""
    friction, radius, depth, speed = 0.3, 0.02, 7.5e-4, 0.2
    mesh = TetForest.box((12, 2, 2), 0.005, 6 if setup.full else 3)
    body = SoftBody(mesh, SOFT, device=setup.device)
    body.fix("z == zmin")
    along_y = (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))
    roller, high = Tool(Capsule(radius, 0.02)), 0.01 + radius
    times, ways = [0.0, 0.02, 0.02 + 0.03 / speed], [(0.015, high), (0.015, high - depth), (0.045, high - depth)]
    roller.follow(times, [(x, 0.005, z) for x, z in ways], [along_y] * 3)
    integrator, contact = SymplecticEuler(viscosity=1e-3), Contact(friction=friction)
    sim = Simulation(body, obstacles=[roller], gravity=NONE, integrator=integrator, contact=contact)
    sim.advance(0.07)
    felt = []
    while sim.time < times[-1] - 1e-9:
        sim.advance(0.001)
        felt.append(roller.wrench.numpy()[0, [0, 2]].astype(np.float64))
    sideways, down = np.array(felt).T
    setup.shown = [body], [roller]
    return [
        Row("force along over force down", -sideways.sum() / down.sum(), friction, 0.05),
        Row("ripple of the force down", float(down.std() / down.mean()), 0.0, 0.06, scale=1.0),
    ]


@case("ring", "Coulomb; balance of forces")
def ring(setup: Setup) -> list[Row]:
    """A tube of 18 mm is drawn through a rigid ring of 15 mm."""
    friction, hole, wire, pulled = 0.2, 0.0075, 0.003, 0.04
    along, layers, around = (40, 3, 32) if setup.full else (24, 2, 16)

    def place(r: Array, t: Array, z: Array) -> list[Array]:
        r = 0.006 + 0.003 * r - 0.0025 * np.clip(1.0 - 4.0 * z, 0.0, 1.0)
        return [r * np.cos(2.0 * np.pi * t), r * np.sin(2.0 * np.pi * t), 0.06 * z]

    mesh = mapped_grid((layers, around, along), place)
    body = SoftBody(mesh, SOFT, device=setup.device)
    body.prescribe("z == zmin", times=[0.0, 0.4], displacements=[NONE, (0.0, 0.0, -pulled)])

    def depth(points: Array) -> Array:
        return np.hypot(np.hypot(points[:, 0], points[:, 1]) - hole - wire, points[:, 2] + 0.002) - wire

    half = hole + 2.5 * wire
    torus = SignedDistance(depth, (-half, -half, -0.007), upper=(half, half, 0.003), resolution=64)
    integrator, contact = SymplecticEuler(viscosity=3e-4), Contact(friction=friction)
    sim = Simulation(body, obstacles=[torus], gravity=NONE, integrator=integrator, contact=contact)
    sim.advance(0.2)
    held, felt, most, deepest = 0.0, 0.0, 0.0, 0.0
    end = np.isclose(mesh.points[:, 2], 0.0)
    while sim.time < 0.4 - 1e-9:
        sim.advance(0.001)
        held += float(body.reactions.numpy()[end, 2].sum())
        felt += float(torus.wrench.numpy()[0, 2])
        for point in sim.contacts():
            if point.normal_force > 1e-4:
                most = max(most, float(np.linalg.norm(point.friction_force)) / point.normal_force)
        deepest = max(deepest, float(-depth(body.positions.numpy().astype(np.float64)).min()))
    setup.shown = [body], [torus]
    return [
        Row("force that draws over force on the ring", held / felt, 1.0, 0.03),
        Row("largest friction over pressure", most, friction, 1e-3),
        Row("deepest in the ring", 1e3 * deepest, 0.0, 0.03, "mm", scale=3.0),
    ]
