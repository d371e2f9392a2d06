"""Recording on several ranks: each writes the frames of its piece, and one small stage joins the pieces."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_path
from warp_corot.io.files.whole import written_whole
from warp_corot.io.write.animate import Progress, Recording, frame_count, make_frames
from warp_corot.io.write.skins import Skin
from warp_corot.mesh.surfaces.bound import SurfaceMesh

from .mpi import all_or_none
from .part import PartSync
from .simulation import Simulation

Ints = npt.NDArray[np.int32]


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
                changing=sim.remeshing.every > 0,
                gravity=sim.gravity if sim.rank == 0 else None,
                obstacles=sim.obstacles if sim.rank == 0 else (),
                world=world,
            )

        self._writer = all_or_none(made, self._comm)

    def record(self, count: int, progress: Progress | None) -> Recording:
        """Write the present frame and ``count`` more."""
        writer, done = self._writer, self.done

        def write() -> None:
            self._write_frame()
            done.frames += 1
            if done.frames == 1:
                # From now on the joining stage shows the frames written so far.
                all_or_none(writer.flush, self._comm)
                all_or_none(lambda: self._join(count + 1), self._comm)

        try:
            make_frames(self._sim, self._fps, count, done, write, progress or (lambda *_: None))
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
        stress = piece.of_elements(
            [field.von_mises(sim.completed(k, "displacements")) for k, field in enumerate(sim.fields)]
        )
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
            if not layer.Export(str(part)):
                raise OSError(f"{self._path}: cannot be written")


def _name(rank: int) -> str:
    return f"rank-{rank:04d}.usdc"


class Piece:
    """A rank's piece of all bodies in one world, body after body, as one mesh and one material.

    Args:
        syncs: The bodies and this rank's parts of them.
        world: The world.

    Attributes:
        points, tets: The mesh at rest [m], [N, 3], and [T, 4].
        fixed: Whether each node is held, bool [N].
        young, poisson, density: The elements' material [Pa], -, [kg/m^3], a number or [T].
        skin: The faces on the bodies' surface.
    """

    def __init__(self, syncs: Sequence[PartSync], world: int):
        self._syncs, self._world = syncs, world
        self.up_axis = syncs[0].whole.mesh.up_axis
        #: The elements of each body that this rank counts, among those of its part; and the nodes of these and of
        #: the faces.
        self._elements = [np.flatnonzero(each.part.numbers.counted) for each in syncs]
        self._nodes, tets, faces, first = [], [], [], 0
        for each, elements in zip(syncs, self._elements, strict=True):
            own, (triangles, _) = each.part.mesh.tets[elements], each.part.surface_faces
            # Of the ranks that move a corner, the first draws the face.
            owner = each.part.numbers.owner[triangles].min(axis=1)
            triangles = triangles[owner == each.rank]
            nodes = np.unique(np.concatenate([own.ravel(), triangles.ravel()]))
            number = np.full(each.part.world_node_count, -1, np.int32)
            number[nodes] = np.arange(first, first + len(nodes), dtype=np.int32)
            tets.append(number[own])
            faces.append(number[triangles])
            self._nodes.append(nodes)
            first += len(nodes)
        self.points = np.concatenate([e.part.mesh.points[n] for e, n in zip(syncs, self._nodes, strict=True)])
        self.tets = np.concatenate(tets).astype(np.int32)
        self.fixed = self._nodal("held") > 0
        self.skin = skin_of(self.points, np.concatenate(faces))
        for name in ("young", "poisson", "density"):
            setattr(self, name, self._property(name))

    def state(self, name: str, completed: Callable[[int, str], wp.array]) -> npt.NDArray[np.float32]:
        """A nodal array of the state at the piece's nodes, float32 [N, 3].

        Args:
            name: The name of the array.
            completed: Gives the array of a body's part with the values of other ranks' nodes.
        """
        found = []
        for k, nodes in enumerate(self._nodes):
            first = self._world * self._syncs[k].part.world_node_count
            found.append(completed(k, name).numpy()[first + nodes, :3])
        return np.concatenate(found)

    def of_elements(self, values: Sequence[npt.NDArray[np.float32]]) -> npt.NDArray[np.float32]:
        """Values of the piece's elements, from those of all elements of each part in all worlds."""
        found = []
        for each, elements, given in zip(self._syncs, self._elements, values, strict=True):
            found.append(given.reshape(each.part.worlds, -1)[self._world, elements])
        return np.concatenate(found)

    def _nodal(self, name: str) -> npt.NDArray[np.uint8]:
        """A condition of the nodes, from the bodies that users hold."""
        found = []
        for each, nodes in zip(self._syncs, self._nodes, strict=True):
            first = self._world * each.whole.world_node_count
            values = getattr(each.whole.conditions, name).numpy()
            found.append(values[first + each.part.places[nodes]])
        return np.concatenate(found)

    def _property(self, name: str) -> float | npt.NDArray[np.float64]:
        values = []
        for each, elements in zip(self._syncs, self._elements, strict=True):
            body = each.part
            shape = (body.worlds, body.world_element_count)
            everywhere = np.broadcast_to(getattr(body.material.isotropic, name), shape)
            values.append(everywhere[self._world, elements])
        joined = np.concatenate(values).astype(np.float64)
        # A piece of a mesh that changes may get elements of other materials.
        changing = [each.whole for each in self._syncs if each.whole.changing is not None]
        varies = any(np.ptp(getattr(whole.material.isotropic, name)) > 0 for whole in changing)
        return float(joined[0]) if (joined == joined[0]).all() and not varies else joined


def skin_of(points: npt.NDArray[np.float64], faces: Ints) -> Skin:
    """Triangles of a mesh's points [F, 3], drawn as its boundary."""
    used, triangles = np.unique(faces, return_inverse=True)
    weights = np.tile([1.0, 0.0, 0.0, 0.0], (len(used), 1))
    nodes = np.repeat(used[:, None], 4, axis=1).astype(np.int32)
    surface = SurfaceMesh(points[used], nodes, weights, triangles.reshape(-1, 3).astype(np.int32))
    return Skin("surface", surface, is_boundary=True)
