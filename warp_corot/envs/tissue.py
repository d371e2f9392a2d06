"""Tasks with tissue and one tool: retraction, palpation, reaching without bruising, and threading a tube."""

from __future__ import annotations

import numpy as np
import warp as wp

from warp_corot.contact.shapes import Box, Capsule, Ground, Sphere
from warp_corot.contact.tool import Tool
from warp_corot.kernels.envs import tasks

from .soft_env import RATE, SoftEnv
from .task import Actions, Scene, Task, box, nodes_at, symmetric


class Retract(SoftEnv):
    """A gripper takes a flap of tissue by its rim and lifts it to a goal, as a surgeon retracts tissue.

    The flap lies on a ground and is held along one side. Actions: velocity of the gripper along x, y and z, over 0.1
    m/s, and whether it is closed. It succeeds when the middle of the rim has been within 5 mm of the goal for 10 steps.
    Observed points: the middle and the two corners of the rim.
    """

    #: Edges of the flap, and the radius of the gripper and how far it takes hold [m].
    FLAP, RADIUS, REACH = (0.072, 0.048, 0.008), 0.004, 0.009
    task = Task(
        ranges={
            "young": (5e3, 2e4),
            **symmetric(shift_x=0.005, shift_y=0.005, turn=0.15, start_x=0.015, start_y=0.015),
            **{"start_z": (0.015, 0.03), "goal_x": (-0.025, -0.01), "goal_y": (-0.008, 0.008), "goal_z": (0.02, 0.035)},
        },
        begin=tasks.begin_retraction,
        begun=(wp.vec3(FLAP[0], 0.5 * FLAP[1], FLAP[2]),),
        judge=tasks.judge_retraction,
        judged=(0.005, REACH, 10, 10.0),
        actions=4,
        speed=0.1,
        workspace=((-0.02, -0.03, 0.002), (0.11, 0.08, 0.09)),
        notes={"goal": 3, "closed": 1},
        window=((0.0, -0.01, 0.0), (0.09, 0.06, 0.06)),
        view=(-35.0, 20.0),
    )

    def make_scene(self) -> Scene:
        mesh = box((9, 6, 1), self.FLAP, self.cells)
        x, y, z = self.FLAP
        points = nodes_at(mesh, [(x, 0.5 * y, z), (x, 0.0, z), (x, y, z)])
        gripper = Tool(Sphere(self.RADIUS, position=(x, 0.5 * y, 0.03)), speed=2.0 * self.task.speed)
        rim = mesh.points[:, 0] > x - 1e-6
        centre = (0.0, 0.5 * y, 0.0)
        return Scene(mesh, "x == xmin", [gripper], [Ground()], points, centre, gripped=rim, reach=self.REACH)

    def scripted_actions(self, observations: Actions) -> Actions:
        gripper, goal, points, closed = self.seen(observations, "tool0.position", "goal", "points", "closed")
        site = points[:, :3]
        above = site + np.array([0.0, 0.0, 0.0045])
        near = np.linalg.norm(gripper - above, axis=1) < 0.002
        beside = np.linalg.norm((gripper - above)[:, :2], axis=1) > 0.003
        aim = np.where(beside[:, None], above + np.array([0.0, 0.0, 0.008]), above)
        way = np.where(closed > 0.0, goal - site, aim - gripper)
        speed = np.where(closed > 0.0, 0.6, 1.0) * np.minimum(1.0, 30.0 * np.abs(way) / self.task.speed)
        closing = np.where((closed[:, 0] > 0.0) | near, 1.0, -1.0)
        return np.column_stack([np.sign(way) * speed, closing]).astype(np.float32)


