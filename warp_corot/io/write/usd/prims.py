"""The prims of an animated body: its tetrahedra, their boundary, surfaces that are bound to it, and contact."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pxr import Gf, Sdf, Tf, UsdGeom, UsdShade, Vt

from warp_corot.errors import InputError
from warp_corot.io.files.usd import free_name, preview_material
from warp_corot.io.pictures.colors import TISSUE, VertexAverage, color_index, srgb_to_linear, stress_colors
from warp_corot.io.write.skins import Skin
from warp_corot.mesh.surfaces.bound import vertex_normals
from warp_corot.mesh.topology import boundary_faces

from .pieces import Samples, declare

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


def declare_primvar(prim: Any, name: str, kind: Any, interpolation: str, said: str = "") -> Any:
    """Declare a primvar without values; ``said`` is its documentation."""
    primvar = UsdGeom.PrimvarsAPI(prim).CreatePrimvar(name, kind, interpolation)
    if said:
        primvar.GetAttr().SetDocumentation(said)
    return primvar


def declare_pressure(prim: Any) -> None:
    """Declare the pressure of contact at the nodes of a prim."""
    said = "Contact pressure in the last step, averaged over the triangles around [Pa]"
    declare_primvar(prim, PRESSURE, Sdf.ValueTypeNames.FloatArray, UsdGeom.Tokens.vertex, said)


# --- what all prims share, and surfaces ------------------------------------------------------------------------------

ROOT, TETS, SURFACE = "/SoftBody", "/SoftBody/tetrahedra", "/SoftBody/surface"
MATERIALS = "/SoftBody/materials"
#: The subset of a surface with the faces of cuts, its material, and the colour inside tissue (sRGB).
CUT = "cut"
INSIDE = (0.55, 0.12, 0.12)
#: Of what shows the stress, or has been cut.
ROUGHNESS = 0.6
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


class DrawnPrim:
    """A prim that frames move."""

    @property
    def follows(self) -> dict[str, str]:
        """See `PieceStore.declare`."""
        return {}

    def define(self, stage: Any, frame: Frame) -> None:
        """Define the prim with everything that does not change, and the attributes that its schema does not have."""
        raise NotImplementedError

    def samples(self, frame: Frame) -> Samples:
        """Values of a frame without colours."""
        raise NotImplementedError

    def colors(self, samples: Samples, limits: Limits) -> Samples:
        """Colours for the stresses of a frame."""
        return {}


class SkinPrim(DrawnPrim):
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
        own = ("points", "normals", "velocities", "primvars:vonMises", *ATTRIBUTES)
        return {f"{self._path}.{name}": f"{self._path}.faceVertexIndices" for name in own}

    def define(self, stage: Any, frame: Frame) -> None:
        look, surface = self._skin.look, self._skin.surface
        if look is not None:
            look.copy_to(stage.GetRootLayer(), self._path, MATERIALS)
            mesh = UsdGeom.Mesh.Get(stage, self._path)
        else:
            mesh = UsdGeom.Mesh.Define(stage, self._path)
            declare_triangles(mesh)
            if not self._changing:
                set_values(stage, triangle_samples(self._path, surface.triangles))
        if self._changing and self._skin.is_cut:
            declare_cut(mesh, self._path, frame.stress is not None)
        mesh.GetPrim().SetDisplayName(self._skin.name)
        if self._with_normals:
            mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
        if frame.stress is not None:
            said = "Von Mises stress, averaged over the tetrahedra around [Pa]"
            declare_primvar(mesh, "vonMises", Sdf.ValueTypeNames.FloatArray, UsdGeom.Tokens.vertex, said)
        if frame.touched is not None:
            declare_pressure(mesh)
        if self._with_colors:
            declare_colors(mesh, frame.stress is not None)

    def samples(self, frame: Frame) -> Samples:
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
    """Triangles wound counter-clockwise seen from outside."""
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateOrientationAttr(UsdGeom.Tokens.rightHanded)


def declare_cut(mesh: Any, path: str, with_stress: bool) -> None:
    """Declare the faces of cuts as a subset with its own material: redder than tissue, or in the colours of stress."""
    subset = UsdGeom.Subset.Define(mesh.GetPrim().GetStage(), f"{path}/{CUT}")
    subset.CreateElementTypeAttr(UsdGeom.Tokens.face)
    subset.CreateFamilyNameAttr(UsdShade.Tokens.materialBind)
    UsdGeom.Subset.SetFamilyType(mesh, UsdShade.Tokens.materialBind, UsdGeom.Tokens.nonOverlapping)
    color = None if with_stress else srgb_to_linear(INSIDE)
    material = preview_material(mesh.GetPrim().GetStage(), f"{MATERIALS}/{CUT}", color, roughness=ROUGHNESS)
    UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(material)


def set_values(stage: Any, values: Samples) -> None:
    """Set default values of attributes, which are declared if their schema has them."""
    declare(stage, values)
    for path, value in values.items():
        stage.GetAttributeAtPath(path).Set(value)


def triangle_samples(path: str, triangles: NDArray[np.int32]) -> Samples:
    """Values of the faces of the Mesh prim at this path."""
    return {
        f"{path}.faceVertexCounts": Vt.IntArray(len(triangles), 3),
        f"{path}.faceVertexIndices": Vt.IntArray.FromNumpy(np.ascontiguousarray(triangles).reshape(-1)),
    }


def declare_tet_stress(tets: Any) -> None:
    """Declare the stress of each tetrahedron of a TetMesh."""
    said = "Von Mises stress of each tetrahedron [Pa]"
    declare_primvar(tets, "vonMises", Sdf.ValueTypeNames.FloatArray, UsdGeom.Tokens.uniform, said)


def declare_colors(body: Any, with_stress: bool) -> None:
    """Declare colours: of the stress, or else of tissue."""
    if with_stress:
        color = body.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex)
        color.Set(Vt.Vec3fArray.FromNumpy(srgb_to_linear(stress_colors()).astype(np.float32)))
        color.CreateIndicesAttr()
    else:
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


class TetPrims(DrawnPrim):
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
        own = ("points", "velocities", *ATTRIBUTES, "primvars:rest", "primvars:vonMises")
        return {f"{TETS}.{name}": INDICES for name in (*own, *(f"primvars:{name}" for name in UNITS))}

    def define(self, stage: Any, frame: Frame) -> None:
        tets = UsdGeom.TetMesh.Define(stage, TETS)
        tets.CreateOrientationAttr(UsdGeom.Tokens.rightHanded)
        # Beside its surface it would be drawn twice, and Hydra takes its uniform primvars for values per face.
        tets.CreatePurposeAttr(UsdGeom.Tokens.guide)
        types, tokens = Sdf.ValueTypeNames, UsdGeom.Tokens
        declare_primvar(tets, "rest", types.Point3fArray, tokens.vertex)
        if frame.stress is not None:
            declare_tet_stress(tets)
        if self._present.fixed is not None:
            declare_primvar(tets, "fixed", types.IntArray, tokens.vertex, "1 where the node is held")
        for name, unit in UNITS.items():
            value, said = getattr(self._present.material, name, None), f"Material: {name}{unit}"
            if value is not None and name in self._uniform:
                primvar = declare_primvar(tets, name, types.Float, tokens.constant, said)
                primvar.Set(float(np.asarray(value).reshape(())))
            elif value is not None:
                declare_primvar(tets, name, types.FloatArray, tokens.uniform, said)
        if frame.touched is not None:
            said = "Contact force on each node in the last step [N]"
            declare_primvar(tets, FORCE, types.Vector3fArray, tokens.vertex, said)
            declare_pressure(tets)
        if not self._changing:
            set_values(stage, self._topology())

    def samples(self, frame: Frame) -> Samples:
        x, v = frame.positions, frame.velocities
        samples: Samples = {f"{TETS}.points": Vt.Vec3fArray.FromNumpy(x), f"{TETS}.extent": extent(x)}
        if v is not None:
            samples[f"{TETS}.velocities"] = Vt.Vec3fArray.FromNumpy(v)
        if frame.stress is not None:
            samples[STRESS] = Vt.FloatArray.FromNumpy(frame.stress)
        if frame.touched is not None:
            samples |= frame.touched.samples(TETS)
        if not self._changing:
            return samples
        before, self._said, now = self._said, self._present, self._present
        names = ("tets", "points")
        same = before is not None and all(np.array_equal(getattr(before, name), getattr(now, name)) for name in names)
        return samples if same else samples | self._topology()

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
