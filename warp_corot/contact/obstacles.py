"""The obstacles of a simulation on the device: their shapes, their motion, and the wrenches on them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.errors import InputError
from warp_corot.kernels.contact import motion as kernels
from warp_corot.kernels.contact import sums
from warp_corot.kernels.contact.explicit_rows import Rigid
from warp_corot.kernels.contact.law import Law
from warp_corot.kernels.contact.shapes import Shapes
from warp_corot.kernels.contact.sums import measure_gaps
from warp_corot.kernels.contact.watch import Watch, move_obstacles
from warp_corot.solvers.system import System

from .search import Search, rows_of
from .shapes import Ground, Shape, SignedDistance, TriangleMesh
from .surface import ContactSurface
from .tool import Obstacle, Tool, as_tool

#: Fraction of half its thickness by which a tool may move in a step of a given length.
LARGEST_SHARE = 0.5
#: A tool that has to catch up with its keyframes moves at this many times their highest speed.
CATCHING_UP = 2.0


def have_edges(obstacles: Sequence[Obstacle]) -> bool:
    """Whether any obstacle can pass between the nodes of a body; a half-space cannot."""
    return any(not isinstance(each.shape if isinstance(each, Tool) else each, Ground) for each in obstacles)


class Obstacles:
    """Obstacles of all worlds; each may have a different place in each world.

    Args:
        given: Shapes and tools.
        friction: Friction of obstacles without their own.
        system: The simulation's system.
        dt: The length of a step, if it was given [s].

    Attributes:
        system: The system.
        given: The obstacles, as they were given.
        tools: All of them as tools.
        shapes, motions: Their structs for kernels.
        thinnest: Half of the shortest way through any of them [m].
        revision: Changes whenever launches do.

    Raises:
        InputError: Something is not an obstacle, another simulation has a tool, an obstacle is given twice, or a tool
            is too fast for the given step.
    """

    def __init__(self, given: Sequence[Obstacle], friction: float, system: System, dt: float | None = None):
        self.given = tuple(given)
        self.tools = [as_tool(each) for each in given]
        if len(set(map(id, given))) < len(given):
            raise InputError("an obstacle is given twice; each must be named once")
        self.worlds, self.device, self.system = system.worlds, system.device, system
        self.revision = 0
        self._meshes: list[wp.Mesh] = []
        self.shapes = self._shapes([tool.shape for tool in self.tools], friction)
        self.thinnest = min((tool.shape.thickness for tool in self.tools), default=np.inf)
        count = max(len(self.tools), 1)
        motions, device = kernels.Motions(), self.device
        motions.mode, motions.first, motions.keys = (wp.zeros(count, dtype=wp.int32, device=device) for _ in range(3))
        motions.speed = wp.zeros((self.worlds, len(self.tools)), dtype=wp.float32, device=device)
        reach = [min(tool.shape.reach, 1e6) for tool in self.tools]
        motions.reach = wp.array(reach or [0.0], dtype=wp.float32, device=device)
        poses = np.array([_first_pose(tool) for tool in self.tools]).reshape(-1, 7)
        everywhere = np.broadcast_to(poses, (self.worlds, len(self.tools), 7)).astype(np.float32)
        self.initial, motions.now, motions.later, motions.target = (
            wp.array(everywhere, dtype=wp.transform, device=device) for _ in range(4)
        )
        self.motions = motions
        self.wrenches: wp.array = wp.zeros((self.count, self.worlds), dtype=wp.spatial_vectorf, device=device)
        self._keys, self._dt = -1, dt
        self.update()
        self._bind()

    @property
    def count(self) -> int:
        return len(self.tools)

    @property
    def have_edges(self) -> bool:
        """Whether any of them can pass between the nodes of a body."""
        return have_edges(self.tools)

    @property
    def state(self) -> dict[str, wp.array]:
        """The arrays of their poses."""
        return {"later": self.motions.later, "target": self.motions.target} if self.tools else {}

    def update(self) -> None:
        """Update the motion of the tools.

        Raises:
            InputError: A tool is too fast for the given step.
        """
        rates = [tool.fastest() / tool.shape.thickness for tool in self.tools]
        if self._dt is not None and max(rates, default=0.0) * self._dt > LARGEST_SHARE:
            fastest = self.tools[int(np.argmax(rates))]
            longest = 0.995 * LARGEST_SHARE / max(rates)  # still short enough once it is rounded to three digits
            raise InputError(
                f"a {fastest!r} goes {1e3 * fastest.fastest() * self._dt:.3g} mm in a step, and bodies may pass "
                f"through it; make it slower, or take a dt of at most {longest:.3g} s"
            )
        mode, first, keys, speed = [], [], [], []
        times, poses = [np.zeros(1)], [np.zeros((1, 7))]
        placed = 1
        for tool in self.tools:
            own = tool.keys
            mode.append(kernels.KEYED if own is not None else kernels.SENT if tool.is_sent else kernels.FIXED)
            first.append(placed)
            keys.append(0 if own is None else len(own[0]))
            speed.append(CATCHING_UP * tool.fastest() if own is not None and tool.fastest() > 0.0 else tool.speed)
            if own is not None:
                times.append(own[0])
                poses.append(own[1])
                placed += len(own[0])
        motions = self.motions
        for array, values in ((motions.mode, mode), (motions.first, first), (motions.keys, keys)):
            array[: len(values)].assign(np.array([int(value) for value in values], np.int32))
        motions.speed.assign(np.broadcast_to(np.array(speed, np.float32), motions.speed.shape))
        if placed != self._keys:
            motions.times = wp.empty(placed, dtype=wp.float64, device=self.device)
            motions.poses = wp.empty(placed, dtype=wp.transform, device=self.device)
            self._keys = placed
        motions.times.assign(np.concatenate(times))
        motions.poses.assign(np.vstack(poses).astype(np.float32))
        self.system.motion_rates[:1].fill_(max(rates, default=0.0))
        self.revision += 1

    def let_go(self) -> None:
        """Let another simulation have the tools."""
        for tool in self.tools:
            tool.unbind()

    def take_back(self) -> None:
        """Have the tools again."""
        self.let_go()
        self._bind()

    def continue_from(self, former: Obstacles) -> None:
        """Take the places of another simulation's obstacles that are also here, now and after a reset."""
        here = [number for number, each in enumerate(self.given) if each in former.given]
        there = [former.given.index(self.given[number]) for number in here]
        arrays = [(self.initial, former.initial)]
        arrays += [(getattr(self.motions, name), getattr(former.motions, name)) for name in ("now", "later", "target")]
        for mine, other in arrays:
            poses = np.array(mine.numpy())
            poses[:, here] = other.numpy()[:, there]
            mine.assign(poses)

    def send(self, number: int, pose: npt.NDArray[np.float64]) -> None:
        """Send a tool to a place in all worlds."""
        given = wp.array(pose.astype(np.float32).reshape(1, 7), dtype=wp.transform, device=self.device)
        inputs = [given, number, self.motions.target]
        wp.launch(kernels.take_targets, self.worlds, inputs, device=self.device)

    def launch_targets(self) -> None:
        """Launch the targets of tools that follow an array on the device."""
        for number, tool in enumerate(self.tools):
            if tool.poses is not None:
                if tool.poses.device != self.device or len(tool.poses) not in (1, self.worlds):
                    raise InputError(
                        f"poses is [{len(tool.poses)}] on {tool.poses.device}; it must be [1] or [{self.worlds}] on "
                        f"{self.device}"
                    )
                inputs = [tool.poses, number, self.motions.target]
                wp.launch(kernels.take_targets, self.worlds, inputs, device=self.device)

    def launch_motion(self, offset: int, watch: Watch) -> None:
        """Launch the motion of obstacles in an implicit step.

        Args:
            offset: The number of steps since the clock was last advanced.
            watch: The motion since the last search.
        """
        self.launch_targets()
        pace, starts = self.system.pace.arrays, self.system.bodies[0].conditions.world_starts
        inputs = [self.motions, pace, starts, offset, watch]
        wp.launch(move_obstacles, (self.worlds, self.count), inputs, device=self.device)

    def reset(self, chosen: wp.array) -> None:
        """Put the obstacles of chosen worlds back to where they began."""
        if self.tools:
            inputs = [chosen, self.initial, self.motions]
            wp.launch(kernels.reset_obstacles, (self.worlds, self.count), inputs, device=self.device)

    def gaps(self, points: npt.NDArray[np.float64], most: float, world: int = 0) -> npt.NDArray[np.float32]:
        """Distances of points [m], [n, 3], from the obstacles of one world [m], negative inside, [O, n]; only
        those of less than ``most`` are exact. Waits for the device."""
        numbers = np.arange(self.count)
        everywhere = np.broadcast_to(points, (self.count, *points.shape))
        return measured_gaps(self.shapes, self.motions.later, numbers, np.full(self.count, world), everywhere, most)[0]

    def poses(self) -> npt.NDArray[np.float64]:
        """Their poses, float64 [worlds, O, 7]; waits for the device."""
        return self.motions.later.numpy().astype(np.float64)

    def wrench(self, number: int) -> wp.array:
        """The wrench on one of them [N, N m], spatial vectors [worlds]."""
        return self.wrenches[number]

    def _bind(self) -> None:
        for number, tool in enumerate(self.tools):
            tool.bind(self, number)
            if isinstance(each := self.given[number], Shape):
                each.felt = tool

    def _shapes(self, shapes: Sequence[Shape], friction: float) -> Shapes:
        device = self.device
        made = Shapes()
        made.kind = wp.array([shape.kind for shape in shapes], dtype=wp.int32, device=device)
        made.size = wp.array(np.array([shape.size for shape in shapes]).reshape(-1, 3), dtype=wp.vec3, device=device)
        own = [friction if shape.friction is None else shape.friction for shape in shapes]
        made.friction = wp.array(own, dtype=wp.float32, device=device)
        thickness = [min(shape.thickness, 1e6) for shape in shapes]
        made.thickness = wp.array(thickness, dtype=wp.float32, device=device)
        count = max(len(shapes), 1)
        source, first = np.zeros(count, np.uint64), np.zeros(count, np.int32)
        counts, lower, values = np.zeros((count, 3), np.int32), np.zeros((count, 3)), [np.zeros(1, np.float32)]
        for k, shape in enumerate(shapes):
            if isinstance(shape, TriangleMesh):
                mesh = wp.Mesh(
                    wp.array(shape.points, dtype=wp.vec3, device=device),
                    wp.array(shape.triangles.ravel(), dtype=wp.int32, device=device),
                )
                self._meshes.append(mesh)
                source[k] = mesh.id
            elif isinstance(shape, SignedDistance):
                first[k], counts[k], lower[k] = sum(map(len, values)), shape.values.shape, shape.lower
                values.append(shape.values.ravel())
        made.source = wp.array(source, dtype=wp.uint64, device=device)
        made.first = wp.array(first, dtype=wp.int32, device=device)
        made.count = wp.array(counts, dtype=wp.vec3i, device=device)
        made.lower = wp.array(lower, dtype=wp.vec3, device=device)
        made.values = wp.array(np.concatenate(values), dtype=wp.float32, device=device)
        return made


