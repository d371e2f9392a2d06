"""Recording on several ranks: each writes the frames of its piece, and one small stage joins the pieces."""

from __future__ import annotations

import time
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_path
from warp_corot.io.files.whole import written_whole
from warp_corot.io.write.animate import Progress, Recording, frame_count

from .mpi import all_or_none
from .pieces import Piece
from .simulation import Simulation


def record(
    sim: Simulation,
    path: str | PathLike[str],
    *,
    duration: float | None,
    fps: float = 24.0,
    world: int | None = None,
    tets: bool = True,
    progress: Progress | None = None,
    recording: Recording | None = None,
) -> Recording:
    """Advance a simulation and write ``fps`` frames a second, the current state first; all ranks must call this.

    ``beam.usd`` becomes a small stage that refers to ``beam.ranks/rank-0000.usdc`` and so on: every rank writes the
    elements that it counts and their faces on the surface, and no rank gathers the whole body. Rank 0 writes obstacles
    and tools, too. All pieces have the same range of colours. Bodies made from a domain are drawn by their tetrahedra.
    Of a body that is remeshed, each frame shows the current mesh, and the pieces are those of its present division. If
    the run is interrupted, all but the last few seconds of frames are kept.

    Args:
        sim: The simulation; it continues from its current state.
        path: A .usd, .usdc or .usda file in a folder that all ranks can see.
        duration: Simulated time [s], rounded to whole frames; None: the current state is the only frame.
        fps: Frames per second of simulated time.
        world: The world that is drawn; must be given if there are several.
        tets: Whether to write the tetrahedra; if not, only the surface is written.
        progress: Called on every rank after each frame, with the number of finished frames and the number of frames
            after the first one.
        recording: Filled during the run, so that it is available if the run ends early; None: a new one.

    Returns:
        The progress of all ranks at the end.

    Raises:
        InputError: A path that cannot be written to, a duration or frame rate out of range, or no such world.
        UnstableError: The state is no longer finite; the frames before are kept.
        OSError: On all ranks, if one cannot write, for example because its disk is full; former frames are kept.
    """
    if not isinstance(sim, Simulation):
        raise InputError("sim must be a Simulation of warp_corot.distributed; warp_corot.record takes others")
    checked_path(path, "path")
    count = 0 if duration is None else frame_count(duration, fps)
    if world is None and sim.worlds > 1:
        raise InputError(f"the simulation has {sim.worlds} worlds; choose the one to draw, for example world=0")
    if not 0 <= (world or 0) < sim.worlds:
        raise InputError(f"world is {world!r}; it must be a whole number from 0 to {sim.worlds - 1}")
    done = Recording(Path(path)) if recording is None else recording
    return _Pieces(sim, done, fps, world or 0, tets).record(count, progress)


