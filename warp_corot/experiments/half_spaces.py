"""Half-spaces under a ball, a cylinder, a punch, and other elastic bodies, beside the closed forms.

A block stands for the half-space z < 0 around the place of contact; its border moves as the half-space does under a
force at that place (Boussinesq, Cerruti), which is right far away for any distribution of pressure.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from warp_corot.body.soft_body import SoftBody
from warp_corot.contact.options import Contact
from warp_corot.contact.shapes import Capsule, Cylinder, Ground, Shape, Sphere
from warp_corot.contact.tool import Tool
from warp_corot.errors import ConvergenceError
from warp_corot.materials.isotropic import Isotropic
from warp_corot.mesh import TetForest, TetMesh
from warp_corot.simulation.simulation import Simulation
from warp_corot.simulation.static import solve_static
from warp_corot.solvers import BackwardEuler, Integrator, SymplecticEuler

from .case import Row, Setup, case

Array = npt.NDArray[np.float64]

NONE = (0.0, 0.0, 0.0)
YOUNG, POISSON = 1e4, 0.3
#: Radius of the ball and of the circle that it touches, and half the width of the block [m].
RADIUS, CONTACT, HALF = 0.02, 0.004, 0.032
DEPTH = CONTACT**2 / RADIUS
#: 4/3 E* sqrt(R) depth^1.5 [N].
FORCE = 4.0 / 3.0 * YOUNG / (1.0 - POISSON**2) * np.sqrt(RADIUS) * DEPTH**1.5
JOHNSON = "Johnson, Contact Mechanics (1985)"


def boussinesq(points: Array, force: float = FORCE, young: float = YOUNG, poisson: float = POISSON) -> Array:
    """Displacements of a half-space z < 0 under a force down at the origin [m], [n, 3]."""
    x, y, z = points[:, 0], points[:, 1], -points[:, 2]
    r = np.sqrt(x**2 + y**2 + z**2)
    down = 2.0 * (1.0 - poisson) / r + z**2 / r**3
    outward = z / r**3 - (1.0 - 2.0 * poisson) / (r * (r + z))
    return force * (1.0 + poisson) / (2.0 * np.pi * young) * np.column_stack([outward * x, outward * y, -down])


def cerruti(points: Array, force: float, young: float, poisson: float) -> Array:
    """The same under a force along x."""
    x, y, z = points[:, 0], points[:, 1], -points[:, 2]
    r = np.sqrt(x**2 + y**2 + z**2)
    less = 1.0 - 2.0 * poisson
    along = 1.0 / r + x**2 / r**3 + less * (1.0 / (r + z) - x**2 / (r * (r + z) ** 2))
    across = x * y / r**3 - less * x * y / (r * (r + z) ** 2)
    down = x * z / r**3 + less * x / (r * (r + z))
    return force * (1.0 + poisson) / (2.0 * np.pi * young) * np.column_stack([along, across, -down])


def refined_block(finest: int, rim: int = 0) -> TetForest:
    """Finest within one and a half radii of contact, and coarser in proportion farther away; levels up to ``rim`` only
    at the circle of contact."""
    mesh = TetForest.box((4, 4, 2), 0.5 * HALF, 3, origin=(-HALF, -HALF, -HALF))
    for level in range(4, max(finest, rim) + 1):
        centres = mesh.points[mesh.tets].mean(axis=1)
        size = 0.5 * HALF * 0.5 ** (level // 3)
        far = np.linalg.norm(centres, axis=1) - max(1.5 * CONTACT, 3.0 * size)
        if level > finest:
            far = np.hypot(np.hypot(centres[:, 0], centres[:, 1]) - CONTACT, centres[:, 2]) - 2.0 * size
        mesh = mesh.refine(np.flatnonzero((mesh.levels < level) & (far < 0.0)))
    return mesh


def border(x: Array) -> npt.NDArray[np.intp]:
    """The nodes of a block that are not on its upper side."""
    return np.flatnonzero((np.abs(x[:, :2]).max(axis=1) > HALF - 1e-6) | (x[:, 2] < -HALF + 1e-6))


def pressed(setup: Setup, mesh: TetForest, force: float, shape: Shape) -> float:
    """The force on a shape that is pressed into the half-space, at rest [N]; its border moves as under a force.

    Raises:
        ConvergenceError: The body does not come to rest.
    """
    body = SoftBody(mesh, Isotropic(YOUNG, POISSON, 1e3), device=setup.device)
    edge = border(mesh.points)
    body.fix(edge)
    moved = np.zeros_like(mesh.points)
    moved[edge] = boussinesq(mesh.points[edge], force)
    body.displacements = moved
    report = solve_static(body, gravity=NONE, obstacles=shape, contact=Contact(friction=0.0))
    if not report.converged:
        raise ConvergenceError(report.message)
    setup.shown = [body], [shape]
    return float(shape.wrench.numpy()[0, 2])


def pressed_in_steps(setup: Setup, mesh: TetForest, integrator: Integrator, steps: int) -> float:
    """The force on a ball that moves down onto the half-space, the mean of so many steps after 0.12 s [N]."""
    body = SoftBody(mesh, Isotropic(YOUNG, POISSON, 1e3), device=setup.device)
    edge = border(mesh.points)
    moved = boussinesq(mesh.points[edge])
    body.prescribe(edge, times=[0.0, 0.06], displacements=np.stack([0.0 * moved, moved]))
    ball = Tool(Sphere(RADIUS))
    ball.follow([0.0, 0.06], [(0.0, 0.0, RADIUS), (0.0, 0.0, RADIUS - DEPTH)])
    contact = Contact(friction=0.0)
    sim = Simulation(body, obstacles=[ball], gravity=NONE, integrator=integrator, contact=contact)
    sim.advance(0.12)
    felt = []
    for _ in range(steps):
        sim.step()
        felt.append(float(ball.wrench.numpy()[0, 2]))
    setup.shown = [body], [ball]
    return float(np.mean(felt))


@case("hertz-sphere", f"Hertz; {JOHNSON}, 4.2")
def hertz_sphere(setup: Setup) -> list[Row]:
    """A rigid ball on a half-space, four elements over the radius of contact (full: eight)."""
    mesh = refined_block(15 if setup.full else 12)
    explicit = pressed_in_steps(setup, mesh, SymplecticEuler(damping=150.0), 40)
    implicit = pressed_in_steps(setup, mesh, BackwardEuler(dt=0.02), 1)
    bound = 0.02 if setup.full else 0.035
    return [
        Row("force, implicit steps", implicit, FORCE, bound, "N"),
        Row("force, explicit steps", explicit, FORCE, bound, "N"),
    ]


@case("flat-punch", f"2 a E* depth; {JOHNSON}, 3.4")
def flat_punch(setup: Setup) -> list[Row]:
    """A rigid flat punch, whose pressure is unbounded at its rim; elements of 1/16 of its radius there (full: 1/32)."""
    mesh, depth, length = refined_block(12, 18 if setup.full else 15), 2e-4, 0.01
    force = 2.0 * CONTACT * YOUNG / (1.0 - POISSON**2) * depth
    punch = Cylinder(CONTACT, length, position=(0.0, 0.0, 0.5 * length - depth))
    return [Row("force at rest", pressed(setup, mesh, force, punch), force, 0.03 if setup.full else 0.08, "N")]


@case("cattaneo-mindlin", f"Cattaneo 1938, Mindlin 1949; {JOHNSON}, 7.2")
def cattaneo_mindlin(setup: Setup) -> list[Row]:
    """A rigid ball is pressed in and then moved sideways: the rim of the contact slips, its middle sticks.

    Poisson's ratio is 0.49, so that normal and tangential forces hardly affect one another. The closed form is for
    small circles of contact; here their radius is a fifth of the ball's, and smaller ones come nearer to it.
    """
    friction, poisson, share = 0.5, 0.49, 0.6
    shear = 0.5 * YOUNG / (1.0 + poisson)
    push = 4.0 / 3.0 * YOUNG / (1.0 - poisson**2) * np.sqrt(RADIUS) * DEPTH**1.5
    drag = share * friction * push
    way = 3.0 * friction * push * (2.0 - poisson) / (16.0 * CONTACT * shear) * (1.0 - (1.0 - share) ** (2.0 / 3.0))
    mesh = refined_block(15 if setup.full else 12)
    body = SoftBody(mesh, Isotropic(YOUNG, poisson, 1e3), device=setup.device)
    edge = border(mesh.points)
    down = boussinesq(mesh.points[edge], push, YOUNG, poisson)
    both = down + cerruti(mesh.points[edge], drag, YOUNG, poisson)
    times = [0.0, 0.15, 0.3]
    body.prescribe(edge, times=times, displacements=np.stack([0.0 * down, down, both]))
    ball = Tool(Sphere(RADIUS))
    low = RADIUS - DEPTH
    ball.follow(times, [(0.0, 0.0, RADIUS), (0.0, 0.0, low), (way, 0.0, low)])
    integrator, contact = BackwardEuler(dt=0.05), Contact(friction=friction)
    sim = Simulation(body, obstacles=[ball], gravity=NONE, integrator=integrator, contact=contact)
    sim.advance_steps(6)
    setup.shown = [body], [ball]
    felt = ball.wrench.numpy()[0].astype(np.float64)
    sticks = [
        float(np.hypot(*(point.point[:2] - (way, 0.0))))
        for point in sim.contacts()
        if np.linalg.norm(point.friction_force) < 0.99 * friction * point.normal_force
    ]
    return [
        Row("force down", felt[2], push, 0.03, "N"),
        Row("force sideways", -felt[0], drag, 0.08, "N"),
        Row("radius that sticks", 1e3 * max(sticks, default=0.0), 1e3 * CONTACT * (1.0 - share) ** (1 / 3), 0.1, "mm"),
    ]


def slab(finest: int, side: float, radius: float = np.inf) -> TetMesh | TetForest:
    """A slab of z < 0, this thick along y [m], 32 times as wide and 16 times as high; finest at the line x = z = 0
    where its surface, flat or that of a cylinder, is touched."""
    mesh = TetForest.box((32, 1, 16), side, 0, origin=(-16.0 * side, 0.0, -16.0 * side))
    for level in range(1, finest + 1):
        far = np.hypot(*mesh.points[mesh.tets].mean(axis=1)[:, [0, 2]].T)
        size = side * 0.5 ** (level // 3)
        mesh = mesh.refine(np.flatnonzero((mesh.levels < level) & (far < max(1.5 * side, 4.0 * size))))
    x = mesh.points.copy()
    x[:, 2] -= 0.5 * np.minimum(np.abs(x[:, 0]), 6.0 * side) ** 2 / radius * (1.0 + x[:, 2] / (16.0 * side))
    return TetMesh(x, mesh.tets)


def smooth_walls(side: float) -> list[Ground]:
    """Walls on both sides of slabs, between which they are in plane strain."""
    return [Ground((0.0, 1.0, 0.0), 0.0, friction=0.0), Ground((0.0, -1.0, 0.0), -side, friction=0.0)]


def half_width(body: SoftBody, side: float) -> float:
    """Half the width of the strip where slabs touch, by the second moment of a pressure like an ellipse [m]."""
    forces = np.abs(body.contact_forces.numpy().astype(np.float64)[:, 2])
    forces *= np.abs(body.mesh.points[:, 0]) < 4.0 * side
    return 2.0 * float(np.sqrt(forces @ body.positions.numpy()[:, 0].astype(np.float64) ** 2 / forces.sum()))


@case("hertz-cylinder", f"Hertz; {JOHNSON}, 4.2")
def hertz_cylinder(setup: Setup) -> list[Row]:
    """A rigid cylinder along a slab between two smooth walls, in plane strain: the width of contact for its force."""
    radius, depth, side = 0.02, 4e-4, 0.002
    mesh = slab(9 if setup.full else 6, side)
    body = SoftBody(mesh, Isotropic(YOUNG, POISSON, 1e3), device=setup.device)
    body.fix("z == zmin")
    along_y = (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))
    roller = Tool(Capsule(radius, 0.1, quaternion=along_y))
    roller.follow([0.0, 0.1], [(0.0, 0.5 * side, radius), (0.0, 0.5 * side, radius - depth)])
    integrator, contact = BackwardEuler(dt=0.02), Contact(friction=0.0)
    things: list[Any] = [roller, *smooth_walls(side)]
    sim = Simulation(body, obstacles=things, gravity=NONE, integrator=integrator, contact=contact)
    sim.advance_steps(12)
    setup.shown = [body], [roller]
    force = float(roller.wrench.numpy()[0, 2]) / side
    exact = np.sqrt(4.0 * force * radius * (1.0 - POISSON**2) / (np.pi * YOUNG))
    return [Row("half the width of contact", 1e3 * half_width(body, side), 1e3 * exact, 0.03, "mm")]


@case("nafems-roller", "Konter, Advanced Finite Element Contact Benchmarks, NAFEMS 2006, no. 1")
def nafems_roller(setup: Setup) -> list[Row]:
    """A cylinder of 50 mm, E = 210 GPa, on a block of 70 GPa under 35 kN/mm, in plane strain.

    Moduli and force are divided by a million. The bodies are moved together by a given way; the width is scaled to the
    benchmark's force, on whose root it depends.
    """
    side, force, depth = 0.006, 35.0, 2.2e-3
    both = [
        SoftBody(slab(9 if setup.full else 6, side, radius), Isotropic(young, 0.3, 1e3), device=setup.device)
        for young, radius in ((7e4, np.inf), (2.1e5, 0.05))
    ]
    mesh = both[1].mesh
    both[1] = SoftBody(TetMesh(mesh.points * [1.0, 1.0, -1.0], mesh.tets), both[1].material, device=setup.device)
    both[0].fix("z == zmin")
    both[1].prescribe("z == zmax", times=[0.0, 0.1], displacements=[NONE, (0.0, 0.0, -depth)])
    walls = smooth_walls(side)
    sim = Simulation(
        both, obstacles=walls, gravity=NONE, integrator=BackwardEuler(dt=0.02), contact=Contact(friction=0.0)
    )
    sim.advance_steps(12)
    setup.shown = both, []
    felt = both[1].contact_forces.numpy().astype(np.float64)[:, 2].sum() / side
    width = half_width(both[0], side) * np.sqrt(force / felt)
    return [
        Row("half the width of contact", 1e3 * width, 6.21, 0.03, "mm"),
        Row("largest pressure", 2.0 * force / (np.pi * width), 3585.37, 0.03, "MPa"),
    ]
