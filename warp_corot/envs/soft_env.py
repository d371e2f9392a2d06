"""Environments in which a policy learns to handle soft tissue: many worlds of a simulation, stepped on one device."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
import warp as wp

try:
    from gymnasium.spaces import Box
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise ImportError('environments need gymnasium: pip install "warp-corot[envs]"') from error

from warp_corot.body.soft_body import SoftBody
from warp_corot.contact.contacts import Contacts
from warp_corot.contact.grasp import Grasp
from warp_corot.contact.obstacles import LARGEST_SHARE
from warp_corot.contact.options import Contact
from warp_corot.contact.shapes import Shape
from warp_corot.contact.tool import Obstacle
from warp_corot.discretization.discretization import centroids
from warp_corot.elasticity import Corotated
from warp_corot.errors import InputError, UnstableError
from warp_corot.inputs.checks import checked_choice, checked_count, checked_device, checked_flag, shown
from warp_corot.io.write.skins import poses_of, shape_of
from warp_corot.kernels.envs import episodes as kernels
from warp_corot.materials.isotropic import Isotropic
from warp_corot.simulation.simulation import Simulation
from warp_corot.solvers import BackwardEuler, Integrator, SymplecticEuler
from warp_corot.solvers.recorded import Segment

from .task import Actions, Scene, Task, checked_ranges, columns_of

#: Actions, observations, rewards and flags as arrays of these.
ARRAYS = ("numpy", "torch", "warp")
AUTORESETS = {"next_step": AutoresetMode.NEXT_STEP, "same_step": AutoresetMode.SAME_STEP}
INTEGRATORS = ("explicit", "implicit")
#: Steps of the environment in a second, and the least number of steps of implicit integrators in each of them.
RATE, IMPLICIT_STEPS = 50, 2
#: Explicit steps over the largest stable one of the stiffest tissue at rest: strained tissue is stiffer.
SAFETY = 0.6
#: Damping of explicit steps [1/s]: tissue in water and blood does not ring.
DAMPING = 20.0
DENSITY, POISSON = 1000.0, 0.4
#: Parts of a tool's observation, in the order of the kernel.
TOOL_PARTS = ("position", "velocity", "force", "torque")
#: A node that is so far from its place [m] is lost, and the episode ends.
FARTHEST = 1.0


class SoftEnv(VectorEnv):
    """Soft tissue and tools in several worlds, one for each environment, as a ``gymnasium.vector.VectorEnv``.

    A step takes 1/50 s. All of it is one recording of launches on the device: nothing is copied to the host, unless
    arrays are NumPy's. Worlds do not depend on one another: on the CPU with ``threads=1`` and explicit steps, world i
    of an environment with seed s gives bit for bit the episodes of a single one with seed s + i.

    Args:
        num_envs: The number of worlds.
        array: What actions, observations, rewards and flags are: "numpy", "torch" or "warp". The latter two are new
            arrays on the device.
        autoreset: "next_step": a world whose episode is over begins again in the next step, which ignores its action
            and has no reward. "same_step": in the same step, and ``info["final_obs"]`` has the last observations of all
            worlds.
        ranges: Lowest and highest values of numbers that are drawn for each episode, in place of those in
            ``task.ranges``.
        max_episode_steps: Steps after which an episode is cut off; None: the task's own.
        integrator: "explicit", or "implicit": two steps of ``BackwardEuler`` in each step, or more where tools could
            pass through tissue in one, without time steps that depend on the stiffest tissue.
        deterministic: Whether explicit steps on CUDA give the same result every time, which takes time; see
            ``Simulation``.
        device: The device; None for Warp's default.
        threads: As for ``SoftBody``.
        render_mode: "rgb_array": ``render`` draws worlds; or None.
        cells: Factor on the number of cubes along each edge of the task's mesh.

    Attributes:
        task: What the task declares.
        sim: The simulation, which users may look at; ``sim.body`` is the tissue.
        columns: The place of each named part of an observation.
        substeps: The number of time steps in a step of the environment.

    Raises:
        InputError: An argument has another type or value, or a range is not among the task's.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (gymnasium's)
        "render_modes": ["rgb_array"],
        "render_fps": RATE,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }
    task: ClassVar[Task]
    #: How often in a step tools are sent to new places.
    exchanges: ClassVar[int] = 1

    def __init__(
        self,
        num_envs: int = 1,
        *,
        array: str = "numpy",
        autoreset: str = "next_step",
        ranges: Mapping[str, tuple[float, float]] | None = None,
        max_episode_steps: int | None = None,
        integrator: str = "explicit",
        deterministic: bool = True,
        device: str | wp.Device | None = None,
        threads: int | None = None,
        render_mode: str | None = None,
        cells: int = 1,
    ):
        checked_choice(array, "array", ARRAYS)
        checked_choice(autoreset, "autoreset", tuple(AUTORESETS))
        checked_choice(integrator, "integrator", INTEGRATORS)
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise InputError(f"render_mode is {shown(render_mode)}; it must be 'rgb_array' or None")
        self.num_envs = checked_count(num_envs, "num_envs", least=1)
        self.cells = checked_count(cells, "cells", least=1)
        self.array, self.render_mode, self.device = array, render_mode, checked_device(device)
        self.metadata = {**self.metadata, "autoreset_mode": AUTORESETS[autoreset]}
        self.ranges = checked_ranges(self.task.ranges, ranges)
        steps = self.task.steps if max_episode_steps is None else max_episode_steps
        self.max_episode_steps = checked_count(steps, "max_episode_steps", least=1)
        self._threads = threads
        self._is_deterministic = checked_flag(deterministic, "deterministic") and integrator == "explicit"
        self._make_simulation(integrator)
        self._make_arrays(at_once=autoreset == "same_step")
        self.single_action_space = Box(-1.0, 1.0, (self.task.actions,), np.float32)
        self.single_observation_space = Box(-np.inf, np.inf, self.worlds.observations.shape[1:], np.float32)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self._seed(None)
        # Modules are loaded before launches are recorded.
        self._launch_beginning(self._asked)
        self.sim.step()
        self.sim.pace.is_shared = True
        self._launch_step()
        self._graphs: dict[Callable[[], None], wp.Graph] = {}
        self._revision = -1

    # --- what a task says ------------------------------------------------------------------------------------------

    @abstractmethod
    def make_scene(self) -> Scene:
        """What the task is made of."""

    @abstractmethod
    def scripted_actions(self, observations: Actions) -> Actions:
        """Actions of a policy by hand, which succeeds: float32 [n, A] for observations float32 [n, K]."""

    def launch_actions(self) -> None:
        """Launch what actions do to the targets of tools; here they steer the first one."""
        self._launch(kernels.steer, self.num_envs, [*self._steering, self.worlds])

    def launch_exchange(self) -> None:
        """Launch what a robot that moves the tools does, ``exchanges`` times in a step; here there is none."""

    def launch_places(self, chosen: wp.array) -> None:
        """Launch the placing of tools, and of a robot that moves them, in chosen worlds, int32 [worlds]."""
        inputs = [chosen, self.worlds.targets, self._contact.obstacles.motions]
        self._launch(kernels.place_tools, self.worlds.targets.shape, inputs)

    def decorations(self, world: int) -> Iterable[tuple[Shape, npt.NDArray[np.float64]]]:
        """What pictures show of a world beside tissue, tools and obstacles: shapes and their poses [7]."""
        return ()

    # --- as an environment -----------------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin new episodes.

        Args:
            seed: World i is seeded with ``seed + i``, or with the i-th of several seeds; None: worlds go on drawing
                from their seeds.
            options: ``{"reset_mask": bool [worlds]}`` resets only some worlds.

        Returns:
            Observations and ``{}``.

        Raises:
            InputError: The seeds or the mask have another length.
        """
        mask = np.ones(self.num_envs, bool)
        if options and "reset_mask" in options:
            mask = np.asarray(options["reset_mask"], bool)
            if mask.shape != (self.num_envs,):
                raise InputError(f"reset_mask has shape {mask.shape}; it must be [{self.num_envs}]")
        if seed is not None:
            super().reset(seed=seed if isinstance(seed, int) else None)
            self._seed(seed, mask)
        self._asked.assign(mask.astype(np.int32))
        self._replay(self._launch_reset)
        return self._given(self.worlds.observations), {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Make a step in all worlds.

        Args:
            actions: Within [-1, 1], float32 [worlds, A]: an array of NumPy, PyTorch or Warp. Values outside are
                clipped, and those that are not numbers count as zero.

        Returns:
            Observations [worlds, K], rewards [worlds], terminations and truncations, bool [worlds], and information:
            "success", bool [worlds], and "lost", int32 [worlds], nonzero where the tissue's state was not finite.

        Raises:
            InputError: The actions have another shape.
        """
        wp.copy(self.worlds.actions, self._taken(actions))
        if self._contact.is_full:
            # A world that flies apart is lost and begins again.
            with suppress(UnstableError):
                self._contact.grow()
        self._replay(self._launch_step)
        worlds = self.worlds
        info = {"success": self._given(worlds.success), "lost": self._given(worlds.lost)}
        if worlds.at_once:
            info["final_obs"] = self._given(self._final)
        given = worlds.observations, worlds.reward, worlds.terminated, worlds.truncated
        observations, rewards, terminated, truncated = map(self._given, given)
        return observations, rewards, terminated, truncated, info

    def render(self) -> tuple[npt.NDArray[np.uint8], ...] | None:
        """Pictures of the first worlds, at most four, uint8 [height, width, 3] each; None without a render mode."""
        if self.render_mode is None:
            return None
        from .picture import draw

        scene = self.scene
        tools: list[Obstacle] = [*scene.tools, *scene.obstacles]
        return tuple(
            draw(
                self.sim,
                scene.mesh,
                [*zip(map(shape_of, tools), poses_of(tools, world), strict=True), *self.decorations(world)],
                self.task.window,
                self.task.view,
                world,
            )
            for world in range(min(self.num_envs, 4))
        )

    def seen(self, observations: Actions, *names: str) -> list[Actions]:
        """Named parts of observations, [n, ...] each."""
        return [observations[:, self.columns[name]] for name in names]

    def toward(self, way: npt.NDArray[np.floating], gain: float = 1.0) -> Actions:
        """Velocities, within [-1, 1], that go a share of a way [m] in a step."""
        return np.clip(way * (gain * RATE / self.task.speed), -1.0, 1.0).astype(np.float32)

    @property
    def drawn(self) -> dict[str, npt.NDArray[np.float32]]:
        """The drawn numbers of the present episodes, float32 [worlds] each; waits for the device."""
        return dict(zip(self.ranges, self.worlds.draws.numpy().T.copy(), strict=True))

    @property
    def _steering(self) -> list:
        """How far tools go in a step [m], and the box that they do not leave."""
        low, high = self.task.workspace
        return [self.task.speed / RATE, wp.vec3(*low), wp.vec3(*high)]

    # --- pieces ----------------------------------------------------------------------------------------------------

    def _make_simulation(self, integrator: str) -> None:
        """Make the simulation; time steps and the law of contact are those of a single world, so that they do not
        depend on the number of worlds."""
        # The stiffest tissue bounds steps; episodes write their own stiffness.
        stiffest = self.ranges["young"][1] * max(self.ranges.get("ratio", (1.0, 1.0))[1], 1.0)
        rate = max(tool.speed / tool.shape.thickness for tool in self.make_scene().tools)
        self.substeps = max(IMPLICIT_STEPS, int(np.ceil(1.01 * rate / (LARGEST_SHARE * RATE))))
        steps, law = None, None
        if integrator == "explicit":
            _, single, law = self._simulated(1, stiffest, SymplecticEuler(damping=DAMPING))
            self.substeps = int(np.ceil(1.0 / (RATE * SAFETY * single.stable_dt)))
        self.substeps = self.exchanges * int(np.ceil(self.substeps / self.exchanges))
        if integrator == "explicit":
            steps = SymplecticEuler(dt=1.0 / (RATE * self.substeps), damping=DAMPING)
        euler = BackwardEuler(dt=1.0 / (RATE * self.substeps))
        self.scene, self.sim, self._contact = self._simulated(self.num_envs, stiffest, steps or euler)
        if law is not None:
            self._contact.take_law(law)

    def _simulated(self, worlds: int, young: float, steps: Integrator) -> tuple[Scene, Simulation, Contacts]:
        scene = self.make_scene()
        material = Isotropic(np.full((worlds, len(scene.mesh.tets)), young), POISSON, DENSITY)
        body = SoftBody(scene.mesh, material, worlds=worlds, device=self.device, threads=self._threads)
        if scene.fixed is not None:
            body.fix(scene.fixed)
        sim = Simulation(
            body,
            model=Corotated(rotation_level=None),
            integrator=steps,
            gravity=(0.0, 0.0, -9.81),
            obstacles=[*scene.tools, *scene.obstacles],
            contact=Contact(friction=scene.friction, self_contact=scene.parts is not None),
            deterministic=self._is_deterministic,
        )
        assert sim.contact is not None
        return scene, sim, sim.contact

    def _make_arrays(self, *, at_once: bool) -> None:
        count, scene, device, task = self.num_envs, self.scene, self.device, self.task
        sizes = {f"tool{k}.{name}": 3 for k in range(len(scene.tools)) for name in TOOL_PARTS}
        sizes |= {"points": 3 * len(scene.points), "time": 1, **task.notes}
        self.columns = columns_of(sizes)
        worlds = self.worlds = kernels.Worlds()
        shapes = {"draws": (count, len(self.ranges)), "actions": (count, task.actions)}
        shapes |= {"observations": (count, sum(sizes.values())), "notes": (count, sum(task.notes.values()))}
        kinds: dict[str, Any] = {name: wp.float32 for name in ("peak", "reward", "young", "ratio", *shapes)}
        kinds |= dict.fromkeys(("seed", "number", "step", "streak", "over", "again", "lost", "closed"), wp.int32)
        kinds |= dict.fromkeys(("terminated", "truncated", "success"), wp.bool)
        parts = np.zeros(len(scene.mesh.points), np.int32) if scene.parts is None else scene.parts
        shapes["pose"] = (int(parts.max()) + 1, count)
        kinds |= {"pose": wp.transform, "lump": wp.vec4, "targets": wp.transform}
        shapes["targets"] = (len(scene.tools), count)
        for name, kind in kinds.items():
            setattr(worlds, name, wp.zeros(shapes.get(name, count), dtype=kind, device=device))
        worlds.targets.assign(np.array([np.tile(tool.pose, (count, 1)) for tool in scene.tools], np.float32))
        worlds.limit, worlds.at_once = self.max_episode_steps, int(at_once)
        self._final = wp.zeros_like(worlds.observations)
        self._asked = wp.ones(count, dtype=wp.int32, device=device)
        bounds = np.array(list(self.ranges.values()), np.float32).T
        self._low, self._high = (wp.array(each, dtype=wp.float32, device=device) for each in bounds)
        self._centroids = wp.array(centroids(scene.mesh), dtype=wp.vec3, device=device)
        self._points, self._parts = (wp.array(each, dtype=wp.int32, device=device) for each in (scene.points, parts))
        self._stress = wp.zeros(self.sim.body.element_count, dtype=wp.float32, device=device)
        for k, tool in enumerate(scene.tools):
            tool.use_poses(worlds.targets[k])
        self._grasp: Grasp | None = None
        if scene.gripped is not None:
            given = {"tool": scene.tools[0], "closed": worlds.closed, "reach": scene.reach}
            self._grasp = Grasp(self.sim.body, scene.gripped, **given)

    def _seed(self, seed: int | Sequence[int] | None, mask: npt.NDArray[np.bool_] | None = None) -> None:
        """Seed the generators of chosen worlds, which begin with their first episode."""
        if seed is None:
            seeds = self.np_random.integers(2**31, size=self.num_envs)
        else:
            seeds = np.asarray(seed, np.int64).reshape(-1)
            if len(seeds) not in (1, self.num_envs) or (isinstance(seed, Sequence) and len(seeds) != self.num_envs):
                raise InputError(f"seed has {len(seeds)} numbers; it must be one number, or {self.num_envs}")
            seeds = seeds if isinstance(seed, Sequence) else seeds + np.arange(self.num_envs)
        former, number = self.worlds.seed.numpy(), self.worlds.number.numpy()
        chosen = np.ones(self.num_envs, bool) if mask is None else mask
        self.worlds.seed.assign(np.where(chosen, seeds % 2**31, former).astype(np.int32))
        self.worlds.number.assign(np.where(chosen, 0, number).astype(np.int32))

    def _replay(self, launches: Callable[[], None]) -> None:
        """Launch what was recorded, or record it first."""
        revision = self.sim.system.launch_revision
        if revision != self._revision:
            self._graphs.clear()
            self.sim.system.prepare()
            self.sim.stepper.prepare()
            self._revision = revision
        if launches not in self._graphs:
            with wp.ScopedCapture(device=self.device) as capture:
                launches()
            self._graphs[launches] = capture.graph
        wp.capture_launch(self._graphs[launches])

    def _launch_reset(self) -> None:
        self._launch_beginning(self._asked)
        self._launch_observation()

    def _launch_step(self) -> None:
        worlds, body, motions = self.worlds, self.sim.body, self._contact.obstacles.motions
        worlds.lost.zero_()
        self.launch_actions()
        for _ in range(self.exchanges):
            self.launch_exchange()
            inputs = [1.0 / (RATE * self.exchanges), worlds.targets, motions]
            self._launch(kernels.pace_tools, worlds.targets.shape, inputs)
            self.sim.recorded.launch(Segment(self.substeps // self.exchanges, adopts=True, publishes=True))
        inputs = [body.world_node_count, FARTHEST, body.state.displacements, worlds]
        self._launch(kernels.find_lost, body.node_count, inputs)
        if self.task.feels_stress:
            self.sim.fields[0].write_von_mises(body.state.displacements, self._stress)
            self._launch(kernels.find_peak, self.num_envs, [body.world_element_count, self._stress, worlds])
        self._launch_observation()
        self._launch(self.task.judge, self.num_envs, [*self.task.judged, worlds])
        if worlds.at_once:
            self._launch_observation()
            wp.copy(self._final, worlds.observations)
        self._launch_beginning(worlds.again)
        self._launch_observation()

    def _launch_beginning(self, chosen: wp.array) -> None:
        """Launch the beginning of episodes in chosen worlds, int32 [worlds]."""
        worlds, body, sim = self.worlds, self.sim.body, self.sim
        inputs = [chosen, self._low, self._high, wp.vec3(*self.scene.centre), worlds]
        self._launch(kernels.draw_episodes, self.num_envs, inputs)
        self._launch(self.task.begin, self.num_envs, [chosen, *self.task.begun, worlds])
        sim.reset(chosen)
        state, discretization = body.state, body.discretization
        inputs = [chosen, body.world_node_count, self._parts, worlds.pose, state.rest]
        self._launch(kernels.place_nodes, body.node_count, [*inputs, state.displacements, state.positions])
        inputs = [chosen, self._centroids, POISSON, worlds, discretization.mu, discretization.lam]
        self._launch(kernels.write_stiffness, body.element_count, [*inputs, *discretization.lame[:2]])
        self.launch_places(chosen)

    def _launch_observation(self) -> None:
        body, obstacles = self.sim.body, self._contact.obstacles
        inputs = [len(self.scene.tools), 1.0 / (RATE * self.substeps), obstacles.motions]
        inputs += [obstacles.wrenches, None if self._grasp is None else self._grasp.wrench, self._points]
        inputs += [body.world_node_count, body.state.rest, body.state.displacements, self.worlds]
        self._launch(kernels.observe, self.num_envs, inputs)

    def _launch(self, kernel: wp.Kernel, dim: int | tuple[int, ...], inputs: list) -> None:
        wp.launch(kernel, dim, inputs, device=self.device)

    def _taken(self, actions: Any) -> wp.array:
        """Actions as a Warp array on the device."""
        shape = self.worlds.actions.shape
        if hasattr(actions, "data_ptr"):
            actions = wp.from_torch(actions.detach().float().contiguous())
        elif not isinstance(actions, wp.array):
            actions = wp.array(np.asarray(actions, np.float32), dtype=wp.float32, device=self.device)
        if actions.shape != shape or actions.dtype != wp.float32:
            raise InputError(f"actions is {list(actions.shape)}; it must be float32 {list(shape)}")
        return actions

    def _given(self, array: wp.array) -> Any:
        """A copy of an array on the device, as the kind that the user asked for."""
        if self.array == "numpy":
            return array.numpy().copy()
        clone = wp.clone(array)
        return clone if self.array == "warp" else wp.to_torch(clone)
