"""Surface files read by trimesh as USD stages in memory: a Mesh prim for each part, with its look."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdShade, Vt

from warp_corot.io.files.usd import free_name
from warp_corot.io.read.surfaces import placed_meshes

#: Path of the prims.
ROOT = "/scene"


def stage_of_file(path: Path) -> Any:
    """A stage, in metres, of the file's parts, placed by its scene, in the file's coordinates.

    Parts keep their names, texture coordinates (``st``) and colours; a part with a colour or with a texture in a
    separate file is bound to a `UsdPreviewSurface`.

    Raises:
        InputError: trimesh cannot read it.
    """
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.Scope.Define(stage, ROOT)
    taken: set[str] = set()
    for geometry, matrix, _, name in placed_meshes(path, maintain_order=True):
        if len(geometry.faces):
            _define(stage, _free_name(name or path.stem, taken), geometry, matrix, path)
    return stage


def stage_of_triangles(name: str, points: np.ndarray, triangles: np.ndarray) -> Any:
    """A stage in metres with one Mesh prim."""
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    mesh = UsdGeom.Mesh.Define(stage, f"{ROOT}/{Tf.MakeValidIdentifier(name)}")
    _set_triangles(mesh, np.asarray(points), np.asarray(triangles))
    mesh.CreateNormalsAttr(Vt.Vec3fArray(len(points)))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    return stage


def _set_triangles(mesh: Any, points: np.ndarray, triangles: np.ndarray) -> None:
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(points, np.float32)))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray(len(triangles), 3))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(triangles, np.int32).ravel()))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)


def _free_name(name: str, taken: set[str]) -> str:
    stem = Path(name).stem if Path(name).suffix.lower() in (".obj", ".stl", ".ply", ".off") else name
    return free_name(Tf.MakeValidIdentifier(stem), taken)


def _define(stage: Any, name: str, geometry: Any, matrix: np.ndarray, source: Path) -> None:
    mesh = UsdGeom.Mesh.Define(stage, f"{ROOT}/{name}")
    points = np.asarray(geometry.vertices, np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    faces = np.asarray(geometry.faces, np.int32)
    if np.linalg.det(matrix[:3, :3]) < 0:
        faces = faces[:, ::-1]
    _set_triangles(mesh, points, faces)
    normals = np.asarray(geometry.vertex_normals, np.float32) @ np.linalg.inv(matrix[:3, :3]).astype(np.float32)
    mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(normals, np.float32)))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    visual, primvars = geometry.visual, UsdGeom.PrimvarsAPI(mesh)
    uv = getattr(visual, "uv", None)
    if uv is not None and len(uv) == len(points):
        kind = Sdf.ValueTypeNames.TexCoord2fArray
        st = primvars.CreatePrimvar("st", kind, UsdGeom.Tokens.vertex)
        st.Set(Vt.Vec2fArray.FromNumpy(np.asarray(uv, np.float32)))
    if visual.kind == "vertex":
        colors = np.asarray(visual.vertex_colors[:, :3], np.float32) / 255.0
        primvar = mesh.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex)
        primvar.Set(Vt.Vec3fArray.FromNumpy(_linear(colors)))
    elif visual.kind == "face":
        colors = np.asarray(visual.face_colors[:, :3], np.float32) / 255.0
        mesh.CreateDisplayColorPrimvar(UsdGeom.Tokens.uniform).Set(Vt.Vec3fArray.FromNumpy(_linear(colors)))
    elif visual.kind == "texture" and visual.defined and visual.material is not None:
        _bind_material(stage, mesh, visual.material, source)


def _bind_material(stage: Any, mesh: Any, material: Any, source: Path) -> None:
    name = Tf.MakeValidIdentifier(getattr(material, "name", None) or f"{mesh.GetPrim().GetName()}_material")
    path = f"{ROOT}/materials/{name}"
    if not stage.GetPrimAtPath(path):
        bound = UsdShade.Material.Define(stage, path)
        shader = UsdShade.Shader.Define(stage, f"{path}/surface")
        shader.CreateIdAttr("UsdPreviewSurface")
        color = np.asarray(material.main_color, np.float32)[:3] / 255.0
        diffuse = shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f)
        diffuse.Set(Gf.Vec3f(*map(float, _linear(color))))
        texture = _texture_file(material, source)
        if texture is not None:
            reader = UsdShade.Shader.Define(stage, f"{path}/st")
            reader.CreateIdAttr("UsdPrimvarReader_float2")
            reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
            image = UsdShade.Shader.Define(stage, f"{path}/texture")
            image.CreateIdAttr("UsdUVTexture")
            image.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(Sdf.AssetPath(str(texture)))
            image.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(
                reader.CreateOutput("result", Sdf.ValueTypeNames.Float2)
            )
            diffuse.ConnectToSource(image.CreateOutput("rgb", Sdf.ValueTypeNames.Float3))
        bound.CreateSurfaceOutput().ConnectToSource(shader.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(UsdShade.Material.Get(stage, path))


def _texture_file(material: Any, source: Path) -> Path | None:
    """The picture of a material, if it is a file beside the surface's."""
    named = (getattr(material, "kwargs", None) or {}).get("map_kd")
    image = getattr(material, "image", None)
    for name in (named, getattr(image, "filename", None)):
        if isinstance(name, list):
            name = " ".join(name)
        if name and (source.parent / str(name)).is_file():
            return (source.parent / str(name)).resolve()
    return None


def _linear(srgb: np.ndarray) -> np.ndarray:
    from warp_corot.io.pictures.colors import srgb_to_linear

    return np.asarray(srgb_to_linear(srgb), np.float32)
