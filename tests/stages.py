"""What there is in recorded stages."""

from pathlib import Path

import numpy as np
import trimesh
from pxr import Usd, UsdGeom, UsdValidation

import warp_corot as wc

SURFACE, TETS = "/SoftBody/surface", "/SoftBody/tetrahedra"


def opened(path: Path) -> tuple[Usd.Stage, UsdGeom.TetMesh]:
    stage = Usd.Stage.Open(str(path))
    return stage, UsdGeom.TetMesh.Get(stage, TETS)


def frames(path: Path) -> list[np.ndarray]:
    stage, tets = opened(path)
    codes = range(int(stage.GetStartTimeCode()), int(stage.GetEndTimeCode()) + 1)
    return [np.array(tets.GetPointsAttr().Get(code)) for code in codes]


def still(sim, path, **options) -> Usd.Stage:
    """The stage of one frame of the present state, and one of the next step."""
    wc.record(sim, path, duration=sim.dt, fps=1.0 / sim.dt, **options)
    return Usd.Stage.Open(str(path))


def drawn(stage: Usd.Stage, path: str = SURFACE, frame: float = 0.0) -> trimesh.Trimesh:
    prim = UsdGeom.Mesh.Get(stage, path)
    faces = np.array(prim.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
    return trimesh.Trimesh(np.array(prim.GetPointsAttr().Get(frame), float), faces, process=False)


def prims(stage: Usd.Stage) -> list[str]:
    return [str(prim.GetPath()) for prim in stage.Traverse()][1:]


def faults(path: Path) -> list[str]:
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    found = UsdValidation.ValidationContext(validators).Validate(Usd.Stage.Open(str(path)))
    return [error.GetErrorAsString() for error in found]