class Palpate(SoftEnv):
    """A round probe finds a stiff lump inside tissue by the force that it feels.

    Actions: velocity of the probe along x, y and z, over 0.06 m/s. It succeeds when the probe has pressed within 8 mm
    of the lump, seen from above, with 0.1 N or more for 25 steps. The lump itself is not observed, but the largest
    force of the episode is, and where it was. Observed points: the corners of the upper side.
    """

    #: Edges of the tissue, the radius of the probe and its first height [m].
    TISSUE, RADIUS, HEIGHT = (0.06, 0.06, 0.02), 0.008, 0.035
    #: Height of the probe while the scripted policy searches, and the corners of its way [m].
    DEPTH = 0.0245
    ROUTE = [(0.012, 0.016), (0.048, 0.016), (0.048, 0.03), (0.012, 0.03), (0.012, 0.044), (0.048, 0.044)]  # noqa: RUF012
    task = Task(
        ranges={
            "young": (4e3, 8e3),
            **symmetric(shift_x=0.003, shift_y=0.003, turn=0.1),
            **{"lump_x": (0.016, 0.044), "lump_y": (0.016, 0.044), "lump_z": (0.011, 0.013)},
            **{"radius": (0.009, 0.011), "ratio": (7.0, 9.0)},
        },
        begin=tasks.begin_palpation,
        begun=(wp.vec3(0.5 * TISSUE[0], 0.5 * TISSUE[1], HEIGHT),),
        judge=tasks.judge_palpation,
        judged=(0.008, 0.1, 25, 10.0),
        actions=3,
        speed=0.06,
        workspace=((0.0, 0.0, 0.022), (0.06, 0.06, 0.04)),
        notes={"largest_force": 1, "largest_at": 2},
        steps=300,
        window=((-0.005, -0.005, 0.0), (0.065, 0.065, 0.04)),
        view=(30.0, 25.0),
    )

    def make_scene(self) -> Scene:
        mesh = box((6, 6, 2), self.TISSUE, self.cells)
        x, y, z = self.TISSUE
        points = nodes_at(mesh, [(0.0, 0.0, z), (x, 0.0, z), (0.0, y, z), (x, y, z)])
        probe = Tool(Sphere(self.RADIUS, position=(0.5 * x, 0.5 * y, self.HEIGHT)), speed=2.0 * self.task.speed)
        return Scene(mesh, "z == zmin", [probe], [], points, (0.5 * x, 0.5 * y, 0.0), friction=0.05)

    def scripted_actions(self, observations: Actions) -> Actions:
        probe, time, largest_at = self.seen(observations, "tool0.position", "time", "largest_at")
        corners = np.array([(x, y, self.DEPTH) for x, y in self.ROUTE])
        # When the probe arrives at each corner, with a little time to spare.
        ways = np.abs(np.diff(np.vstack([self.task.begun[0], corners]), axis=0)).max(axis=1)
        arrivals = np.cumsum(np.ceil(ways / self.task.speed * RATE) + 2)
        at = np.searchsorted(arrivals, np.rint(time[:, 0] * self.max_episode_steps), side="right")
        found = np.column_stack([largest_at, np.full(len(probe), self.DEPTH)])
        aim = np.where((at < len(corners))[:, None], corners[np.minimum(at, len(corners) - 1)], found)
        return self.toward(aim - probe)


class Reach(SoftEnv):
    """A thin tool goes down into a channel of tissue, narrower than itself, and must not bruise it.

    Actions: velocity of the tool along x, y and z, over 0.06 m/s. It succeeds when its tip has been within 2 mm of the
    goal for 5 steps; a von Mises stress of more than 6 kPa in any element ends the episode as a bruise. The largest
    stress over that bound is observed. Observed points: the four upper ends of the channel's edges.
    """

    #: Edges of the tissue, the width of its channel, the tool's radius and half its length [m], and the stress [Pa].
    TISSUE, CHANNEL, RADIUS, HALF, BRUISE = (0.04, 0.024, 0.024), 0.008, 0.005, 0.02, 6e3
    CENTRE = wp.vec3(0.5 * TISSUE[0], 0.5 * TISSUE[1], 0.0)
    task = Task(
        ranges={
            "young": (5e3, 1.5e4),
            **symmetric(shift_x=0.005, shift_y=0.003, turn=0.25, start_x=0.01, start_y=0.005),
            **{"start_z": (0.0, 0.006), "goal_y": (-0.005, 0.005), "goal_z": (0.011, 0.014)},
        },
        begin=tasks.begin_reach,
        begun=(CENTRE, CENTRE + wp.vec3(0.0, 0.0, 0.032 + HALF), HALF),
        judge=tasks.judge_reach,
        judged=(0.002, BRUISE, 5, 10.0),
        actions=3,
        speed=0.06,
        workspace=((-0.01, -0.01, 0.03), (0.05, 0.034, 0.07)),
        notes={"goal": 3, "stress": 1},
        feels_stress=True,
        window=((-0.005, -0.005, 0.0), (0.045, 0.03, 0.07)),
        view=(25.0, 20.0),
    )

    def make_scene(self) -> Scene:
        x, y, z = self.TISSUE
        left, right = 0.5 * (x - self.CHANNEL), 0.5 * (x + self.CHANNEL)
        without = lambda p: (left < p[:, 0]) & (p[:, 0] < right) & (p[:, 2] > 0.008)  # noqa: E731
        mesh = box((5, 3, 3), self.TISSUE, self.cells, without)
        points = nodes_at(mesh, [(left, 0.0, z), (right, 0.0, z), (left, y, z), (right, y, z)])
        shape = Capsule(self.RADIUS, 2.0 * self.HALF, position=(0.5 * x, 0.5 * y, 0.055))
        tool = Tool(shape, speed=2.0 * self.task.speed)
        return Scene(mesh, "z == zmin", [tool], [], points, self.CENTRE, friction=0.1)

    def scripted_actions(self, observations: Actions) -> Actions:
        tool, goal = self.seen(observations, "tool0.position", "goal")
        off = np.abs(tool - goal)[:, :2].max(axis=1)
        clear = self.TISSUE[2] + self.RADIUS + self.HALF + 0.002
        # Over the channel first, and then slowly down.
        aim = np.where((off > 0.0005)[:, None] & (tool[:, 2:] > clear - 0.001), goal * [1, 1, 0] + [0, 0, clear], goal)
        return self.toward(aim - tool).clip([-1.0, -1.0, -0.4], None)


