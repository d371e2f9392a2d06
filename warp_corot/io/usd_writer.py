"""Simulated frames as a USD stage: the tetrahedra, and their surface for viewers that draw none."""

import logging
import math
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pxr import Gf, Kind, Sdf, Usd, UsdGeom, Vt

from ..errors import InputError
from ..mesh.surface import boundary_faces, signed_volumes
from .colors import (
    COLORMAP_NAME,
    TISSUE,
    VertexAverage,
    color_index,
    round_limit,
    srgb_to_linear,
    stress_colors,
)
from .usd_pieces import PieceStore, Samples

ROOT, TETS, SURFACE = "/SoftBody", "/SoftBody/tetrahedra", "/SoftBody/surface"


class Mesh(Protocol):
    """What the writer needs of a mesh: ``points`` [N, 3] [m] and ``tets`` [T, 4]."""

    @property
    def points(self) -> NDArray[np.float64]: ...

    @property
    def tets(self) -> NDArray[np.int32]: ...


class UsdWriter:
    """Writes one body's frames to a USD stage that opens at any moment, whatever ends the run (see `usd_pieces`).

    The stage, in metres: ``/SoftBody`` (the default prim) with ``tetrahedra``, a `UsdGeom.TetMesh` of purpose *guide*,
    and ``surface``, a `UsdGeom.Mesh` of the surface nodes only, which viewers draw. Frame i is time code i. Of the
    TetMesh: ``points``, ``velocities`` [m/s] and ``extent`` a frame; primvars ``rest`` (vertex), ``fixed`` (vertex, 1
    where held), ``young`` [Pa], ``poisson``, ``density`` [kg/m³] (constant, or uniform: one a tetrahedron) and
    ``vonMises`` [Pa] (uniform, a frame). Both prims show the stress as ``displayColor``: averages over the tetrahedra
    around each node, as indices into the 256 colours of `colors.stress_colors`; custom data of ``/SoftBody`` name the
    map and its range.

    The colour range, unless given, starts at 0 and ends at the 99th percentile of the highest frame so far, rounded
    up to few digits (`colors.round_limit`); on closing, earlier frames are coloured again with the last range, so that
    one range holds for all.

    Mirrored tetrahedra are written with two indices swapped, so that all are right-handed as the schema wants.

    Args:
        path: Where to: .usd or .usdc (binary) or .usda (text). A file there stays until the first frames are safe.
        mesh: The body's mesh at rest.
        fps: Frames per second of simulated time.
        fixed: Held nodes, mask [N] or indices.
        material: Has ``young`` [Pa], ``poisson``, ``density`` [kg/m³], each a number or an array [T].
        up_axis: "X", "Y" or "Z"; None: the mesh's own, else "Y".
        stress_range: Lowest and highest stress of the colour map [Pa].
        flush_seconds: About the most wall time [s] whose frames a sudden end may lose.

    Raises:
        InputError: A path that cannot be written to (said now, not after the simulation), or arguments that do not fit.
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
        stress_range: tuple[float, float] | None = None,
        flush_seconds: float = 2.0,
    ):
        up_axis = up_axis or getattr(mesh, "up_axis", "Y")
        if up_axis not in ("X", "Y", "Z"):
            raise InputError(f"up_axis is {up_axis!r}, should be X, Y or Z")
        if not (np.isfinite(fps) and fps > 0.0):
            raise InputError(f"fps is {fps}, should be a positive number")
        if stress_range is not None and not 0.0 <= stress_range[0] < stress_range[1] < math.inf:
            raise InputError(f"stress_range is {stress_range}, should be two rising stresses in Pa")
        self._store = PieceStore(path, flush_seconds=flush_seconds)
        self.path = self._store.path
        self.frames = 0
        self._fps = float(fps)
        self._up_axis = up_axis
        self._fixed = fixed
        self._material = material

        self._rest = np.ascontiguousarray(mesh.points, dtype=np.float32)
        volumes = signed_volumes(mesh.points, mesh.tets)
        self._tets = _right_handed(np.asarray(mesh.tets, dtype=np.int32), volumes < 0.0)
        self._faces, _ = boundary_faces(self._tets)
        self._surface_nodes, compact = np.unique(self._faces, return_inverse=True)
        self._surface_faces = compact.reshape(-1, 3).astype(np.int32)
        self._average = VertexAverage(self._tets, np.abs(volumes), len(self._rest))
        self._range_given = stress_range is not None
        self._stress_range = stress_range or (0.0, 0.0)
        self._ranges_used: set[tuple[float, float]] = set()
        self._given: tuple[bool, bool] | None = None  # velocities, von_mises
        self._closed = False

    @property
    def stress_range(self) -> tuple[float, float]:
        """Stresses [Pa] at the two ends of the colour map, so far."""
        return self._stress_range

    def write(
        self, positions: ArrayLike, *, velocities: ArrayLike | None = None, von_mises: ArrayLike | None = None
    ) -> None:
        """Adds a frame; all frames give the same of the optional arguments.

        Args:
            positions: [N, 3] [m], in the mesh's node order.
            velocities: [N, 3] [m/s].
            von_mises: [T] [Pa].

        Raises:
            InputError: A shape that does not fit the mesh, or another choice of arguments than in the first frame.
            OSError: Could not be written, as when the disk is full; the frames of the pieces before stay and play.
        """
        if self._closed:
            raise InputError(f"{self.path}: is closed, no frame can be added")
        given = (velocities is not None, von_mises is not None)
        if self._given is None:
            self._given = given
            self._store.declare(self._static_layer())
        elif given != self._given:
            raise InputError("velocities and von_mises must be given either for every frame or for none")

        x = _floats(positions, (len(self._rest), 3), "positions")
        surface = x[self._surface_nodes]
        samples: Samples = {
            f"{TETS}.points": Vt.Vec3fArray.FromNumpy(x),
            f"{TETS}.extent": _extent(x),
            f"{SURFACE}.points": Vt.Vec3fArray.FromNumpy(surface),
            f"{SURFACE}.extent": _extent(surface),
        }
        nbytes = x.nbytes + surface.nbytes
        if velocities is not None:
            v = _floats(velocities, x.shape, "velocities")
            samples[f"{TETS}.velocities"] = Vt.Vec3fArray.FromNumpy(v)
            nbytes += v.nbytes
        if von_mises is not None:
            stress = _floats(von_mises, (len(self._tets),), "von_mises")
            samples[f"{TETS}.primvars:vonMises"] = Vt.FloatArray.FromNumpy(stress)
            self._widen_range(stress)
            samples |= self._color(stress)
            nbytes += stress.nbytes + 4 * (len(x) + len(surface))
            self._store.custom_data["stressColors"] = self._color_legend()
        self._store.add(float(self.frames), samples, nbytes)
        self.frames += 1

    def flush(self) -> None:
        """Makes the frames so far safe now, instead of when it is time to; the stage plays them.

        Raises:
            OSError: as `write`.
        """
        self._store.flush()

    def close(self) -> None:
        """Joins all frames into one file and removes the pieces; called again it does nothing.

        Raises:
            OSError: The joined file could not be written; the pieces stay, and the stage plays them.
        """
        if self._closed:
            return
        self._closed = True
        recolor = self._ranges_used - {self._stress_range}
        self._store.finish(self._recolor if recolor else None)

    def __enter__(self) -> "UsdWriter":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            self.close()
        except OSError as error:
            if kind is None:
                raise
            logging.getLogger(__name__).warning("%s", error)  # the first error is the one to raise

    def _widen_range(self, stress: NDArray[np.float32]) -> None:
        if self._range_given or len(stress) == 0:
            return
        rank = min(len(stress) - 1, int(0.99 * len(stress)))
        top = round_limit(float(np.partition(stress, rank)[rank]))
        if top > self._stress_range[1]:
            self._stress_range = (0.0, top)

    def _color(self, stress: NDArray[np.float32]) -> Samples:
        self._ranges_used.add(self._stress_range)
        indices = color_index(self._average(stress), *self._stress_range)
        return {
            f"{TETS}.primvars:displayColor:indices": Vt.IntArray.FromNumpy(indices),
            f"{SURFACE}.primvars:displayColor:indices": Vt.IntArray.FromNumpy(indices[self._surface_nodes]),
        }

    def _color_legend(self) -> dict[str, Any]:
        lowest, highest = self._stress_range
        return {
            "map": COLORMAP_NAME,
            "quantity": "von Mises stress",
            "unit": "Pa",
            "lowest": lowest,
            "highest": highest,
        }

    def _recolor(self, samples: Samples) -> Samples:
        return self._color(np.asarray(samples[f"{TETS}.primvars:vonMises"]))

    def _static_layer(self) -> Sdf.Layer:
        """Everything that does not change, and the attributes that do, without values."""
        assert self._given is not None
        with_velocities, with_stress = self._given
        layer = Sdf.Layer.CreateAnonymous(".usdc")
        stage = Usd.Stage.Open(layer)
        UsdGeom.SetStageUpAxis(stage, self._up_axis)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        stage.SetTimeCodesPerSecond(self._fps)
        stage.SetFramesPerSecond(self._fps)
        root = UsdGeom.Xform.Define(stage, ROOT).GetPrim()
        stage.SetDefaultPrim(root)
        Usd.ModelAPI(root).SetKind(Kind.Tokens.component)

        tets = UsdGeom.TetMesh.Define(stage, TETS)
        tets.CreateTetVertexIndicesAttr(Vt.Vec4iArray.FromNumpy(self._tets))
        tets.CreateSurfaceFaceVertexIndicesAttr(Vt.Vec3iArray.FromNumpy(self._faces))
        tets.CreateOrientationAttr(UsdGeom.Tokens.rightHanded)
        # Drawn beside its surface it would show twice, and Hydra takes its uniform primvars for values per face.
        tets.CreatePurposeAttr(UsdGeom.Tokens.guide)
        if with_velocities:
            tets.CreateVelocitiesAttr()

        surface = UsdGeom.Mesh.Define(stage, SURFACE)
        surface.CreateFaceVertexCountsAttr(Vt.IntArray(len(self._surface_faces), 3))
        surface.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(self._surface_faces.reshape(-1)))
        surface.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        surface.CreateOrientationAttr(UsdGeom.Tokens.rightHanded)
        for body in (tets, surface):
            body.CreatePointsAttr()
            body.CreateExtentAttr()
            self._declare_color(body, with_stress)

        primvars = UsdGeom.PrimvarsAPI(tets)
        rest = Vt.Vec3fArray.FromNumpy(self._rest)
        primvars.CreatePrimvar("rest", Sdf.ValueTypeNames.Point3fArray, UsdGeom.Tokens.vertex).Set(rest)
        if with_stress:
            stress = primvars.CreatePrimvar("vonMises", Sdf.ValueTypeNames.FloatArray, UsdGeom.Tokens.uniform)
            stress.GetAttr().SetDocumentation("Von Mises stress of each tetrahedron [Pa]")
        if self._fixed is not None:
            held = np.zeros(len(self._rest), np.int32)
            held[np.asarray(self._fixed)] = 1
            fixed = primvars.CreatePrimvar("fixed", Sdf.ValueTypeNames.IntArray, UsdGeom.Tokens.vertex)
            fixed.Set(Vt.IntArray.FromNumpy(held))
            fixed.GetAttr().SetDocumentation("1 where the node is held")
        for name, unit in (("young", " [Pa]"), ("poisson", ""), ("density", " [kg/m³]")):
            value = getattr(self._material, name, None)
            if value is not None:
                self._declare_property(primvars, name, np.asarray(value, dtype=np.float32), unit)
        return layer

    def _declare_color(self, body: UsdGeom.Gprim, with_stress: bool) -> None:
        if not with_stress:
            color = body.CreateDisplayColorPrimvar(UsdGeom.Tokens.constant)
            color.Set(Vt.Vec3fArray([Gf.Vec3f(*srgb_to_linear(TISSUE))]))
            return
        color = body.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex)
        color.Set(Vt.Vec3fArray.FromNumpy(srgb_to_linear(stress_colors()).astype(np.float32)))
        color.CreateIndicesAttr()

    def _declare_property(
        self, primvars: UsdGeom.PrimvarsAPI, name: str, value: NDArray[np.float32], unit: str
    ) -> None:
        if value.size == 1:
            primvar = primvars.CreatePrimvar(name, Sdf.ValueTypeNames.Float, UsdGeom.Tokens.constant)
            primvar.Set(float(value.reshape(())))
        else:
            values = _floats(value, (len(self._tets),), f"material.{name}")
            primvar = primvars.CreatePrimvar(name, Sdf.ValueTypeNames.FloatArray, UsdGeom.Tokens.uniform)
            primvar.Set(Vt.FloatArray.FromNumpy(values))
        primvar.GetAttr().SetDocumentation(f"Material: {name}{unit}")


def _right_handed(tets: NDArray[np.int32], mirrored: NDArray[np.bool_]) -> NDArray[np.int32]:
    turned = tets.copy()
    turned[mirrored, 2], turned[mirrored, 3] = tets[mirrored, 3], tets[mirrored, 2]
    return turned


def _floats(values: Any, shape: tuple[int, ...], name: str) -> NDArray[np.float32]:
    array = np.ascontiguousarray(values.numpy() if hasattr(values, "numpy") else values, dtype=np.float32)
    if array.shape != shape:
        raise InputError(f"{name} has shape {list(array.shape)}, should be {list(shape)}")
    return array


def _extent(points: NDArray[np.float32]) -> Vt.Vec3fArray:
    return Vt.Vec3fArray.FromNumpy(np.stack([points.min(axis=0), points.max(axis=0)]))
