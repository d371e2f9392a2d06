"""Simulated frames as a USD stage: the tetrahedra and their boundary, or smooth surfaces in place of it."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pxr import Kind, Sdf, Usd, UsdGeom

from warp_corot.contact.tool import Obstacle
from warp_corot.errors import InputError
from warp_corot.io.pictures.colors import VertexAverage
from warp_corot.io.write.animate import KEY
from warp_corot.io.write.skins import Skin
from warp_corot.mesh.topology import right_handed, signed_volumes

from .physics import ObstaclePrim, declare_physics, obstacle_prims
from .pieces import ColoredStage, Samples
from .prims import ROOT, SURFACE, TETS, Frame, Present, SkinPrim, Statics, TetPrims, Touched, floats, skin_paths

__all__ = ["ROOT", "SURFACE", "TETS", "Mesh", "UsdWriter"]


class Mesh(Protocol):
    """The part of a mesh that the writer needs: ``points`` [N, 3] [m] and ``tets`` [T, 4]."""

    @property
    def points(self) -> NDArray[np.float64]: ...

    @property
    def tets(self) -> NDArray[np.int32]: ...


class UsdWriter(ColoredStage):
    """Write one body's frames to a USD stage that is valid at any moment, even if the run is killed (see `usd.pieces`).

    The stage, in metres, has ``/SoftBody`` (the default prim) with ``tetrahedra``, a `UsdGeom.TetMesh` of purpose
    *guide*, and ``surface``, a `UsdGeom.Mesh` of only the surface nodes, which viewers draw. Frame i is time code i.
    Both have ``points``, ``velocities`` [m/s] and ``extent`` in each frame. The TetMesh has primvars ``rest`` (vertex),
    ``fixed`` (vertex, 1 if held), ``young`` [Pa], ``poisson``, ``density`` [kg/m³] (constant, or uniform: one a
    tetrahedron) and ``vonMises`` [Pa] (uniform, in each frame). With contact, both have ``contactForce`` [N] and
    ``contactPressure`` [Pa] (vertex, in each frame). Both show the stress as ``displayColor``: averages over the
    tetrahedra around each node, as indices into the 256 colours of `colors.stress_colors`; custom
    data of ``/SoftBody`` name the map and its range. ``/SoftBody/physics`` has the physics materials, and with
    ``gravity`` a physics scene, see `usd.physics.declare_physics`.

    Mirrored tetrahedra are written with two indices swapped, so that all are right-handed as the schema requires.

    With ``skins`` these surfaces replace ``surface``, and the TetMesh is only written if ``tets`` is set.
    A single one is the Mesh ``surface``; several are Meshes under their own names. Each has ``points``, ``normals``,
    ``extent`` and the primvar ``vonMises`` (vertex [Pa]) in each frame, coloured in the same way. A skin with a prim's
    look has that prim's faces, primvars, subsets and materials (copied to ``/SoftBody/materials``) and colours instead,
    and vertex normals if the prim had normals.

    For a body whose mesh changes, ``tetVertexIndices`` and all attributes per tetrahedron, node or face are time
    samples too; those that are not given in each frame are given when the mesh changes, and hold until then. OpenUSD
    interpolates neither integers nor arrays of different lengths; if lengths agree by chance, a sample just before the
    frame (by `usd.pieces.JUST_BEFORE`) prevents the interpolation of different nodes. Between frames points move with
    their ``velocities``, as the schema defines it for meshes that change.

    Obstacles are prims below ``/SoftBody/obstacles``: a Sphere, Capsule, Cylinder, Cube or Plane each; a tool has its
    place, its turn and the force and torque on it in each frame (`usd.physics.ObstaclePrim`).

    Args:
        path: The output: .usd or .usdc (binary) or .usda (text). A former file stays until the first frames are
            complete.
        mesh: The body's mesh at rest.
        fps: Frames per second of simulated time.
        fixed: Fixed nodes, mask [N] or indices.
        material: An object with ``young`` [Pa], ``poisson``, ``density`` [kg/m³], each a number or an array [T].
        up_axis: "X", "Y" or "Z"; None: the mesh's own, else "Y".
        flush_seconds: Approximate wall time [s] whose frames a sudden end may lose.
        skins: Surfaces bound to the mesh's nodes.
        tets: Whether to write the TetMesh; None: only without skins.
        changing: Whether the mesh may change between frames (`change_mesh`).
        gravity: Acceleration [m/s^2], for a physics scene.
        obstacles: The obstacles of the simulation.
        world: The world in which tools are drawn.

    Attributes:
        about: Data about the run for the layer's custom data, under "warp_corot"; entries may be added until it is
            closed.

    Raises:
        InputError: A path that cannot be written to (checked before the simulation), or arguments that do not fit.
    """

    def __init__(
        self,
        path: str | Path,
        mesh: Mesh,
        *,
        fps: float,
        fixed: ArrayLike | None = None,
        material: Any = None,
        up_axis: str | None = None,
        flush_seconds: float = 2.0,
        skins: Sequence[Skin] = (),
        tets: bool | None = None,
        changing: bool = False,
        gravity: Sequence[float] | None = None,
        obstacles: Sequence[Obstacle] = (),
        world: int = 0,
    ):
        up_axis = up_axis or getattr(mesh, "up_axis", "Y")
        if up_axis not in ("X", "Y", "Z"):
            raise InputError(f"up_axis is {up_axis!r}; it must be X, Y or Z")
        if not (np.isfinite(fps) and fps > 0.0):
            raise InputError(f"fps is {fps}; it must be a positive number")
        super().__init__(path, flush_seconds=flush_seconds)
        self._fps = float(fps)
        self._up_axis = up_axis
        self._changing = changing
        self._gravity = gravity
        self.about: dict[str, Any] = {}
        self._present = _present(mesh, fixed, material)
        self._tets = TetPrims(self._present, boundary=not skins, changing=changing) if tets or not skins else None
        named = zip(skins, skin_paths(skins), strict=True)
        self._skins = [SkinPrim(skin, path, mesh.points, changing=changing) for skin, path in named]
        self._prims: list[TetPrims | SkinPrim | ObstaclePrim] = [*([self._tets] if self._tets else []), *self._skins]
        self._prims += obstacle_prims(obstacles, self._present.points, world)
        self._given: Statics | None = None

    def change_mesh(
        self, mesh: Mesh, *, fixed: ArrayLike | None = None, material: Any = None, skins: Sequence[Skin] = ()
    ) -> None:
        """Give the body another mesh of the same region, from the next frame on.

        Args:
            mesh: The mesh at rest.
            fixed, material: As in the constructor.
            skins: The same surfaces, bound to the mesh.

        Raises:
            InputError: The writer was made without ``changing``, or the number of skins differs.
        """
        if not self._changing:
            raise InputError(f"{self.path}: the mesh cannot change; the writer must be made with changing=True")
        if len(skins) != len(self._skins):
            raise InputError(f"there are {len(skins)} skins now; there must be {len(self._skins)} as before")
        self._present = _present(mesh, fixed, material)
        if self._tets:
            self._tets.follow(self._present)
        for prim, skin in zip(self._skins, skins, strict=True):
            prim.follow(skin, mesh.points)

    def write(
        self,
        positions: ArrayLike,
        *,
        velocities: ArrayLike | None = None,
        von_mises: ArrayLike | None = None,
        touched: Touched | None = None,
    ) -> None:
        """Add a frame; all frames must have the same optional arguments.

        Args:
            positions: [N, 3] [m], in the mesh's node order.
            velocities: [N, 3] [m/s].
            von_mises: [T] [Pa].
            touched: Contact on the body.

        Raises:
            InputError: A shape that does not fit the mesh, or other optional arguments than in the first frame.
            OSError: It could not be written, for example because the disk is full; former frames stay and play.
        """
        self._check_open()
        given = Statics(velocities is not None, von_mises is not None, touched is not None)
        if self._given is None:
            self._given = given
            self.declare(self._static_layer(), self._drawn_anew())
        elif given != self._given:
            raise InputError("velocities, von_mises and contact must be given either for every frame or for none")

        x = floats(positions, self._present.points.shape, "positions")
        v = None if velocities is None else floats(velocities, x.shape, "velocities")
        stress = nodal = None
        if von_mises is not None:
            stress = floats(von_mises, (len(self._present.tets),), "von_mises")
            nodal = self._present.average(stress)
        self.layer_data = {KEY: self.about} if self.about else {}
        frame = Frame(x, v, stress, nodal, touched)
        samples: Samples = {}
        for prim in self._prims:
            samples |= prim.samples(frame)
        self._add(samples, stress, nodal)

    def _colors(self, samples: Samples, nodal: NDArray[np.float64] | None = None) -> Samples:
        colors: Samples = {}
        for prim in self._prims:
            colors |= prim.colors(samples, self.stress_range, nodal)
        return colors

    def _drawn_anew(self) -> dict[str, str]:
        found: dict[str, str] = {}
        for prim in self._prims:
            found |= prim.follows
        return found if self._changing else {}

    def _static_layer(self) -> Sdf.Layer:
        """The layer with everything that does not change, and the attributes that do, without values."""
        assert self._given is not None
        layer = Sdf.Layer.CreateAnonymous(".usdc")
        stage = Usd.Stage.Open(layer)
        UsdGeom.SetStageUpAxis(stage, self._up_axis)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        stage.SetTimeCodesPerSecond(self._fps)
        stage.SetFramesPerSecond(self._fps)
        root = UsdGeom.Xform.Define(stage, ROOT).GetPrim()
        stage.SetDefaultPrim(root)
        Usd.ModelAPI(root).SetKind(Kind.Tokens.component)
        for prim in self._prims:
            prim.declare(stage, self._given)
        declare_physics(
            stage,
            self._present,
            with_tets=self._tets is not None,
            changing=self._changing,
            gravity=self._gravity,
        )
        return layer


def _present(mesh: Mesh, fixed: ArrayLike | None, material: Any) -> Present:
    points = np.asarray(mesh.points, dtype=np.float64)
    volumes = signed_volumes(points, mesh.tets)
    tets = right_handed(np.asarray(mesh.tets, dtype=np.int32), volumes < 0.0)
    return Present(points, tets, VertexAverage(tets, np.abs(volumes), len(points)), fixed, material)