class _Pieces:
    """The stage of a rank's piece, and on rank 0 the one that joins all."""

    def __init__(self, sim: Simulation, done: Recording, fps: float, world: int, tets: bool):
        from warp_corot.io.write.usd.writer import UsdWriter

        path = done.path
        self._sim, self._path, self._fps = sim, path, fps
        self._folder = path.with_name(f"{path.stem}.ranks")
        self._comm = sim.comm
        self._world = world
        self._make_piece()
        self.done = done

        def made() -> Any:
            self._folder.mkdir(exist_ok=True)
            return UsdWriter(
                self._folder / _name(sim.rank),
                self._piece,
                fps=fps,
                fixed=self._piece.fixed,
                material=self._piece,
                skins=[self._piece.skin],
                tets=tets,
                changing=sim.remeshing is not None,
                gravity=sim.gravity if sim.rank == 0 else None,
                obstacles=sim.obstacles if sim.rank == 0 else (),
                world=world,
            )

        self._writer = all_or_none(made, self._comm)

    def record(self, count: int, progress: Progress | None) -> Recording:
        """Write the present frame and ``count`` more."""
        sim, done, writer = self._sim, self.done, self._writer
        first_step, first_time = sim.total_steps, sim.total_time
        try:
            for frame in range(count + 1):
                started = time.perf_counter()
                sim.advance_until(first_time + frame / self._fps)
                stepped = time.perf_counter()
                self._write_frame()
                if frame == 0:
                    # From now on the joining stage shows the frames written so far.
                    all_or_none(writer.flush, self._comm)
                    all_or_none(lambda: self._join(count + 1), self._comm)
                done.stepping += stepped - started
                done.writing += time.perf_counter() - stepped
                done.frames = frame + 1
                done.steps, done.simulated = sim.total_steps - first_step, sim.total_time - first_time
                if progress is not None:
                    progress(frame, count)
        except BaseException as error:
            # Write the waiting frames; the first error is the one to raise.
            writer.__exit__(type(error), error, error.__traceback__)
            raise
        all_or_none(writer.close, self._comm)
        all_or_none(lambda: self._join(done.frames), self._comm)
        return done

    def _make_piece(self) -> None:
        self._syncs, self._piece = self._sim.syncs, Piece(self._sim.syncs, self._world)

    def _write_frame(self) -> None:
        sim, done = self._sim, self.done
        if sim.syncs is not self._syncs:
            self._make_piece()
            piece = self._piece
            self._writer.change_mesh(piece, fixed=piece.fixed, material=piece, skins=[piece.skin])
        piece = self._piece
        displacements, velocities = (piece.state(name, sim.completed) for name in ("displacements", "velocities"))
        positions = (piece.points + displacements).astype(np.float32)
        stress = piece.of_elements(sim.von_mises())
        self._writer.widen_range(max(self._comm.allgather(self._writer.range_for(stress))))
        all_or_none(lambda: self._writer.write(positions, velocities=velocities, von_mises=stress), self._comm)
        lengths = np.linalg.norm(positions.astype(np.float64) - piece.points, axis=1)
        done.final_displacement = max(self._comm.allgather(float(lengths.max(initial=0.0))))
        done.largest_displacement = max(done.largest_displacement, done.final_displacement)
        done.elements.append(sum(self._comm.allgather(len(piece.tets))))

    def _join(self, frames: int) -> None:
        """Write the stage that refers to all pieces, on rank 0."""
        if self._sim.rank != 0:
            return
        from pxr import Kind, Sdf, Usd, UsdGeom

        layer = Sdf.Layer.CreateAnonymous(self._path.suffix)
        stage = Usd.Stage.Open(layer)
        UsdGeom.SetStageUpAxis(stage, self._piece.up_axis)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        stage.SetTimeCodesPerSecond(self._fps)
        stage.SetFramesPerSecond(self._fps)
        stage.SetStartTimeCode(0.0)
        stage.SetEndTimeCode(float(frames - 1))
        root = UsdGeom.Xform.Define(stage, "/SoftBody").GetPrim()
        stage.SetDefaultPrim(root)
        Usd.ModelAPI(root).SetKind(Kind.Tokens.assembly)
        # An open stage would look for the pieces beside a layer without a path.
        del root, stage
        for rank in range(self._comm.size):
            prim = Sdf.CreatePrimInLayer(layer, f"/SoftBody/rank_{rank:04d}")
            prim.specifier = Sdf.SpecifierDef
            prim.referenceList.Prepend(Sdf.Reference(f"./{self._folder.name}/{_name(rank)}"))
        layer.customLayerData = {"warp_corot": {"ranks": self._comm.size}}
        with written_whole(self._path) as part:
            # OpenUSD finds the format by the extension.
            aside = part.with_name(part.name + self._path.suffix)
            try:
                if not layer.Export(str(aside)):
                    raise OSError(f"{self._path}: cannot be written")
                aside.replace(part)
            finally:
                aside.unlink(missing_ok=True)


def _name(rank: int) -> str:
    return f"rank-{rank:04d}.usdc"
