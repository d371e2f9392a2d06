"""Hands: the ways in which a person acts on a body or moves a tool, listed in ``HANDS``, and their springs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.body.soft_body import SoftBody
from warp_corot.contact.grasp import Attachments, Grasp, rows_of_springs
from warp_corot.contact.obstacles import LARGEST_SHARE
from warp_corot.contact.shapes import Capsule, Shape, Sphere, turn_from_z
from warp_corot.contact.tool import Tool
from warp_corot.cutting.blade import Blade, Edge
from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_choice, checked_vector
from warp_corot.kernels.contact import grasp as kernels
from warp_corot.simulation.simulation import Simulation
from warp_corot.solvers import SymplecticEuler, largest_frequency

from .shown import Pick, Shown

Vector = npt.NDArray[np.float64]

#: Maximum number of hands on a body at the same time, and of points in a patch.
MOST_HANDS, MOST_POINTS = 8, 64
#: The square of the spring's own frequency times the longest step; the limit is 4, of which elasticity takes up to 3.3.
STIFF = 0.2
#: Damping of the spring over critical damping.
DAMPED = 0.1
#: The largest force on a patch over Young's modulus and the patch's area: beyond that, elements turn over for good.
HARDEST = 0.5


@dataclass(frozen=True, eq=False)
class HeldPatch:
    """Points of a shown surface, and the weight of each.

    Attributes:
        points: int32 [k], at most MOST_POINTS.
        shares: The points' weights, which sum to one, float64 [k].
        area: Area of the surface around the points at rest [m^2].
    """

    points: npt.NDArray[np.int32]
    shares: npt.NDArray[np.float64]
    area: float


class Springs:
    """The springs of all hands of a simulation, among the forces of its system from a body's first hold on.

    Args:
        sim: The simulation.
        shown: The shown surface of each body.
    """

    def __init__(self, sim: Simulation, shown: Sequence[Shown]):
        self.sim, self.shown = sim, shown
        self._bodies: dict[int, BodySprings] = {}

    def close(self) -> None:
        """Let everything go and leave the simulation."""
        for springs in self._bodies.values():
            self.sim.system.forces.remove(springs)
        self.sim.system.changes += 2 * len(self._bodies)
        self._bodies.clear()

    def of(self, body: int) -> BodySprings:
        """The springs of the body with this number."""
        if body not in self._bodies:
            self._bodies[body] = BodySprings(self.sim, self.shown[body])
            self.sim.system.forces.append(self._bodies[body])
        return self._bodies[body]

    def refit(self) -> None:
        """Find the stiffness again if the meshes or their nodes' masses have changed."""
        for spring in [each for springs in self._bodies.values() for each in springs.held if each is not None]:
            spring.fit()


class BodySprings(Attachments):
    """The springs that hold one body: each hand has as many rows as a patch may have points, one for each point that it
    holds, or one for their mean."""

    def __init__(self, sim: Simulation, shown: Shown):
        super().__init__(shown.body)
        self.sim, self.shown = sim, shown
        self.held: list[SpringHand | None] = [None] * MOST_HANDS
        self._explicit_dt: float | None = None
        self.make(MOST_HANDS * MOST_POINTS)

    def _pull(self, kernel: wp.Kernel, inputs: list) -> None:
        self.arrays.nodes, self.arrays.weights = self.shown.nodes, self.shown.binding.weights
        super()._pull(kernel, inputs)

    def longest_step(self) -> float:
        """The explicit step that the springs must bear [s]; those of implicit steps are as stiff."""
        sim = self.sim
        if not sim.system.is_implicit:
            return sim.dt if sim.safe_step is None else sim.safe_step.control.at_rest
        if self._explicit_dt is None:
            k = sim.bodies.index(self.body)
            frequency = largest_frequency(self.body, sim.fields[k].stiffest, sim.ranks, k)
            self._explicit_dt = SymplecticEuler().stable_step(frequency)
        return self._explicit_dt