def measured_gaps(
    shapes: Shapes,
    poses: wp.array,
    obstacles: npt.ArrayLike,
    worlds: npt.ArrayLike,
    points: npt.NDArray[np.float64],
    most: float = 1.0,
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Distances of points from obstacles [m], [n, k], and the directions out of these, [n, k, 3]; waits for the device.

    Args:
        shapes, poses: The obstacles, and their poses [worlds, O].
        obstacles, worlds: The number of an obstacle and of its world for each row of points, [n].
        points: [m], [n, k, 3].
        most: Larger distances are only known to be larger.
    """
    device = poses.device
    numbers = [wp.array(each, dtype=wp.int32, device=device) for each in (obstacles, worlds)]
    asked = wp.array(points, dtype=wp.vec3, device=device)
    gaps, normals = (wp.zeros(asked.shape, dtype=dtype, device=device) for dtype in (wp.float32, wp.vec3))
    wp.launch(measure_gaps, asked.shape, [shapes, poses, *numbers, asked, most], [gaps, normals], device=device)
    return gaps.numpy(), normals.numpy()


def _first_pose(tool: Tool) -> npt.NDArray[np.float64]:
    """The pose of a tool at time zero."""
    if tool.keys is None:
        return tool.pose
    times, poses = tool.keys
    key = int(np.clip(np.searchsorted(times, 0.0, side="right") - 1, 0, len(times) - 2))
    share = float(np.clip((0.0 - times[key]) / (times[key + 1] - times[key]), 0.0, 1.0))
    turned = poses[key + 1, 3:] * (1.0 if poses[key, 3:] @ poses[key + 1, 3:] >= 0.0 else -1.0)
    pose = np.concatenate([poses[key, :3], poses[key, 3:]])
    pose[:3] += share * (poses[key + 1, :3] - poses[key, :3])
    pose[3:] += share * (turned - poses[key, 3:])
    pose[3:] /= np.linalg.norm(pose[3:])
    return pose


# --- forces -----------------------------------------------------------------------------------------------------------


class RigidForces:
    """Forces of obstacles.

    Args:
        surface: The bodies' surfaces.
        obstacles: The obstacles.
        search: The search for nearby surfaces.
        law: The law of contact: how far gaps may close in a step.

    Attributes:
        rows: Obstacles at places and at triangles, one after another, as a struct for kernels.
        totals: The forces of each obstacle on each node with the nodes' shares of those between them, when they were
            last published [N], vec3 [O, S].
        have_edges: Whether any of the obstacles can pass between the nodes.
    """

    def __init__(self, surface: ContactSurface, obstacles: Obstacles, search: Search, law: Law):
        self.surface, self.obstacles, self.search, self.device = surface, obstacles, search, surface.device
        self._law, self._taken = law, -1
        self.have_edges = obstacles.have_edges
        search.rigid = self
        self.follow()

    def follow(self) -> None:
        """Update to the present surfaces."""
        if self.surface.revision == self._taken:
            self.forget()
            return
        self._taken, device = self.surface.revision, self.device
        count, obstacles = self.surface.count, self.obstacles.count
        of_places, of_triangles = obstacles * count, obstacles * self.surface.triangle_count * self.have_edges
        self.anchors = wp.zeros(of_places, dtype=wp.vec4, device=device)
        self.allowance = wp.zeros(of_places + of_triangles, dtype=wp.float32, device=device)
        self.rows = rows_of(of_places + of_triangles, device)
        # Places keep these.
        self.rows.weights[:of_places].fill_(wp.vec4(1.0, 0.0, 0.0, 0.0))
        self.rows.friction[:of_places].assign(np.repeat(self.obstacles.shapes.friction.numpy(), count))
        self.totals = wp.zeros((obstacles, count), dtype=wp.vec3, device=device)

    @property
    def arrays(self) -> Rigid:
        """The obstacles, the surfaces and what is between them, as a struct for kernels."""
        rigid = Rigid()
        rigid.shapes, rigid.motions, rigid.law = self.obstacles.shapes, self.obstacles.motions, self._law
        rigid.surface, rigid.first_triangle = self.surface.arrays, self.totals.size
        rigid.anchors, rigid.allowance, rigid.rows = self.anchors, self.allowance, self.rows
        return rigid

    @property
    def forces(self) -> wp.array:
        """The force of each obstacle on each surface node itself in the last step [N], vec3 [O, S]."""
        return self.rows.force[: self.totals.size].reshape(self.totals.shape)

    @property
    def touch_count(self) -> int:
        """Number of obstacles at triangles."""
        return len(self.rows.force) - self.totals.size

    @property
    def is_separate(self) -> bool:
        """Whether no two contacts of obstacles share a place."""
        return not self.have_edges and self.obstacles.count == 1

    def forget(self) -> None:
        """Forget the last step."""
        for array in (self.anchors, self.allowance, self.rows.force):
            array.zero_()

    def reset(self, chosen: wp.array) -> None:
        """Forget the last step in chosen worlds, nonzero in int32 [worlds]."""
        wp.launch(sums.forget_rows, len(self.rows.force), [chosen, self.arrays], device=self.device)

    @property
    def state(self) -> dict[str, wp.array]:
        """The arrays that it keeps from step to step."""
        rows = self.rows
        return {"anchors": self.anchors, "allowance": self.allowance, "force": rows.force, "normal": rows.normal}

    def parts(self, name: str) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
        """Copies of an array of ``state``: at places, [O, S, ...], and at triangles, [O, T, ...]; waits for the
        device."""
        return split_rows(np.array(self.state[name].numpy()), *self.totals.shape)

    def assign(self, parts: dict[str, tuple[npt.NDArray[Any], npt.NDArray[Any]]]) -> None:
        """Set arrays of ``state`` to what ``parts`` gave."""
        for name, array in self.state.items():
            if name in parts:
                array.assign(np.concatenate([each.reshape(-1, *each.shape[2:]) for each in parts[name]]))

    def launch_totals(self) -> wp.array:
        """Launch the sums of all forces of each obstacle on each node, [O, S]."""
        if not self.have_edges:
            return self.forces
        wp.launch(sums.share_touches, self.totals.shape, [self.arrays], [self.totals], device=self.device)
        return self.totals


def split_rows(rows: npt.NDArray[Any], obstacles: int, places: int) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
    """Views of values of obstacles' rows: at places, [O, S, ...], and at triangles, [O, T, ...]."""
    at = obstacles * places
    count = (len(rows) - at) // obstacles
    return rows[:at].reshape(obstacles, places, *rows.shape[1:]), rows[at:].reshape(obstacles, count, *rows.shape[1:])
