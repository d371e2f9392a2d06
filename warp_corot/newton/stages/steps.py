"""Scenes of USD stages, stepped frame by frame."""

from __future__ import annotations

import math
import warnings
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.errors import InputError, UnstableError
from warp_corot.inputs.device import checked_device
from warp_corot.io.read.usd.scene import open_scene
from warp_corot.io.write.animate import steps_per_frame
from warp_corot.io.write.usd.over import SceneWriter, State
from warp_corot.newton.following import INTERVAL, RETRIES
from warp_corot.newton.library import newton
from warp_corot.newton.solver import SolverCorotated

from .stage import StageOptions, stage_model
from .start import warn_of_overlaps

#: Most steps that are recorded and replayed together, one measurement with them; a frame is a whole number of chunks.
CHUNK = INTERVAL
#: What can step rigid bodies.
RIGID = ("semi-implicit", "xpbd", "none")
#: Longest step where rigid bodies touch something [s].
RIGID_STEP = 5e-4


class StageSimulation:
    """A USD stage as a scene, stepped by ``SolverCorotated``.

    Its materials, colliders, rigid bodies, joints, attachments and gravity are what ``newton.ModelBuilder.add_usd``
    reads; rigid bodies are stepped along by Newton. Time begins at zero, and animation in the stage stands still.

    Args:
        path: A stage with TetMesh prims.
        fps: Frames per second of simulated time; None: time codes per second of the stage if it says so, else 24.
        dt: Longest time step [s]; None: a safe one, which follows the state from frame to frame.
        options: What the stage does not say.
        damping: Rate of mass-proportional damping [1/s], of free fall, too.
        rigid: Which of Newton's solvers steps rigid bodies and joints: "semi-implicit", "xpbd", or "none".
        device: What to simulate on.

    Attributes:
        scene: The stage.
        parts: Its model, and which prim is what in it.
        solver: The solver.
        state: ``newton.State``, in the stage's units.
        dt: The time step [s].
        steps: How many make a frame, the last one so far.
        time: Simulated so far [s].

    Raises:
        InputError: A stage or an option that cannot be used.
    """

    def __init__(
        self,
        path: str | PathLike[str],
        *,
        fps: float | None = None,
        dt: float | None = None,
        options: StageOptions | None = None,
        damping: float = 0.0,
        rigid: str = "semi-implicit",
        device: Any = None,
    ):
        if dt is not None and not (math.isfinite(dt) and dt > 0):
            raise InputError(f"dt is {dt:g} s; it must be a positive number")
        if rigid not in RIGID:
            raise InputError(f"rigid is {rigid!r}; it must be one of {', '.join(RIGID)}")
        self.scene = open_scene(path)
        self.fps = 24.0 if fps is None and self.scene.frame_rate is None else float(fps or self.scene.frame_rate or 0)
        if not (math.isfinite(self.fps) and self.fps > 0):
            raise InputError(f"fps is {self.fps:g}; it must be a positive number")
        self.parts = stage_model(self.scene, options or StageOptions(), checked_device(device))
        model = self.parts.model
        self._given_dt, self.steps = dt, 0
        self.solver = self._new_solver(rigid, damping)
        self._pipeline = newton.CollisionPipeline(model, soft_contact_gap=self.parts.margin)
        self._contacts = self._pipeline.contacts()
        self._pipeline.collide(model.state(), self._contacts)
        warn_of_overlaps(self.parts, self._contacts)
        self.state, self._kept = self._new_state(), self._new_state()
        # Shares its positions with the state, and has stresses, which are wanted once a frame and not once a step.
        self._shown = model.state()
        self._shown.particle_q = self.state.particle_q
        self._visuals = newton.geometry.DeformableVisuals(model) if self.parts.surface_points else None
        self._load_kernels()
        self._record_steps()
        self.time = 0.0
        self.frames = 0

    def advance(self) -> None:
        """Simulate one frame. What goes wrong without a given step is tried again with shorter ones.

        Raises:
            UnstableError: The state would not be finite, or there are more contacts than there is room for; it stays
                what it was before that.
        """
        self._record_steps()
        self._kept.assign(self.state)
        for attempt in range(RETRIES + 1):
            for _ in range(self.steps // self._chunk):
                wp.capture_launch(self._graph)
            try:
                self._check()
                break
            except InputError as error:
                raise UnstableError(f"after {self.time:.3g} s: {error}") from None
            except UnstableError:
                if self._given_dt is not None or attempt == RETRIES:
                    raise
            # From here on the solver takes half the step.
            self.state.assign(self._kept)
            self._record_steps()
        self.frames += 1
        self.time = self.frames / self.fps

    def show(self) -> State:
        """What a frame shows, copied to the host."""
        parts = self.parts
        x, v = self.state.particle_q.numpy(), self.state.particle_qd.numpy()
        self.solver.write_attributes(self._shown)
        stress = self._shown.warp_corot.von_mises.numpy() * np.float32(self.scene.units.pressure)
        surfaces = []
        if self._visuals is not None:
            points = self._visuals.update(self.state).points.numpy()
            surfaces = [points[chosen] for chosen in parts.surface_points]
        surfaces += [x[particles].copy() for particles in parts.cloth]
        return State(
            [x[body.particles].copy() for body in parts.soft],
            [v[body.particles].copy() for body in parts.soft],
            [stress[body.tets] for body in parts.soft],
            self.body_poses(),
            surfaces,
        )

    def writer(self, path: str | PathLike[str], *, show_stress: bool = False, flatten: bool = False) -> SceneWriter:
        """What writes frames over the stage; see ``SceneWriter``.

        Example::

            writer = sim.writer("moving.usd")
            for _ in range(48):
                sim.advance()
                writer.write(sim.show())
            writer.close()
        """
        parts = self.parts
        return SceneWriter(
            Path(path),
            self.scene,
            [body.prim for body in parts.soft],
            dict(zip(parts.rigid, self.body_poses(), strict=True)),
            parts.surfaces,
            fps=self.fps,
            ground=parts.ground,
            show_stress=show_stress,
            flatten=flatten,
        )

    def body_poses(self) -> npt.NDArray[np.float64]:
        """Poses of the rigid bodies in the order of ``parts.rigid``, for row vectors, float64 [B, 4, 4]."""
        poses = np.zeros((len(self.parts.rigid), 4, 4))
        if not len(poses):
            return poses
        every = self.state.body_q.numpy().astype(np.float64)[list(self.parts.rigid.values())]
        poses[:, 3, :3], poses[:, 3, 3] = every[:, :3], 1.0
        x, y, z, w = (every[:, 3:] / np.linalg.norm(every[:, 3:], axis=1, keepdims=True)).T
        poses[:, :3, :3] = np.moveaxis(
            np.array(
                [
                    [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
                    [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
                    [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
                ]
            ),
            2,
            0,
        )
        return poses

    # --- pieces ----------------------------------------------------------------------------------------------------

    def _new_solver(self, rigid: str, damping: float) -> SolverCorotated:
        model = self.parts.model
        try:
            solver: Any = {"semi-implicit": rigid, "none": None}.get(rigid)
            if rigid == "none" and (standing := [*self.parts.cables, *self.parts.rigid]):
                self.parts.notes.append(f"stay where they are (--rigid none): {', '.join(standing)}")
            if rigid == "xpbd":
                solver = newton.solvers.SolverXPBD(model)
            substeps = None if self._given_dt is None else 1
            return SolverCorotated(model, damping=damping, substeps=substeps, rigid_solver=solver)
        except ValueError as error:  # Newton's, and InputError, which is one
            said = str(error).replace(" Give another rigid_solver, or None.", "").rstrip(".")
            hint = f"; another than {rigid} can be chosen (--rigid)" if "does not support" in said else ""
            if hint and self.parts.cables:
                said = f"has cables, as {self.parts.cables[0]}, which no solver here steps: {said}"
                hint = "; --rigid none leaves cables and rigid bodies where they are"
            raise InputError(f"{self.scene.path}: {said}{hint}") from None

    def _longest_step(self) -> float:
        stable, dt = self.solver.stable_dt, self._given_dt
        if dt is not None:
            if dt > stable:
                raise InputError(f"dt is {dt:g} s; the largest stable step is about {stable:.3g} s")
            return dt
        longest = min(self.solver.recorded_dt, 1.0 / self.fps)
        return min(longest, RIGID_STEP) if self.parts.rigid else longest

    def _record_steps(self) -> None:
        """Record a chunk of steps that are safe in the present state, where there are not as many as before."""
        count = steps_per_frame(self.fps, self._longest_step())
        chunks = -(-count // CHUNK)
        self._chunk = -(-count // chunks)
        count = chunks * self._chunk
        if count != self.steps:
            self.steps = count
            self.dt = 1.0 / (self.fps * count)
            self._graph = self._recorded()

    def _check(self) -> None:
        with warnings.catch_warnings():
            # The next frame has the steps that this one lacked.
            warnings.filterwarnings("ignore", "a recorded step has fewer substeps")
            self.solver.check()

    def _new_state(self) -> newton.State:
        state = self.parts.model.state()
        del state.warp_corot
        return state

    def _step(self, state: newton.State) -> None:
        state.clear_forces()
        self._pipeline.collide(state, self._contacts)
        self.solver.step(state, state, None, self._contacts, self.dt)

    def _load_kernels(self) -> None:
        """Make a step of a state that is thrown away: loading within a recording would end it on some drivers."""
        self.dt = min(self._longest_step(), 1e-6)
        self._step(self._new_state())
        self.solver.check()

    def _recorded(self) -> Any:
        """The steps of a chunk, as a graph."""
        with wp.ScopedCapture(device=self.parts.model.device) as capture:
            for _ in range(self._chunk):
                self._step(self.state)
        return capture.graph
