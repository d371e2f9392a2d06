"""The prims of an animated body: its tetrahedra, their boundary, surfaces that are bound to it, and contact."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pxr import Gf, Sdf, Tf, UsdGeom, UsdShade, Vt

from warp_corot.errors import InputError
from warp_corot.io.files.usd import free_name
from warp_corot.io.pictures.colors import TISSUE, VertexAverage, color_index, srgb_to_linear, stress_colors
from warp_corot.io.write.skins import Skin
from warp_corot.mesh.surfaces.bound import vertex_normals
from warp_corot.mesh.topology import boundary_faces

from .pieces import Samples

# --- contact as primvars: the force on each node, and the pressure ---------------------------------------------------

FORCE, PRESSURE = "contactForce", "contactPressure"
#: The attributes of a prim that change with its mesh.
ATTRIBUTES = (f"primvars:{FORCE}", f"primvars:{PRESSURE}")


class Touched(NamedTuple):
    """Contact in a frame: forces on nodes [N], float32 [N, 3], and pressure averaged at nodes [Pa], float32 [N]."""

    forces: NDArray[np.float32]
    pressure: NDArray[np.float32]

    def samples(self, path: str) -> Samples:
        """The primvars of a prim with the nodes."""
        return {
            f"{path}.primvars:{FORCE}": Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(self.forces)),
            f"{path}.primvars:{PRESSURE}": Vt.FloatArray.FromNumpy(np.ascontiguousarray(self.pressure)),
        }


def declare_touched(prim: Any, *, forces: bool = True) -> None:
    """Declare the primvars, without values."""
    primvars, types, vertex = UsdGeom.PrimvarsAPI(prim), Sdf.ValueTypeNames, UsdGeom.Tokens.vertex
    if forces:
        force = primvars.CreatePrimvar(FORCE, types.Vector3fArray, vertex)
        force.GetAttr().SetDocumentation("Contact force on each node in the last step [N]")
    pressure = primvars.CreatePrimvar(PRESSURE, types.FloatArray, vertex)
    pressure.GetAttr().SetDocumentation("Contact pressure in the last step, averaged over the triangles around [Pa]")


# --- what all prims share, and surfaces ------------------------------------------------------------------------------

ROOT, TETS, SURFACE = "/SoftBody", "/SoftBody/tetrahedra", "/SoftBody/surface"
MATERIALS = "/SoftBody/materials"
#: The subset of a surface with the faces of cuts, its material, and the colour inside tissue (sRGB).
CUT = "cut"
INSIDE = (0.55, 0.12, 0.12)
PHYSICS = "/SoftBody/physics"
OBSTACLES = "/SoftBody/obstacles"

Limits = tuple[float, float]


class Frame(NamedTuple):
    """One frame: positions [N, 3], velocities [N, 3] or None, stress [T] or None and its averages at nodes [N], contact
    or None."""

    positions: NDArray[np.float32]
    velocities: NDArray[np.float32] | None
    stress: NDArray[np.float32] | None
    nodal: NDArray[np.float64] | None
    touched: Touched | None = None


class Present(NamedTuple):
    """A body's mesh: rest positions [N, 3] [m], right-handed tetrahedra, int32 [T, 4], the average from
    tetrahedra to nodes, held nodes (a mask or indices) or None, and the material or None."""

    points: NDArray[np.float64]
    tets: NDArray[np.int32]
    average: VertexAverage
    fixed: Any
    material: Any


@dataclass(frozen=True)
class Statics:
    """Properties of all frames: whether they have velocities, stress and contact."""

    velocities: bool
    stress: bool
    touched: bool


class SkinPrim:
    """The Mesh prim of a surface that is bound to the body's nodes.

    Args:
        skin: The surface.
        path: Path of the prim.
        rest: Points of the body's mesh at rest [m], [N, 3].
        changing: Whether the mesh may change, and with it some surfaces.
    """

    def __init__(self, skin: Skin, path: str, rest: NDArray[np.float64], *, changing: bool):
        self._path = path
        self._changing = changing and skin.changes
        self._said: Skin | None = None
        look = skin.look
        self._with_colors = look is None or look.is_plain
        self.follow(skin, rest)
        # The boundary of tetrahedra has none: its edges would look round.
        self._with_normals = self._nodes is None if look is None else look.had_normals and not look.smooth

    def follow(self, skin: Skin, rest: NDArray[np.float64]) -> None:
        """Draw the surface bound to another mesh with these rest positions from the next frame on."""
        self._skin, self._rest = skin, np.asarray(rest, dtype=np.float64)
        # Each point of the boundary of tetrahedra is a node.
        surface = skin.surface
        is_boundary = (surface.weights[:, 0] == 1.0).all() and not surface.weights[:, 1:].any()
        self._nodes = np.ascontiguousarray(surface.nodes[:, 0]) if is_boundary else None

    def _at_points(self, nodal: NDArray[np.floating]) -> NDArray[np.float32]:
        """Values at nodes, [N] or [N, 3], at the points, [V] or [V, 3]."""
        surface = self._skin.surface
        if self._nodes is not None:
            return nodal[self._nodes].astype(np.float32)
        return np.einsum("vn,vn...->v...", surface.weights, nodal[surface.nodes]).astype(np.float32)

    @property
    def follows(self) -> dict[str, str]:
        """See `PieceStore.declare`."""
        own = ("points", "normals", "velocities", "primvars:vonMises", *ATTRIBUTES)
        return {f"{self._path}.{name}": f"{self._path}.faceVertexIndices" for name in own}

    def declare(self, stage: Any, statics: Statics) -> None:
        """As in `TetPrims.declare`."""
        look, surface = self._skin.look, self._skin.surface
        if look is not None:
            look.copy_to(stage.GetRootLayer(), self._path, MATERIALS)
            mesh = UsdGeom.Mesh.Get(stage, self._path)
        else:
            mesh = UsdGeom.Mesh.Define(stage, self._path)
            declare_triangles(mesh)
            if not self._changing:
                for path, value in triangle_samples(self._path, surface.triangles).items():
                    stage.GetAttributeAtPath(path).Set(value)
        if self._changing and self._skin.is_cut:
            declare_cut(mesh, self._path, statics.stress)
        mesh.GetPrim().SetDisplayName(self._skin.name)
        if self._with_normals:
            mesh.CreateNormalsAttr()
            mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
        if statics.velocities:
            mesh.CreateVelocitiesAttr()
        if statics.stress:
            primvars = UsdGeom.PrimvarsAPI(mesh)
            stress = primvars.CreatePrimvar("vonMises", Sdf.ValueTypeNames.FloatArray, UsdGeom.Tokens.vertex)
            stress.GetAttr().SetDocumentation("Von Mises stress, averaged over the tetrahedra around [Pa]")
        if statics.touched:
            declare_touched(mesh, forces=False)
        declare_moving(mesh, statics.stress, colored=self._with_colors)

    def samples(self, frame: Frame) -> Samples:
        """As in `TetPrims.samples`."""
        surface = self._skin.surface
        x = frame.positions[self._nodes] if self._nodes is not None else surface.moved(frame.positions - self._rest)
        x = x.astype(np.float32, copy=False)
        samples: Samples = {
            f"{self._path}.points": Vt.Vec3fArray.FromNumpy(x),
            f"{self._path}.extent": extent(x),
        }
        if self._with_normals:
            normals = vertex_normals(x.astype(np.float64), surface.triangles).astype(np.float32)
            samples[f"{self._path}.normals"] = Vt.Vec3fArray.FromNumpy(normals)
        if frame.nodal is not None:
            samples[f"{self._path}.primvars:vonMises"] = Vt.FloatArray.FromNumpy(self._at_points(frame.nodal))
        if frame.touched is not None:
            pressure = Vt.FloatArray.FromNumpy(self._at_points(frame.touched.pressure))
            samples[f"{self._path}.primvars:{PRESSURE}"] = pressure
        if frame.velocities is not None:
            samples[f"{self._path}.velocities"] = Vt.Vec3fArray.FromNumpy(self._at_points(frame.velocities))
        if self._changing:
            said = None if self._said is None else self._said.surface
            names = ("triangles", "points", "of_cut")
            if said is None or not all(np.array_equal(getattr(said, name), getattr(surface, name)) for name in names):
                samples |= triangle_samples(self._path, surface.triangles)
                if self._skin.is_cut:
                    inside = np.flatnonzero(surface.of_cut).astype(np.int32)
                    samples[f"{self._path}/{CUT}.indices"] = Vt.IntArray.FromNumpy(inside)
            self._said = self._skin
        return samples

    def colors(self, samples: Samples, limits: Limits) -> Samples:
        """As in `TetPrims.colors`."""
        stress = samples.get(f"{self._path}.primvars:vonMises")
        if not self._with_colors or stress is None:
            return {}
        indices = Vt.IntArray.FromNumpy(color_index(np.asarray(stress), *limits))
        return {f"{self._path}.primvars:displayColor:indices": indices}


def skin_paths(skins: Sequence[Skin]) -> list[str]:
    """The path of the only skin, or a distinct one for each, after its name."""
    if len(skins) == 1:
        return [SURFACE]
    taken = {TETS, MATERIALS, PHYSICS, OBSTACLES}
    return [free_name(f"{ROOT}/{Tf.MakeValidIdentifier(skin.name)}", taken) for skin in skins]


def declare_triangles(mesh: Any) -> None:
    """Triangles wound counter-clockwise seen from outside, without values."""
    mesh.CreateFaceVertexCountsAttr()
    mesh.CreateFaceVertexIndicesAttr()
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateOrientationAttr(UsdGeom.Tokens.rightHanded)


def declare_cut(mesh: Any, path: str, with_stress: bool) -> None:
    """Declare the faces of cuts as a subset with its own material: redder than tissue, or in the colours of stress."""
    subset = UsdGeom.Subset.Define(mesh.GetPrim().GetStage(), f"{path}/{CUT}")
    subset.CreateElementTypeAttr(UsdGeom.Tokens.face)
    subset.CreateFamilyNameAttr(UsdShade.Tokens.materialBind)
    subset.CreateIndicesAttr()
    UsdGeom.Subset.SetFamilyType(mesh, UsdShade.Tokens.materialBind, UsdGeom.Tokens.nonOverlapping)
    material = drawn_material(mesh.GetPrim().GetStage(), f"{MATERIALS}/{CUT}", None if with_stress else INSIDE)
    UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(material)


def drawn_material(stage: Any, path: str, color: Sequence[float] | None = None) -> Any:
    """A preview material of one colour (sRGB), or of the prim's ``displayColor``."""
    material = UsdShade.Material.Define(stage, path)
    shader = UsdShade.Shader.Define(stage, f"{path}/surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(0.6)
    diffuse = shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f)
    if color is None:
        reader = UsdShade.Shader.Define(stage, f"{path}/color")
        reader.CreateIdAttr("UsdPrimvarReader_float3")
        reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("displayColor")
        diffuse.ConnectToSource(reader.ConnectableAPI(), "result")
    else:
        diffuse.Set(Gf.Vec3f(*srgb_to_linear(color)))
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    return material


