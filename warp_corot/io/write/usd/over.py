"""The motion of a scene as a layer over the stage that it came from, which keeps its looks and everything else."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import Gf, Sdf, Tf, Usd

from warp_corot.errors import InputError
from warp_corot.io.files.usd import reason, usd_name
from warp_corot.io.files.whole import sync
from warp_corot.io.pictures.colors import COLORMAP_NAME, round_limit
from warp_corot.io.read.usd.scene import Scene, TetPrim

from .over_prims import BodyOver, PointsOver, TetsOver, bind_look, draw_ground
from .pieces import PieceStore, Samples

#: Metadata of the stage below that the stage on top has of its own.
_OWN = ("subLayers", "subLayerOffsets", "startTimeCode", "endTimeCode", "timeCodesPerSecond", "framesPerSecond")


@dataclass(frozen=True, eq=False)
class Surface:
    """Points of a Mesh prim that go along with a body.

    Attributes:
        path: Of the prim.
        points: In the world at the beginning, float64 [V, 3].
    """

    path: str
    points: NDArray[np.float64]


@dataclass(frozen=True)
class State:
    """What a frame shows, in the stage's units and in the world.

    Attributes:
        positions, velocities: Of each TetMesh's points, in the order they were given, float32 [N, 3].
        von_mises: Of each TetMesh's tetrahedra [Pa], float32 [T].
        bodies: Poses of the rigid bodies, for row vectors, float64 [B, 4, 4].
        surfaces: Of each surface's points, float32 [V, 3].
    """

    positions: Sequence[NDArray[np.float32]]
    velocities: Sequence[NDArray[np.float32]]
    von_mises: Sequence[NDArray[np.float32]]
    bodies: NDArray[np.float64]
    surfaces: Sequence[NDArray[np.float32]]


class SceneWriter:
    """Writes frames of a scene to a stage that has the scene's own as a sublayer; it opens at any moment.

    The units, axis, materials, cameras and all else are those of the stage below, which must stay where it is, seen
    from the output, unless ``flatten`` is set. Frame i is time code i. Of each TetMesh: ``points``, ``velocities``,
    ``extent``, the primvar ``vonMises`` (uniform, one a tetrahedron [Pa]) and, where the stage gives no
    ``displayColor`` or ``show_stress`` is set, that: averages of the stress at nodes in the 256 colours of
    `colors.stress_colors`; custom data of the default prim name the map and its range, which is found as `UsdWriter`
    has it. Of rigid bodies: ``xformOp:transform:simulated``. Of surfaces that go along: ``points`` and ``extent``.

    Args:
        path: Where to: .usd, .usdc or .usda.
        scene: The stage below.
        tets: Which of its TetMesh prims move.
        bodies: Paths of the rigid bodies, with their poses at the beginning, float64 [4, 4] each.
        surfaces: What else goes along.
        fps: Frames per second of simulated time.
        ground: Three points of a plane that is to be drawn, [4, 3] corners in the world; None: nothing.
        show_stress: Whether the stress takes the place of the prims' own look.
        flatten: Whether everything is joined into one file at the end.

    Raises:
        InputError: A path that cannot be written to, or a file that the scene is made of.
    """

    def __init__(
        self,
        path: str | Path,
        scene: Scene,
        tets: Sequence[TetPrim],
        bodies: Mapping[str, NDArray[np.float64]],
        surfaces: Sequence[Surface] = (),
        *,
        fps: float,
        ground: NDArray[np.float64] | None = None,
        show_stress: bool = False,
        flatten: bool = False,
    ):
        self._store = _Store(path, scene.path)
        self.path = self._store.path
        if self.path.exists() and self.path.samefile(scene.path):
            raise InputError(f"{self.path}: is the input, should be another file")
        if scene.uses(self.path):
            raise InputError(f"{self.path}: is part of the input {scene.path}, should be another file")
        self.frames = 0
        self._scene, self._flatten, self._show_stress = scene, flatten, show_stress
        self._layer = _base_layer(scene, fps)
        moving = {*bodies, *scene.animated}
        self._soft = [TetsOver(self._layer, scene, prim, moving, show_stress) for prim in tets]
        self._bodies = [BodyOver(self._layer, scene, name, pose, moving) for name, pose in bodies.items()]
        self._surfaces = [PointsOver(self._layer, scene, one.path, moving) for one in surfaces]
        for points in self._surfaces:
            points.refresh_normals()
        if ground is not None:
            draw_ground(self._layer, ground)
        if show_stress:
            bind_look(self._layer, [prim.path for prim in tets])
        self._top = 0.0
        self._tops_used: set[float] = set()
        self._closed = False

    @property
    def stress_range(self) -> tuple[float, float]:
        """Stresses [Pa] at the two ends of the colour map, so far."""
        return 0.0, self._top

    def write(self, state: State) -> None:
        """Add a frame.

        Raises:
            OSError: Could not be written, as when the disk is full; the frames before stay and play.
        """
        if self._closed:
            raise InputError(f"{self.path}: is closed, no frame can be added")
        if not self.frames:
            self._store.declare(self._layer)
        samples: Samples = {}
        for index, soft in enumerate(self._soft):
            samples |= soft.samples(state.positions[index], state.velocities[index], state.von_mises[index])
        for body, pose in zip(self._bodies, state.bodies, strict=True):
            samples |= body.samples(pose)
        for surface, points in zip(self._surfaces, state.surfaces, strict=True):
            samples |= surface.samples(points)
        self._widen(np.concatenate(state.von_mises))
        self._tops_used.add(self._top)
        samples |= self._colors(samples)
        legend = {"map": COLORMAP_NAME, "quantity": "von Mises stress", "unit": "Pa"}
        self._store.custom_data["stressColors"] = legend | {"lowest": 0.0, "highest": self._top}
        self._store.add(float(self.frames), samples, sum(map(_nbytes, samples.values())))
        self.frames += 1

    def close(self) -> None:
        """Join all frames into one file; called again it does nothing.

        Raises:
            OSError: It could not be written; what was written before stays, and plays.
        """
        if self._closed:
            return
        self._closed = True
        self._store.finish(self._colors if self._tops_used - {self._top} else None)
        if self._flatten and self.frames:
            _flatten(self.path)

    def _widen(self, stress: NDArray[np.float32]) -> None:
        rank = int(0.99 * len(stress))
        self._top = max(self._top, round_limit(float(np.partition(stress, rank)[rank])))

    def _colors(self, samples: Samples) -> Samples:
        colors: Samples = {}
        for soft in self._soft:
            colors |= soft.colors(samples, self._top)
        return colors


class _Store(PieceStore):
    """Frames over a stage: it lies beneath all that is written, and the pieces give values to all its root prims."""

    def __init__(self, path: str | Path, below: Path):
        super().__init__(path)
        self._below = below.resolve()

    def finish(self, transform: Callable[[Samples], Mapping[str, Any]] | None = None) -> None:
        if self._static is not None:
            self._static.subLayerPaths = [_way(self.path, self._below)]
        super().finish(transform)

    def _root_layer(self, pieces: list[tuple[float, float]]) -> Sdf.Layer:
        root = super()._root_layer(pieces)
        if len(root.subLayerPaths) == 1:
            root.subLayerPaths.append(_way(self.path, self._below))
        clips = root.GetPrimAtPath(f"/{root.defaultPrim}").GetInfo("clips")
        for name in sorted({f"/{path.split('/')[1].split('.')[0]}" for path in self._varying}):
            own = {key: dict(values) | {"primPath": name} for key, values in clips.items()}
            Sdf.CreatePrimInLayer(root, name).SetInfo("clips", own)
        return root


def _base_layer(scene: Scene, fps: float) -> Sdf.Layer:
    layer = Sdf.Layer.CreateAnonymous(".usdc")
    source = scene.stage.GetRootLayer()
    for key in source.pseudoRoot.ListInfoKeys():
        if key not in _OWN:
            layer.pseudoRoot.SetInfo(key, source.pseudoRoot.GetInfo(key))
    layer.timeCodesPerSecond = layer.framesPerSecond = fps
    first = scene.stage.GetDefaultPrim() or scene.stage.GetPrimAtPath(scene.tets[0].path)
    layer.defaultPrim = first.GetPath().GetPrefixes()[0].name
    Sdf.CreatePrimInLayer(layer, f"/{layer.defaultPrim}")
    for path in scene.uninstanced:
        Sdf.CreatePrimInLayer(layer, path).SetInfo("instanceable", False)
    return layer


def _way(path: Path, below: Path) -> str:
    """How a layer finds the one below: relative to its own folder, so that both can be moved together."""
    try:
        found = Path(os.path.relpath(below, path.parent.resolve())).as_posix()
    except ValueError:  # another drive
        return usd_name(below)
    return found if found.startswith("../") else f"./{found}"


def _nbytes(value: Any) -> int:
    return 128 if isinstance(value, Gf.Matrix4d) else memoryview(value).nbytes


def _flatten(path: Path) -> None:
    part = path.with_name(f".{path.stem}-flat{path.suffix}")
    try:
        Usd.Stage.Open(usd_name(path)).Flatten().Export(usd_name(part))
        sync(part)
        os.replace(part, path)
    except Tf.ErrorException as error:
        raise OSError(f"{path}: cannot be flattened: {reason(error)}") from None
    finally:
        part.unlink(missing_ok=True)
