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
from scipy.spatial.transform import Rotation

from warp_corot.errors import InputError, UnstableError
from warp_corot.inputs.checks import checked_device
from warp_corot.io.read.usd.scene import open_scene
from warp_corot.io.write.animate import steps_per_frame
from warp_corot.io.write.usd.over import SceneState, SceneWriter
from warp_corot.newton.library import newton
from warp_corot.newton.solver import SolverCorotated
from warp_corot.newton.substeps import INTERVAL, RETRIES

from .stage import StageModel, StageOptions

#: Maximum number of steps that are recorded together, with one measurement; a frame is a whole number of chunks. On the
#: CPU recording a step takes as long as ten steps.
CHUNK = INTERVAL
CPU_CHUNK = 16
#: Solvers of rigid bodies.
RIGID = ("semi-implicit", "xpbd", "none")
#: Pairs of soft bodies are searched within this many times their thickness beyond it, and so far pushed out.
GAP = 3.0
#: Number of triangles that a vertex can touch, and half the number of edges that an edge can.
ROOM = 64
#: Longest implicit step unless another is given [s].
IMPLICIT_STEP = 1.0 / 60.0
#: Things that approach at up to this speed are found before an implicit step in which they touch something [m/s].
FAST = 10.0
#: Longest step if rigid bodies touch something [s].
RIGID_STEP = 5e-4