class SpringHand:
    """A spring between the mouse and a patch around the picked place.

    Args:
        springs: The simulation's springs.
        shown: The surface with the place.
        pick: The place.
        radius: Radius of the patch at rest [m].
        strength: Stiffness over the largest stable one at the time step, 0 to 1.

    Attributes:
        rigid: Whether every point is held; otherwise only their mean is.
        stays: Whether it holds on when the mouse lets go.
        stiffness: Stiffness of the spring, for the whole patch [N/m].
        limit: The largest force on it [N].
        rows: Its rows among those of the body.
        starts: Displacements of the points when the hand took hold [m], float64 [k, 3].
        motion: How far the hand has moved since then [m], float64 [3].

    Raises:
        LookupError: The maximum number of hands hold the body already.
    """

    rigid: ClassVar[bool] = False
    stays: ClassVar[bool] = False

    def __init__(self, springs: Springs, shown: Shown, pick: Pick, radius: float, strength: float = 1.0):
        self._owner = owner = springs.of(pick.body)
        if None not in owner.held:
            raise LookupError(f"{MOST_HANDS} hands hold the body already")
        self._slot = owner.held.index(None)
        owner.held[self._slot] = self
        self.rows = slice(self._slot * MOST_POINTS, (self._slot + 1) * MOST_POINTS)
        self.pick, self.strength, self._inward = pick, strength, -shown.normal(pick)
        self.patch = patch = patch_around(shown, pick, radius)
        self.motion = self._before = np.zeros(3)
        nodes, weights = self._bound()
        self.starts = np.einsum("pn,pnc->pc", weights, owner.body.state.displacements.numpy()[nodes, :3])
        own = slice(self.rows.start, self.rows.start + len(patch.points))
        owner.arrays.points[own].assign(patch.points.astype(np.int32))
        owner.arrays.shares[own].assign(np.where(self.rigid, 1.0, patch.shares).astype(np.float32))
        self.fit()

    def fit(self) -> None:
        """Find the stiffness and the damping that are stable at the time step."""
        owner, (nodes, weights) = self._owner, self._bound()
        weights *= self.patch.shares[:, None]
        used, place = np.unique(nodes, return_inverse=True)
        total = np.bincount(place.ravel(), np.abs(weights).ravel(), len(used))
        mass = owner.body.masses[used]
        # The largest eigenvalue of the spring over masses for a stiffness of one: exact if the hand holds the mean,
        # else a bound.
        softness = float((total / mass).max() if self.rigid else (total**2 / mass).sum())
        self.stiffness = self.strength * STIFF / (owner.longest_step() ** 2 * softness)
        self.limit = HARDEST * float(np.mean(owner.body.material.isotropic.young)) * self.patch.area
        is_implicit = owner.sim.system.is_implicit
        self.damping = 0.0 if is_implicit else 2.0 * DAMPED * (self.stiffness / softness) ** 0.5
        self._write()

    def begin(self) -> None:
        """Take hold again: motion counts from here."""
        self._before = self.motion

    def move(self, motion: Vector) -> None:
        """Move to the mouse's present distance from where it was pressed [m], [3]."""
        self.motion = self._before + motion
        self._write()

    def release(self) -> None:
        """Release; further calls do nothing."""
        if self._owner.held[self._slot] is self:
            self._owner.held[self._slot] = None
            self._write()

    @property
    def force(self) -> Vector:
        """The force on the body in the last step [N], float64 [3]; waits for the device."""
        return self._owner.arrays.force.numpy()[self.rows].astype(np.float64).sum(axis=0)

    @property
    def ends(self) -> tuple[Vector, Vector]:
        """The middle of the patch, and the place to which the hand pulls it [m], float64 [3] each."""
        shares = self.patch.shares
        middle = shares @ self._owner.shown.rest[self.patch.points]
        moved = self._owner.arrays.moved.numpy()[self.rows].astype(np.float64)
        mean = shares @ moved[: len(shares)] if self.rigid else moved[0]
        return middle + mean, middle + shares @ self.starts + self.motion

    def _bound(self) -> tuple[npt.NDArray[np.int32], Vector]:
        """The nodes that carry each point of the patch, and their weights, [k, 4] each."""
        # Copied, since a view of a device's array may be the array itself.
        shown, points = self._owner.shown, self.patch.points
        return np.array(shown.nodes.numpy()[points]), np.array(shown.binding.weights.numpy()[points], np.float64)

    def _write(self) -> None:
        """Copy the hand to the device, or nothing if it has been released."""
        rows, first, shares = rows_of_springs(MOST_POINTS), self.rows.start, self.patch.shares
        if self._owner.held[self._slot] is self:
            count, of_rows = (len(shares), shares) if self.rigid else (1, np.ones(1))
            rows["first"], rows["count"][:count] = first + np.arange(MOST_POINTS), len(shares) // count
            rows["target"][:count] = self.motion + (self.starts if self.rigid else shares @ self.starts)
            for name in ("stiffness", "damping", "limit"):
                rows[name][:count] = of_rows * getattr(self, name)
        given = wp.array(rows, dtype=kernels.Spring, device=self._owner.device)
        wp.copy(self._owner.arrays.springs, given, dest_offset=first, count=MOST_POINTS)


