"""The prims of an animated body's tetrahedra and of their boundary, also for meshes that change."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import Sdf, UsdGeom, Vt

from warp_corot.io.pictures.colors import VertexAverage, color_index
from warp_corot.mesh.surfaces.boundary import boundary_faces, signed_volumes

from .pieces import Samples
from .prims import (
    SURFACE,
    TETS,
    Frame,
    Limits,
    Present,
    Statics,
    declare_moving,
    declare_triangles,
    extent,
    floats,
    triangle_samples,
)
from .touched import ATTRIBUTES, declare_touched

INDICES = f"{TETS}.tetVertexIndices"
FACES = f"{TETS}.surfaceFaceVertexIndices"
REST = f"{TETS}.primvars:rest"
STRESS = f"{TETS}.primvars:vonMises"
UNITS = {"young": " [Pa]", "poisson": "", "density": " [kg/m³]"}


class TetPrims:
    """The TetMesh prim and, if it is drawn, the Mesh of the boundary.

    Args:
        present: The body at rest.
        boundary: Whether the boundary is drawn.
        changing: Whether the mesh may change.
    """

    def __init__(self, present: Present, *, boundary: bool, changing: bool):
        self._boundary = boundary
        self._changing = changing
        self._uniform = [name for name in UNITS if np.size(getattr(present.material, name, 0.0)) == 1]
        self._said: tuple[Present, SurfaceTriangles] | None = None
        self.follow(present)

    def follow(self, present: Present) -> None:
        """Draw this mesh from the next frame on."""
        self._present = present
        self._surface = SurfaceTriangles(boundary_faces(present.tets)[0])

    @property
    def follows(self) -> dict[str, str]:
        """See `PieceStore.declare`."""
        moving = ("points", "velocities", *ATTRIBUTES)
        own = [*moving, "primvars:rest", "primvars:vonMises", *(f"primvars:{name}" for name in UNITS)]
        found = {f"{TETS}.{name}": INDICES for name in own}
        return found | {f"{SURFACE}.{name}": f"{SURFACE}.faceVertexIndices" for name in moving}

    def declare(self, stage: Any, statics: Statics) -> None:
        """Declare everything that does not change, and the attributes that do, without values."""
        tets = UsdGeom.TetMesh.Define(stage, TETS)
        tets.CreateTetVertexIndicesAttr()
        tets.CreateSurfaceFaceVertexIndicesAttr()
        tets.CreateOrientationAttr(UsdGeom.Tokens.rightHanded)
        # Beside its surface it would be drawn twice, and Hydra takes its uniform primvars for values per face.
        tets.CreatePurposeAttr(UsdGeom.Tokens.guide)
        if statics.velocities:
            tets.CreateVelocitiesAttr()
        self._declare_primvars(UsdGeom.PrimvarsAPI(tets), statics)
        declare_moving(tets, statics.stress)
        if statics.touched:
            declare_touched(tets)
        if self._boundary:
            surface = UsdGeom.Mesh.Define(stage, SURFACE)
            declare_triangles(surface)
            declare_moving(surface, statics.stress)
            if statics.velocities:
                surface.CreateVelocitiesAttr()
            if statics.touched:
                declare_touched(surface)
        if not self._changing:
            for path, value in {**self._topology(), **self._surface_topology()}.items():
                stage.GetAttributeAtPath(path).Set(value)

    def samples(self, frame: Frame) -> Samples:
        """Values of a frame without colours."""
        x, v = frame.positions, frame.velocities
        samples: Samples = {f"{TETS}.points": Vt.Vec3fArray.FromNumpy(x), f"{TETS}.extent": extent(x)}
        if v is not None:
            samples[f"{TETS}.velocities"] = Vt.Vec3fArray.FromNumpy(v)
        if frame.stress is not None:
            samples[STRESS] = Vt.FloatArray.FromNumpy(frame.stress)
        if frame.touched is not None:
            samples |= frame.touched.samples(TETS)
            samples |= frame.touched.samples(SURFACE, self._surface.nodes) if self._boundary else {}
        if self._boundary:
            nodes = self._surface.nodes
            samples |= {f"{SURFACE}.points": Vt.Vec3fArray.FromNumpy(x[nodes]), f"{SURFACE}.extent": extent(x[nodes])}
            if v is not None:
                samples[f"{SURFACE}.velocities"] = Vt.Vec3fArray.FromNumpy(v[nodes])
        return samples | self._changes() if self._changing else samples

    def colors(self, samples: Samples, limits: Limits, nodal: NDArray[np.float64] | None = None) -> Samples:
        """Colours for the stresses of a frame, and the data of the mesh if it has changed."""
        if STRESS not in samples:
            return {}
        if nodal is None:
            nodal = self._averaged(samples)
        indices = color_index(nodal, *limits)
        colors = {f"{TETS}.primvars:displayColor:indices": Vt.IntArray.FromNumpy(indices)}
        if self._boundary:
            on_surface = Vt.IntArray.FromNumpy(indices[self._surface.nodes])
            colors[f"{SURFACE}.primvars:displayColor:indices"] = on_surface
        return colors

    def _averaged(self, samples: Samples) -> NDArray[np.float64]:
        stress = np.asarray(samples[STRESS])
        if INDICES in samples and self._changing:
            points, tets = np.asarray(samples[REST], dtype=np.float64), np.asarray(samples[INDICES])
            average = VertexAverage(tets, np.abs(signed_volumes(points, tets)), len(points))
            self._present = self._present._replace(points=points, tets=tets, average=average)
            self._surface = SurfaceTriangles(np.asarray(samples[FACES]))
        return self._present.average(stress)

    def _changes(self) -> Samples:
        """Changed values among those that do not change in every frame."""
        before, self._said = self._said, (self._present, self._surface)
        if before is not None and before[0] is self._present:
            return {}
        samples: Samples = {}
        if before is None or not _are_same(before[0], self._present):
            samples |= self._topology()
        if before is None or not self._is_same_surface(*before):
            samples |= self._surface_topology()
        return samples

    def _is_same_surface(self, present: Present, surface: SurfaceTriangles) -> bool:
        return np.array_equal(surface.triangles, self._surface.triangles) and np.array_equal(
            present.points[surface.nodes], self._present.points[self._surface.nodes]
        )

    def _topology(self) -> Samples:
        present = self._present
        samples: Samples = {
            INDICES: Vt.Vec4iArray.FromNumpy(present.tets),
            FACES: Vt.Vec3iArray.FromNumpy(self._surface.faces),
            REST: Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(present.points, dtype=np.float32)),
        }
        if present.fixed is not None:
            held = np.zeros(len(present.points), np.int32)
            held[np.asarray(present.fixed)] = 1
            samples[f"{TETS}.primvars:fixed"] = Vt.IntArray.FromNumpy(held)
        for name in UNITS:
            value = getattr(present.material, name, None)
            if value is not None and name not in self._uniform:
                given = np.broadcast_to(value, (len(present.tets),)) if np.ndim(value) == 0 else value
                values = floats(given, (len(present.tets),), f"material.{name}")
                samples[f"{TETS}.primvars:{name}"] = Vt.FloatArray.FromNumpy(values)
        return samples

    def _surface_topology(self) -> Samples:
        return triangle_samples(SURFACE, self._surface.triangles) if self._boundary else {}

    def _declare_primvars(self, primvars: Any, statics: Statics) -> None:
        types, tokens = Sdf.ValueTypeNames, UsdGeom.Tokens
        primvars.CreatePrimvar("rest", types.Point3fArray, tokens.vertex)
        if statics.stress:
            stress = primvars.CreatePrimvar("vonMises", types.FloatArray, tokens.uniform)
            stress.GetAttr().SetDocumentation("Von Mises stress of each tetrahedron [Pa]")
        if self._present.fixed is not None:
            fixed = primvars.CreatePrimvar("fixed", types.IntArray, tokens.vertex)
            fixed.GetAttr().SetDocumentation("1 where the node is held")
        for name, unit in UNITS.items():
            value = getattr(self._present.material, name, None)
            if value is None:
                continue
            if name in self._uniform:
                primvar = primvars.CreatePrimvar(name, types.Float, tokens.constant)
                primvar.Set(float(np.asarray(value).reshape(())))
            else:
                primvar = primvars.CreatePrimvar(name, types.FloatArray, tokens.uniform)
            primvar.GetAttr().SetDocumentation(f"Material: {name}{unit}")


class SurfaceTriangles:
    """The boundary of tetrahedra: its faces [F, 3] in the mesh's nodes, and its own nodes and triangles."""

    def __init__(self, faces: NDArray[np.int32]):
        self.faces = faces
        self.nodes, compact = np.unique(faces, return_inverse=True)
        self.triangles = compact.reshape(-1, 3).astype(np.int32)


def _are_same(one: Present, other: Present) -> bool:
    return np.array_equal(one.tets, other.tets) and np.array_equal(one.points, other.points)