def triangle_samples(path: str, triangles: NDArray[np.int32]) -> Samples:
    """Values of the faces of the Mesh prim at this path."""
    return {
        f"{path}.faceVertexCounts": Vt.IntArray(len(triangles), 3),
        f"{path}.faceVertexIndices": Vt.IntArray.FromNumpy(np.ascontiguousarray(triangles).reshape(-1)),
    }


def declare_tet_stress(tets: Any) -> None:
    """Declare the stress of each tetrahedron of a TetMesh."""
    kind = Sdf.ValueTypeNames.FloatArray
    stress = UsdGeom.PrimvarsAPI(tets).CreatePrimvar("vonMises", kind, UsdGeom.Tokens.uniform)
    stress.GetAttr().SetDocumentation("Von Mises stress of each tetrahedron [Pa]")


def declare_moving(body: Any, with_stress: bool, colored: bool = True) -> None:
    """Declare points, extent and, if it has any, colours: of the stress, or else of tissue."""
    body.CreatePointsAttr()
    body.CreateExtentAttr()
    if colored and with_stress:
        color = body.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex)
        color.Set(Vt.Vec3fArray.FromNumpy(srgb_to_linear(stress_colors()).astype(np.float32)))
        color.CreateIndicesAttr()
    elif colored:
        color = body.CreateDisplayColorPrimvar(UsdGeom.Tokens.constant)
        color.Set(Vt.Vec3fArray([Gf.Vec3f(*srgb_to_linear(TISSUE))]))