class DragHand(SpringHand):
    """Pulls the tissue after the mouse; the patch may rotate and stretch."""


class PressHand(SpringHand):
    """Pushes the rigid patch into the body, as deep as the mouse moves, like a stamp of the patch's shape."""

    rigid = True

    def move(self, motion: Vector) -> None:
        self.motion = float(np.linalg.norm(motion)) * self._inward
        self._write()


class GraspHand(SpringHand):
    """Holds the patch rigidly, and stays where the mouse leaves it, until it is released."""

    rigid = True
    stays = True


HANDS: dict[str, type[SpringHand]] = {"drag": DragHand, "press": PressHand, "grasp": GraspHand}


def patch_around(shown: Shown, pick: Pick, radius: float) -> HeldPatch:
    """The points of the shown surface that are at rest within a radius [m] of a place, and at least the corners of its
    triangle; the nearer a point, the larger its weight."""
    corners = shown.triangles[pick.triangle]
    distance = np.linalg.norm(shown.rest - shown.at(pick, shown.rest), axis=1)
    near = np.flatnonzero(distance < radius)
    near = near[np.argsort(distance[near], kind="stable")]
    # Evenly thinned: the nearest points would be a smaller patch.
    near = near[:: -(-len(near) // (MOST_POINTS - 3))] if len(near) > MOST_POINTS - 3 else near
    points, place = np.unique(np.concatenate([corners, near]), return_inverse=True)
    shares = np.concatenate([pick.place, (1.0 - (distance[near] / max(radius, 1e-300)) ** 2) ** 2])
    total = np.bincount(place, shares, len(points))
    there = np.zeros(len(shown.rest), bool)
    there[points] = there[distance < radius] = True
    a, b, c = np.moveaxis(shown.rest[shown.triangles], 1, 0)
    areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    area = float(areas @ there[shown.triangles].mean(axis=1))
    return HeldPatch(points.astype(np.int32), total / total.sum(), area)


# --- rigid tools, and the hand that moves them -----------------------------------------------------------------------

#: The shapes of the tools that a visitor may put into the scene, for a size of the bodies [m].
SHAPES: dict[str, Callable[..., Shape]] = {
    "ball": lambda size, **pose: Sphere(radius=0.1 * size, **pose),
    "rod": lambda size, **pose: Capsule(radius=0.04 * size, length=0.5 * size, **pose),
    "knife": lambda size, **pose: Edge(np.array([[0.0, 0.0, -0.4], [0.0, 0.0, 0.4]]) * size, **pose),
}
#: The highest speed of these tools over the size of the bodies [1/s].
BRISK = 5.0


def new_tool(
    name: str,
    size: float,
    up: Vector,
    place: npt.ArrayLike,
    bodies: npt.NDArray[np.floating],
    dt: float | None,
    fastest_cut: float,
) -> Tool:
    """A tool that the page offers.

    Args:
        name: A name in ``SHAPES``.
        size: The size of the bodies [m].
        up: The direction in which a rod or an edge points, [3].
        place: Its first place [m], [3]; it is moved away until it is clear of the box around the bodies.
        bodies: Points of the bodies [m], [V, 3].
        dt: The length of steps if it is given [s]; the tool is slow enough for it.
        fastest_cut: The highest speed of a knife [m/s].

    Raises:
        InputError: There is no such tool, or the place is not three finite numbers.
    """
    checked_choice(name, "name", SHAPES)
    there = checked_vector(place, "place")
    away = there - bodies.mean(axis=0) + 1e-3 * size
    reach = 1.1 * SHAPES[name](size).reach
    low, high = bodies.min(axis=0) - reach, bodies.max(axis=0) + reach
    while (low < there).all() and (there < high).all():
        there = there + 0.1 * size * away / np.linalg.norm(away)
    shape = SHAPES[name](size, position=there, quaternion=turn_from_z(up))
    speed = BRISK * size
    if isinstance(shape, Edge):
        speed = min(speed, fastest_cut)
        return Blade(shape.points, speed=speed, position=shape.position, quaternion=shape.quaternion)
    return Tool(shape, speed=speed if dt is None else min(speed, 0.99 * LARGEST_SHARE * shape.thickness / dt))


class ToolHand:
    """Moves a tool with the mouse, no faster than its speed. The tool stays where it is left.

    Args:
        tool: A tool that nothing else moves.
        world: The world in which it is seen; it moves in all of them.

    Raises:
        InputError: The tool follows keyframes or an array.
    """

    stays: ClassVar[bool] = True

    def __init__(self, tool: Tool, world: int = 0):
        if tool.keys is not None or tool.poses is not None:
            raise InputError("this tool follows keyframes or an array; the mouse moves tools that nothing else moves")
        self.tool, self.world = tool, world
        self.grasps: list[Grasp] = []
        self.begin()

    def begin(self) -> None:
        """Take hold again: motion counts from here."""
        self._before = self._target = self._place

    def grasp(self, bodies: Sequence[SoftBody], reach: float) -> None:
        """Hold the surface nodes of bodies that are nearer to the tool than ``reach`` [m], until ``release``.

        Raises:
            InputError: There are none.
        """
        if self.grasps:
            return
        if isinstance(self.tool, Blade):
            raise InputError("a knife holds no tissue; choose another hand")
        obstacles, number = self.tool.place_among_obstacles()
        for body in bodies:
            nodes = np.unique(body.surface_triangles)
            places = body.world(self.world).positions.numpy()[nodes].astype(np.float64)
            near = nodes[obstacles.gaps(places, reach, self.world)[number] < reach]
            if len(near):
                self.grasps.append(Grasp(body, near, tool=self.tool))
        if not self.grasps:
            raise InputError(
                f"no tissue is within {1e3 * reach:.3g} mm of the tool: bring it there, then press on it again"
            )

    def move(self, motion: Vector) -> None:
        """Move to the mouse's present distance from where it was pressed [m], [3]."""
        self._target = self._before + motion
        self.tool.move(self._target)

    def release(self) -> None:
        """Let the tissue go; the tool stays."""
        for grasp in self.grasps:
            grasp.release()
        self.grasps = []

    @property
    def force(self) -> Vector:
        """The force of the tool on the tissue in the last step [N], float64 [3]."""
        felt = [self.tool.wrench, *(grasp.wrench for grasp in self.grasps)]
        return -np.array([wrench.numpy()[self.world][:3] for wrench in felt], np.float64).sum(axis=0)

    @property
    def ends(self) -> tuple[Vector, Vector]:
        """Where the tool is and where it is to go [m], float64 [3] each."""
        return self._place, self._target

    @property
    def _place(self) -> Vector:
        return self.tool.present_pose[self.world][:3].copy()
