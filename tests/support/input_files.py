"""Meshes, surfaces and scans in files, as users have them."""

from pathlib import Path

import numpy as np
import trimesh
from pxr import Usd, UsdGeom


def write_vtk(path: Path, points, tets) -> Path:
    import meshio

    meshio.write(path, meshio.Mesh(np.asarray(points, float), [("tetra", np.asarray(tets))]))
    return path


def write_surface(path: Path, mm: bool) -> Path:
    """An ellipsoid of half axes 3, 4 and 5 cm."""
    shape = trimesh.creation.icosphere(3, 1.0)
    shape.vertices *= np.array([0.03, 0.04, 0.05]) * (1000.0 if mm else 1.0)
    if path.suffix != ".usda":
        shape.export(path)
        return path
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, 0.001 if mm else 1.0)
    UsdGeom.SetStageUpAxis(stage, "Z")
    mesh = UsdGeom.Mesh.Define(stage, "/Mesh")
    mesh.CreatePointsAttr([tuple(p) for p in shape.vertices.tolist()])
    mesh.CreateFaceVertexCountsAttr([3] * len(shape.faces))
    mesh.CreateFaceVertexIndicesAttr(shape.faces.ravel().tolist())
    stage.Save()
    return path


def write_scan(path: Path, unit: str = "mm") -> Path:
    """A ball of 4 cm of the number 2 around one of 2 cm of the number 7, in voxels of 4 mm."""
    import nibabel

    axis = (np.arange(24) - 11.5) * 4.0
    away = np.linalg.norm(np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1), axis=-1)
    volume = np.where(away < 20.0, 7, np.where(away < 40.0, 2, 0)).astype(np.uint8)
    affine = np.diag([4.0, 4.0, 4.0, 1.0])
    affine[:3, 3] = axis[0]
    image = nibabel.Nifti1Image(volume, affine)
    image.header.set_xyzt_units(unit)
    nibabel.save(image, path)
    return path