class StageSimulation:
    """A USD stage as a scene that ``SolverCorotated`` steps.

    Its materials, colliders, rigid bodies, joints, attachments and gravity are those that
    ``newton.ModelBuilder.add_usd`` reads; Newton steps the rigid bodies. Time begins at zero, and animation in the
    stage is stopped.

    Args:
        path: A stage with TetMesh prims.
        fps: Frames per second of simulated time; None: the stage's time codes per second if given, else 24.
        dt: Longest time step [s]; None: a safe one, which follows the state from frame to frame.
        options: Values for what the stage does not define.
        damping: Rate of mass-proportional damping [1/s], which also damps free fall.
        rigid: Newton's solver for rigid bodies and joints: "semi-implicit", "xpbd", or "none".
        integrator: "explicit", or "implicit", with steps of 1/60 s at most unless ``dt`` is given; soft bodies
            then pass through one another.
        device: The device of the simulation.

    Attributes:
        scene: The stage.
        parts: Its model, and the role of each prim.
        solver: The solver.
        state: ``newton.State``, in the stage's units.
        dt: The time step [s].
        steps: Number of steps of the last frame.
        time: Simulated time so far [s].

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
        integrator: str = "explicit",
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
        self._is_implicit = integrator == "implicit"
        self.parts = parts = StageModel(self.scene, options or StageOptions(), checked_device(device))
        model = parts.model
        if self._is_implicit and parts.thickness is not None:
            parts.thickness = None
            parts.notes.append("soft bodies pass through one another in implicit steps")
        self._given_dt, self.steps = dt, 0
        self.solver = self._new_solver(rigid, integrator, damping)
        gap = FAST / self.scene.units.metres * self._longest_step() if self._is_implicit else 0.0
        self._pipeline = newton.CollisionPipeline(model, soft_contact_gap=parts.margin + gap)
        self._touch = parts.thickness is not None
        if parts.thickness is not None:
            # Nothing else of Newton's filter of neighbours is needed: a body does not push itself in its first shape.
            self._pipeline.init_soft_self_contact(
                margin=parts.thickness,
                gap=GAP * parts.thickness,
                vertex_buffer_pre_alloc=ROOM,
                edge_buffer_pre_alloc=2 * ROOM,
                topological_filter_threshold=1,
            )
        self._contacts = self._pipeline.contacts()
        self._pipeline.collide(model.state(), self._contacts)
        parts.warn_of_overlaps(self._contacts)
        self.state, self._kept = self._new_state(), self._new_state()
        # Shares its positions with the state; it has stresses, which are needed once a frame and not once a step.
        self._shown = model.state()
        self._shown.particle_q = self.state.particle_q
        self._visuals = newton.geometry.DeformableVisuals(model) if parts.surface_points else None
        # A step of a copy of the state: loading kernels within a recording would end it on some drivers.
        self.dt = min(self._longest_step(), 1e-6)
        self._step(self._new_state())
        self.solver.check()
        self._record_steps()
        self.time = 0.0
        self.frames = 0

    def advance(self) -> None:
        """Simulate one frame. Without a given step, a failed step is repeated with shorter ones.

        Raises:
            UnstableError: The state would not be finite, or there are more contacts than the buffer holds; the state
                before that is kept.
        """
        self._record_steps()
        self._kept.assign(self.state)
        for attempt in range(RETRIES + 1):
            for _ in range(self.steps // self._chunk):
                wp.capture_launch(self._graph)
            try:
                with warnings.catch_warnings():
                    # The next frame has the steps that this one lacked.
                    warnings.filterwarnings("ignore", "a recorded step has too few substeps")
                    self.solver.check()
                break
            except InputError as error:
                raise UnstableError(f"after {self.time:.3g} s: {error}") from None
            except UnstableError:
                if self._is_implicit or self._given_dt is not None or attempt == RETRIES:
                    raise
            # From now on the solver uses half the step.
            self.state.assign(self._kept)
            self._record_steps()
        self.frames += 1
        self.time = self.frames / self.fps

    def show(self) -> SceneState:
        """The content of a frame, copied to the host."""
        parts = self.parts
        x, v = self.state.particle_q.numpy(), self.state.particle_qd.numpy()
        self.solver.write_attributes(self._shown)
        stress = self._shown.warp_corot.von_mises.numpy() * np.float32(self.scene.units.pressure)
        surfaces = [] if self._visuals is None else [self._visuals.update(self.state).points.numpy()]
        surfaces = [points[chosen] for points in surfaces for chosen in parts.surface_points]
        surfaces += [x[particles].copy() for particles in parts.cloth]
        positions, velocities = ([a[body.particles].copy() for body in parts.soft] for a in (x, v))
        return SceneState(
            positions, velocities, [stress[body.tets] for body in parts.soft], self.body_poses(), surfaces
        )

    def writer(self, path: str | PathLike[str], *, show_stress: bool = False, flatten: bool = False) -> SceneWriter:
        """A writer of frames over the stage; see ``SceneWriter``.

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
        if len(poses):
            every = self.state.body_q.numpy().astype(np.float64)[list(self.parts.rigid.values())]
            poses[:, 3, :3], poses[:, 3, 3] = every[:, :3], 1.0
            poses[:, :3, :3] = np.swapaxes(Rotation.from_quat(every[:, 3:]).as_matrix(), 1, 2)
        return poses

    # --- pieces ----------------------------------------------------------------------------------------------------

    def _new_solver(self, rigid: str, integrator: str, damping: float) -> SolverCorotated:
        parts = self.parts
        if rigid == "none" and (standing := [*parts.cables, *parts.rigid]):
            parts.notes.append(f"stay where they are (--rigid none): {', '.join(standing)}")
        try:
            solver: Any = {"semi-implicit": rigid, "none": None}.get(rigid)
            if rigid == "xpbd":
                solver = newton.solvers.SolverXPBD(parts.model)
            substeps, margin = None if self._given_dt is None else 1, parts.thickness
            options: dict[str, Any] = {"damping": damping, "integrator": integrator, "substeps": substeps}
            return SolverCorotated(parts.model, rigid_solver=solver, self_contact_margin=margin, **options)
        except ValueError as error:  # Newton's, and InputError, which is one
            said = str(error).replace(" Give another rigid_solver, or None.", "").rstrip(".")
            hint = f"; another than {rigid} can be chosen (--rigid)" if "does not support" in said else ""
            if hint and parts.cables:
                said = f"has cables, for example {parts.cables[0]}, which no solver here steps: {said}"
                hint = "; --rigid none leaves cables and rigid bodies in place"
            raise InputError(f"{self.scene.path}: {said}{hint}") from None

    def _longest_step(self) -> float:
        stable, dt = self.solver.stable_dt, self._given_dt
        if self._is_implicit:
            return IMPLICIT_STEP if dt is None else dt
        if dt is not None:
            if dt > stable:
                raise InputError(f"dt is {dt:g} s; it must be at most the largest stable step, about {stable:.3g} s")
            return dt
        longest = min(self.solver.recorded_dt, 1.0 / self.fps)
        return min(longest, RIGID_STEP) if self.parts.rigid else longest

    def _record_steps(self) -> None:
        """Record a chunk of steps that are safe in the current state, if their number has changed."""
        count = steps_per_frame(self.fps, self._longest_step())
        largest = CPU_CHUNK if self.parts.model.device.is_cpu else CHUNK
        chunks = count if self._is_implicit else -(-count // largest)
        self._chunk = -(-count // chunks)
        count = chunks * self._chunk
        if count != self.steps:
            self.steps = count
            self.dt = 1.0 / (self.fps * count)
            with wp.ScopedCapture(device=self.parts.model.device) as capture:
                for _ in range(self._chunk):
                    self._step(self.state)
            self._graph = capture.graph

    def _new_state(self) -> newton.State:
        state = self.parts.model.state()
        del state.warp_corot
        return state

    def _step(self, state: newton.State) -> None:
        state.clear_forces()
        self._pipeline.collide(state, self._contacts, soft_self_contact=self._touch)
        self.solver.step(state, state, None, self._contacts, self.dt)
