"""The bodies of ``bodies.py``: files from packages, and difficult shapes, each as input of the command
line."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

#: Folders of packages with bodies, and patterns of their meshes and scans. The wheel of trimesh has none.
PACKAGES = ("warp", "pyvista", "trimesh", "nilearn", "newton", "mujoco")
SUFFIXES = (".stl", ".obj", ".ply", ".off", ".glb", ".gltf", ".usd", ".usda", ".usdc", ".msh", ".gii.gz")
SUFFIXES += (".vtk", ".vtp", ".vtu", ".vti", ".nii.gz", ".nii", ".nrrd", ".mha")
#: Files to leave out: values at vertices, pictures of functions, surfaces without an inside.
NO_BODIES = ("area_", "curv_", "sulc", "thick_", "flat_", "_t1_", "image_10426", "spm_dmtx")


@dataclass(frozen=True)
class Body:
    """A body to mesh.

    Attributes:
        name: Name in the table.
        path: The file; None for a shape, which is written to a file first.
    """

    name: str
    path: Path | None = None


def all_bodies() -> list[Body]:
    """Bodies from packages, then shapes."""
    from body_shapes import SHAPES

    return [*packaged(), *(Body(name) for name in SHAPES)]


def packaged() -> list[Body]:
    """The files with triangles or voxels in packages, each once."""
    found, seen = [], set()
    for package in PACKAGES:
        spec = find_spec(package)
        for folder in (spec.submodule_search_locations or []) if spec else []:
            for path in sorted(Path(folder).rglob("*")):
                if not path.name.lower().endswith(SUFFIXES) or any(word in path.name for word in NO_BODIES):
                    continue
                digest = hashlib.sha256(path.read_bytes()).digest()
                if digest in seen or (".usd" in path.suffix and not has_faces(path)):
                    continue
                seen.add(digest)
                found.append(Body(f"{package}/{path.name}", path))
    return found


def has_faces(path: Path) -> bool:
    """Whether a stage has a Mesh prim of its own, so that it holds a shape and not only joints."""
    from pxr import Usd, UsdGeom

    try:
        stage = Usd.Stage.Open(str(path))
    except Exception:
        return False
    meshes = [UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]
    return any(len(mesh.GetFaceVertexCountsAttr().Get() or []) >= 4 for mesh in meshes)


def as_input(body: Body, folder: Path) -> tuple[Path, list[str]]:
    """The input file for the command line, and the options that a person would give with it."""
    name, path = body.name, body.path
    if path is None:
        from body_shapes import SHAPES

        return _written(folder / f"{name}.ply", *SHAPES[name]()), ["--unit", "m"]
    if path.name.endswith(".gii.gz"):
        import nibabel

        surface = nibabel.load(path).agg_data(("pointset", "triangle"))
        return _written(folder / path.name.replace(".gii.gz", ".ply"), *surface), ["--unit", "mm"]
    if path.suffix == ".msh" and name.startswith("mujoco/"):  # MuJoCo's own format
        import mujoco

        spec = mujoco.MjSpec()
        spec.add_mesh(name="body", file=str(path))
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="body")
        model = spec.compile()
        return _written(folder / f"{path.stem}.ply", model.mesh_vert, model.mesh_face), ["--unit", "m"]
    if path.name.endswith("_converted.nii.gz"):  # probabilities from 0 to 255
        import nibabel
        import numpy as np

        image = nibabel.load(path)
        inside = (np.asarray(image.dataobj) > 127).astype(np.uint8)
        nibabel.save(nibabel.Nifti1Image(inside, image.affine), folder / path.name)
        return folder / path.name, ["--unit", "mm"]
    scan = path.name.endswith((".nii.gz", ".nii", ".nrrd", ".mha"))
    return path, [] if scan or ".usd" in path.suffix else ["--unit", "mm"]


def _written(path: Path, points, triangles) -> Path:
    from trimesh import Trimesh

    Trimesh(points, triangles, process=False).export(path)
    return path
