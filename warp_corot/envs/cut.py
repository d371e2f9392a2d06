"""A precise cut: one body with a blade, whose mesh changes as it is cut."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.body.soft_body import SoftBody
from warp_corot.contact.shapes import Capsule
from warp_corot.cutting.blade import Blade
from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_count, checked_device, shown
from warp_corot.materials.isotropic import Isotropic
from warp_corot.mesh.forest import TetForest
from warp_corot.simulation.simulation import Simulation
from warp_corot.solvers import SymplecticEuler

from .picture import draw
from .soft_env import DAMPING, DENSITY, POISSON, RATE, TOOL_PARTS
from .task import Actions, checked_ranges, columns_of

#: Edges of the tissue, which is stretched along x and held at both ends [m]; the blade's largest speed along each axis
#: [m/s].
SHEET, SPEED = (0.048, 0.032, 0.016), 0.06
#: Ends of the edge below and above the blade's origin [m].
EDGE = (-0.004, 0.03)
#: Mean distances of the cut from the line with which it succeeds, and at which it has failed [m].
PRECISE, ASTRAY = 0.001, 0.003
#: The least share of the way that is cut when the tissue has come apart.
WHOLE = 0.9


class Cut(gymnasium.Env[Actions, Actions]):
    """A blade cuts stretched tissue in two along a line.

    The line goes from the front to the back of the upper side. Actions: velocity of the blade along x, y and z, over
    0.06 m/s. It succeeds when the tissue has come apart and the cut's faces are less than 1 mm from the line in the
    mean; a mean of 3 mm ends the episode. Observed: position, velocity, force and torque of the blade; ``line``, where
    the line's ends are now; ``time``; ``share``, the area that is cut over that of the way along the line; and
    ``astray``, the mean distance of the cut from the line [m].

    A cut makes nodes and elements, and bodies of several worlds have one mesh. So this is an environment with one body;
    ``gymnasium.make_vec("warp_corot/Cut-v0", num_envs=4)`` steps several of them one after another.

    Args:
        ranges, max_episode_steps, device, threads, render_mode: As for ``SoftEnv``.
        level: Level of the mesh: more is finer.

    Raises:
        InputError: An argument has another type or value, or a range is not among ``RANGES``.
    """

    RANGES: Mapping[str, tuple[float, float]] = {
        **{
            "young": (1e4, 4e4),
            "toughness": (2.0, 6.0),
            "stretch": (0.05, 0.1),
            "front": (0.018, 0.03),
            "back": (0.018, 0.03),
        },
        **{"start_x": (0.014, 0.034), "start_y": (-0.02, -0.012), "start_z": (0.0, 0.01)},
    }
    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": RATE}  # noqa: RUF012 (gymnasium's)

    def __init__(
        self,
        *,
        ranges: Mapping[str, tuple[float, float]] | None = None,
        max_episode_steps: int = 200,
        device: str | wp.Device | None = None,
        threads: int | None = None,
        render_mode: str | None = None,
        level: int = 6,
    ):
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise InputError(f"render_mode is {shown(render_mode)}; it must be 'rgb_array' or None")
        self.ranges, self.device = checked_ranges(self.RANGES, ranges), checked_device(device)
        self.max_episode_steps = checked_count(max_episode_steps, "max_episode_steps", least=1)
        self.render_mode, self._threads, self._level = render_mode, threads, level
        parts = {f"tool0.{name}": 3 for name in TOOL_PARTS}
        self.columns = columns_of({**parts, "line": 6, "time": 1, "share": 1, "astray": 1})
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (3,), np.float32)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (21,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Actions, dict[str, Any]]:
        """Begin a new episode, with another tissue, line and place of the blade."""
        super().reset(seed=seed)
        low, high = np.array(list(self.ranges.values())).T
        self.drawn = dict(zip(self.ranges, self.np_random.uniform(low, high).tolist(), strict=True))
        given = self.drawn
        material = Isotropic(given["young"], POISSON, DENSITY, toughness=given["toughness"])
        mesh = TetForest.box((3, 2, 1), 0.016, level=self._level)
        self.body = SoftBody(mesh, material, device=self.device, threads=self._threads)
        self.body.displacements = (mesh.points - 0.5 * np.array(SHEET)) * [given["stretch"], 0.0, 0.0]
        self.body.fix("x == xmin or x == xmax")
        self._place = np.array([given["start_x"], given["start_y"], given["start_z"]])
        self.blade = Blade([(0.0, 0.0, z) for z in EDGE], position=tuple(self._place), speed=2.0 * SPEED)
        steps = SymplecticEuler(damping=DAMPING)
        self.sim = Simulation(self.body, integrator=steps, gravity=(0.0, 0.0, -9.81), cuts=[self.blade])
        self._ends = np.array([[given["front"], 0.0, SHEET[2]], [given["back"], SHEET[1], SHEET[2]]])
        away = np.linalg.norm(mesh.points[:, None] - self._ends, axis=2)
        self._nodes = np.argmin(away, axis=0)
        self._beside = self._ends - mesh.points[self._nodes]
        self._step, self._share, self._astray, self._velocity = 0, 0.0, 0.0, np.zeros(3)
        return self._observed(), {}

    def step(self, action: Actions) -> tuple[Actions, float, bool, bool, dict[str, Any]]:
        """Move the blade for 1/50 s. The reward is 10 for the whole way, less where the cut is off the line; -0.02 for
        each step; and 10 for success. ``info["success"]`` says whether it succeeded."""
        way = np.clip(np.nan_to_num(np.asarray(action, np.float64)), -1.0, 1.0) * (SPEED / RATE)
        before = self._place
        self._place = np.clip(before + way, [0.0, -0.03, EDGE[0]], [SHEET[0], SHEET[1] + 0.03, 0.03])
        self._velocity = (self._place - before) * RATE
        self.blade.move(tuple(self._place))
        self.sim.advance(1.0 / RATE)
        self._step += 1
        share = self.body.cut_area / (SHEET[2] * float(np.linalg.norm(np.diff(self._ends, axis=0))))
        gain, self._share = share - self._share, share
        if gain > 0.0:
            self._astray = self._mean_distance()
        fails = self._astray > ASTRAY
        # Not a crumb.
        success = self.body.pieces > 1 and share > WHOLE and self._astray < PRECISE
        reward = 10.0 * gain * (1.0 - self._astray / ASTRAY) - 0.02 + 10.0 * success
        is_over, is_late = bool(success or fails), self._step >= self.max_episode_steps
        return self._observed(), reward, is_over, is_late and not is_over, {"success": success}

    def render(self) -> npt.NDArray[np.uint8] | None:
        """A picture, uint8 [height, width, 3]; None without a render mode."""
        if self.render_mode is None:
            return None
        edge = Capsule(0.0006, EDGE[1] - EDGE[0])
        pose = np.array([*self._place[:2], self._place[2] + 0.5 * sum(EDGE), 0.0, 0.0, 0.0, 1.0])
        window = ((-0.005, -0.01, 0.0), (0.053, 0.035, 0.035))
        return draw(self.sim, self.body.mesh, [(edge, pose)], window, (-60.0, 35.0))

    def scripted_actions(self, observation: Actions) -> Actions:
        """Actions of a policy by hand: before the line, down, and along it."""
        blade, line = (observation[self.columns[name]] for name in ("tool0.position", "line"))
        front, back = line[:2], line[3:5]
        along = (back - front) / np.linalg.norm(back - front)
        across = np.array([-along[1], along[0]])
        ahead, off = (blade[:2] - front) @ along, (blade[:2] - front) @ across
        if ahead > -0.003 or (ahead > -0.0065 and abs(off) < 0.0005 and blade[2] < 0.0005):
            way = np.array([*(0.001 * along - 0.5 * off * across), -blade[2]])
        else:
            way = np.array([*(front - 0.006 * along), 0.0]) - blade
        return np.clip(way * (RATE / SPEED), -1.0, 1.0).astype(np.float32)

    # --- pieces ----------------------------------------------------------------------------------------------------

    def _mean_distance(self) -> float:
        """The mean distance of the cut's faces from the vertical plane of the line, at rest [m]."""
        mesh = self.body.mesh
        assert isinstance(mesh, TetForest)
        surface = mesh.surface()
        corners = surface.points[surface.triangles[surface.of_cut]]
        a, b = self._ends[:, :2]
        normal = np.array([b[1] - a[1], a[0] - b[0]]) / np.linalg.norm(b - a)
        areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        # One of a few faces may not have come apart from the others yet.
        return float(np.abs((corners.mean(axis=1)[:, :2] - a) @ normal) @ areas / max(areas.sum(), 1e-30))

    def _observed(self) -> Actions:
        ends = self.body.positions.numpy()[self._nodes] + self._beside
        wrench = self.blade.wrench.numpy()[0] if self._step else np.zeros(6)
        numbers = [self._step / self.max_episode_steps, self._share, self._astray]
        return np.concatenate([self._place, self._velocity, wrench, ends.ravel(), numbers]).astype(np.float32)
