"""Lifting a soft block with a Franka arm, which Newton's MuJoCo solver moves."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.contact.shapes import Box, Capsule, Shape
from warp_corot.errors import InputError
from warp_corot.kernels.envs import arm as kernels

from .blocks import FINGER, NARROW, WIDE, Lift
from .soft_env import RATE

#: Exchanges of poses and wrenches between the arm and the tissue in each step.
EXCHANGES = 5
#: Pose of the arm's base: it looks along y, so that its fingers open along x.
BASE = wp.transform((0.015, -0.45, 0.0), (0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)))
#: Of the arm's links and its hand: mass [kg] and centre of mass [m].
LINKS = (
    *((4.97, (0.0, 0.0, -0.1)), (0.65, (0.0, -0.03, 0.03)), (3.23, (0.03, 0.03, -0.07)), (3.59, (-0.05, 0.1, 0.03))),
    *((1.23, (-0.01, 0.04, -0.11)), (1.67, (0.06, -0.01, -0.01)), (1.4, (0.0, 0.0, 0.1))),
)
#: Origins of the joints in the frame of the link before [m], and their turns about its x axis, in right angles.
ORIGINS = (
    *(((0.0, 0.0, kernels.SHOULDER), 0), ((0.0, 0.0, 0.0), -1), ((0.0, -kernels.UPPER, 0.0), 1)),
    *(((kernels.BESIDE, 0.0, 0.0), 1), ((-kernels.BESIDE, kernels.FORE, 0.0), -1), ((0.0, 0.0, 0.0), 1)),
    ((kernels.WRIST, 0.0, 0.0), 1),
)
#: What Newton calls the numbers of a controller.
MOTOR = ("target_ke", "target_kd", "effort_limit")
#: The controller of each joint: stiffness [N m/rad], damping [N m s/rad] and largest torque [N m].
GAINS = (*((4500.0, 160.0, 87.0),) * 2, *((3500.0, 120.0, 87.0),) * 2, *((2000.0, 50.0, 12.0),) * 3)
#: The same of a finger [N/m, N s/m, N], its mass [kg], and the inertia of motors at joints [kg m^2] and fingers [kg].
GRIP, FINGER_MASS, ARMATURE = (2000.0, 60.0, 20.0), 0.015, 0.1


class FrankaLift(Lift):
    """A Franka arm takes a soft block from the ground between its fingers and lifts it.

    As ``Lift``, but an arm with the lengths, the motors' bounds and about the masses of a Franka Panda moves the
    fingers, and bears the forces on them. Actions change what its controller wants of its joints: angles that move the
    fingers upright. Newton's ``SolverMuJoCo`` steps it, five times in each step of the environment, and each time takes
    the wrenches of contact. The arm touches nothing but with its fingers, and its controller carries its weight.

    Raises:
        InputError: MuJoCo-Warp is not installed.
    """

    exchanges = EXCHANGES
    task = replace(Lift.task, window=((-0.035, -0.02, 0.0), (0.065, 0.04, 0.1)), view=(25.0, 12.0))

    def _make_arrays(self, *, at_once: bool) -> None:
        super()._make_arrays(at_once=at_once)
        if find_spec("newton") is None or find_spec("mujoco_warp") is None:
            raise InputError('the arm needs Newton and MuJoCo-Warp: pip install "warp-corot[robots]"')
        import newton

        builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        builder.replicate(self._arm(newton), self.num_envs)
        model = builder.finalize(device=self.device)
        options = {"integrator": "implicitfast", "disable_contacts": True, "iterations": 10, "ls_iterations": 10}
        self.robot = newton.solvers.SolverMuJoCo(model, **options)
        self._states, self._control = (model.state(), model.state()), model.control()
        arms = self._arms = kernels.Arms()
        arms.base, arms.thickness = BASE, FINGER[0]
        arms.aims = wp.zeros(self.num_envs, dtype=wp.vec4, device=self.device)
        arms.wanted, arms.q, arms.qd = self._control.joint_target_q, self._states[0].joint_q, self._states[0].joint_qd
        self._bodies = model.body_count // self.num_envs
        self._fingers = wp.vec2i(self._bodies - 2, self._bodies - 1)

    @staticmethod
    def _arm(newton):
        """A builder of the arm."""
        builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        parent, joints = -1, list[int]()
        common = {"armature": ARMATURE, "actuator_mode": newton.JointTargetMode.POSITION}
        for (mass, centre), (place, turns), gains in zip(LINKS, ORIGINS, GAINS, strict=True):
            link = builder.add_link(mass=mass, com=centre, inertia=wp.mat33(np.eye(3) * 0.005 * mass))
            pose = wp.transform(place, wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), 0.5 * np.pi * turns))
            options = dict(zip(MOTOR, gains, strict=True), axis=(0.0, 0.0, 1.0), **common)
            joints.append(
                builder.add_joint_revolute(parent, link, parent_xform=pose if joints else BASE * pose, **options)
            )
            parent = link
        # Frames of the fingers are the world's while they point down; the hand is turned by an eighth of a turn.
        hand = wp.quat_to_matrix(wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), -0.25 * np.pi))
        down = wp.quat_from_matrix(hand @ wp.mat33(0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, -1.0))
        for side in (-1.0, 1.0):
            link = builder.add_link(mass=FINGER_MASS, inertia=wp.mat33(np.eye(3) * 1e-6))
            closed = wp.transform((0.5 * side * FINGER[0], 0.0, 0.0), wp.quat_identity())
            pose = wp.transform((0.0, 0.0, kernels.TIPS), down) * closed
            options = dict(
                zip(MOTOR, GRIP, strict=True), axis=(side, 0.0, 0.0), limit_lower=0.0, limit_upper=0.04, **common
            )
            joints.append(builder.add_joint_prismatic(parent, link, parent_xform=pose, **options))
        builder.add_articulation(joints)
        return builder

    def launch_actions(self) -> None:
        inputs = [*self._steering, NARROW, WIDE, self._arms, self.worlds]
        self._launch(kernels.steer_arms, self.num_envs, inputs)

    def launch_exchange(self) -> None:
        """Step the arm under the forces on its fingers, and send the tools to where these are then."""
        before, after = self._states
        given = [self._fingers, self._bodies, self._contact.obstacles.wrenches, before.body_f]
        self._launch(kernels.give_wrenches, (2, self.num_envs), given)
        self.robot.step(before, after, self._control, None, 1.0 / (RATE * EXCHANGES))
        wp.copy(before.joint_q, after.joint_q)
        wp.copy(before.joint_qd, after.joint_qd)
        taken = [self._fingers, self._bodies, after.body_q, self.worlds.targets]
        self._launch(kernels.take_poses, (2, self.num_envs), taken)

    def launch_places(self, chosen: wp.array) -> None:
        self._launch(kernels.begin_arms, self.num_envs, [chosen, self._arms, self.worlds])
        super().launch_places(chosen)

    def decorations(self, world: int) -> Iterator[tuple[Shape, npt.NDArray[np.float64]]]:
        poses = self._states[1].body_q.numpy().reshape(self.num_envs, -1, 7)[world].astype(np.float64)
        hand = poses[-2:, :3].mean(axis=0) + np.array([0.0, 0.0, 0.1])
        places = [np.array(BASE.p), *poses[[0, 3, 5, 6], :3], hand]
        for a, b, radius in zip(places[:-1], places[1:], (0.06, 0.055, 0.05, 0.045, 0.04), strict=True):
            along = wp.quat_between_vectors(wp.vec3(0.0, 0.0, 1.0), wp.normalize(wp.vec3(*(b - a))))
            yield Capsule(radius, float(np.linalg.norm(b - a))), np.array([*(0.5 * (a + b)), *along])
        yield Box((0.2, 0.06, 0.05)), np.array([*(hand - np.array([0.0, 0.0, 0.06])), 0.0, 0.0, 0.0, 1.0])
        for finger in poses[-2:]:
            yield Box((0.01, 0.02, 0.04)), np.array([*finger[:2], finger[2] + 0.03, *finger[3:]])