class Thread(SoftEnv):
    """A gripper that holds a soft tube by its upper end threads it over a peg.

    Actions: velocity of the gripper along x, y and z, over 0.1 m/s. It succeeds when the lower rim has been around the
    peg and less than 6 mm above the ground for 5 steps. Observed points: the four corners of the lower end's hole. The
    peg is observed as the second tool.
    """

    #: Edges of the tube and the width of its wall, and the gripper's height above the lower end [m].
    TUBE, WALL, ABOVE = (0.024, 0.024, 0.032), 0.008, 0.0345
    CENTRE = wp.vec3(0.5 * TUBE[0], 0.5 * TUBE[1], 0.0)
    #: Radius of the peg, half the length between the centres of its ends, and the height of its middle and top [m].
    PEG, HALF, MIDDLE = 0.0035, 0.012, 0.012
    TOP = MIDDLE + HALF + PEG
    task = Task(
        ranges={
            "young": (1e4, 3e4),
            **symmetric(shift_x=0.012, shift_y=0.012, turn=0.4),
            **{"height": (0.032, 0.04), "peg_x": (0.004, 0.02), "peg_y": (0.004, 0.02)},
        },
        begin=tasks.begin_threading,
        begun=(CENTRE, ABOVE),
        judge=tasks.judge_threading,
        judged=(4, 0.003, 0.006, TOP, 5, 10.0),
        actions=3,
        speed=0.1,
        workspace=((-0.03, -0.03, 0.03), (0.054, 0.054, 0.1)),
        window=((-0.015, -0.015, 0.0), (0.04, 0.04, 0.09)),
        view=(30.0, 15.0),
    )

    def make_scene(self) -> Scene:
        x, y, _ = self.TUBE
        without = lambda p: np.abs(p[:, :2] - 0.5 * x).max(axis=1) < 0.5 * x - self.WALL  # noqa: E731
        mesh = box((3, 3, 4), self.TUBE, self.cells, without)
        points = nodes_at(mesh, [(i, j, 0.0) for i in (self.WALL, x - self.WALL) for j in (self.WALL, y - self.WALL)])
        plate = Box((0.024, 0.024, 0.004), position=(0.5 * x, 0.5 * y, 0.09))
        peg = Tool(Capsule(self.PEG, 2.0 * self.HALF, position=(0.5 * x, 0.5 * y, self.MIDDLE)))
        tools = [Tool(plate, speed=2.0 * self.task.speed), peg]
        top = mesh.points[:, 2] > self.TUBE[2] - 1e-6
        return Scene(mesh, None, tools, [Ground()], points, self.CENTRE, gripped=top, reach=0.1, friction=0.1)

    def scripted_actions(self, observations: Actions) -> Actions:
        gripper, peg, points = self.seen(observations, "tool0.position", "tool1.position", "points")
        rim = points.reshape(-1, 4, 3).mean(axis=1)
        away = np.linalg.norm((peg - rim)[:, :2], axis=1)
        # Over the peg, and down once the tube hardly swings.
        way = np.clip(self.toward(peg - gripper, 0.5), -0.5, 0.5)
        way[:, 2] = np.where((away < 0.0015) | (rim[:, 2] < self.TOP), -0.4, 0.0)
        return way