def floats(values: Any, shape: tuple[int, ...], name: str) -> NDArray[np.float32]:
    """An array as float32 with this shape.

    Raises:
        InputError: Another shape.
    """
    array = np.ascontiguousarray(values.numpy() if hasattr(values, "numpy") else values, dtype=np.float32)
    if array.shape != shape:
        raise InputError(f"{name} has shape {list(array.shape)}; it must be {list(shape)}")
    return array


def extent(points: NDArray[np.float32]) -> Vt.Vec3fArray:
    """Lowest and highest coordinates; those of no points are the origin."""
    if not len(points):
        points = np.zeros((1, 3), np.float32)
    axes = np.ascontiguousarray(points.T)  # NumPy reduces long rows several times as fast as short ones
    return Vt.Vec3fArray.FromNumpy(np.stack([axes.min(axis=1), axes.max(axis=1)]))


# --- tetrahedra, also of meshes that change --------------------------------------------------------------------------

INDICES = f"{TETS}.tetVertexIndices"
FACES = f"{TETS}.surfaceFaceVertexIndices"
REST = f"{TETS}.primvars:rest"
STRESS = f"{TETS}.primvars:vonMises"
UNITS = {"young": " [Pa]", "poisson": "", "density": " [kg/m³]"}


class TetPrims:
    """The TetMesh prim.

    Args:
        present: The body at rest.
        changing: Whether the mesh may change.
    """

    def __init__(self, present: Present, *, changing: bool):
        self._changing = changing
        self._uniform = [name for name in UNITS if np.size(getattr(present.material, name, 0.0)) == 1]
        self._said: Present | None = None
        self.follow(present)

    def follow(self, present: Present) -> None:
        """Draw this mesh from the next frame on."""
        self._present = present

    @property
    def follows(self) -> dict[str, str]:
        """See `PieceStore.declare`."""
        own = ("points", "velocities", *ATTRIBUTES, "primvars:rest", "primvars:vonMises")
        return {f"{TETS}.{name}": INDICES for name in (*own, *(f"primvars:{name}" for name in UNITS))}

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
        declare_moving(tets, statics.stress, colored=False)
        if statics.touched:
            declare_touched(tets)
        if not self._changing:
            for path, value in self._topology().items():
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
        return samples | self._changes() if self._changing else samples

    def colors(self, samples: Samples, limits: Limits) -> Samples:
        """Colours for the stresses of a frame: none, as viewers draw the surfaces."""
        return {}

    def _changes(self) -> Samples:
        """Changed values among those that do not change in every frame."""
        before, self._said, now = self._said, self._present, self._present
        same = before is now or (
            before is not None and np.array_equal(before.tets, now.tets) and np.array_equal(before.points, now.points)
        )
        return {} if same else self._topology()

    def _topology(self) -> Samples:
        present = self._present
        samples: Samples = {
            INDICES: Vt.Vec4iArray.FromNumpy(present.tets),
            FACES: Vt.Vec3iArray.FromNumpy(boundary_faces(present.tets)[0]),
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

    def _declare_primvars(self, primvars: Any, statics: Statics) -> None:
        types, tokens = Sdf.ValueTypeNames, UsdGeom.Tokens
        primvars.CreatePrimvar("rest", types.Point3fArray, tokens.vertex)
        if statics.stress:
            declare_tet_stress(primvars)
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
