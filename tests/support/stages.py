"""The content of recorded stages."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from pxr import Usd, UsdGeom, UsdValidation

import warp_corot as wc
from warp_corot.mesh.topology import signed_volumes

SURFACE, TETS = "/SoftBody/surface", "/SoftBody/tetrahedra"


def opened(path: Path) -> tuple[Usd.Stage, UsdGeom.TetMesh]:
    stage = Usd.Stage.Open(str(path))
    return stage, UsdGeom.TetMesh.Get(stage, TETS)


def frames(path: Path) -> list[np.ndarray]:
    stage, tets = opened(path)
    codes = range(int(stage.GetStartTimeCode()), int(stage.GetEndTimeCode()) + 1)
    return [np.array(tets.GetPointsAttr().Get(code)) for code in codes]


def still(sim, path, **options) -> Usd.Stage:
    """The stage of one frame of the current state, and one of the next step."""
    wc.record(sim, path, duration=sim.dt, fps=1.0 / sim.dt, **options)
    return Usd.Stage.Open(str(path))


def drawn(stage: Usd.Stage, path: str = SURFACE, frame: float = 0.0) -> trimesh.Trimesh:
    prim = UsdGeom.Mesh.Get(stage, path)
    faces = np.array(prim.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
    return trimesh.Trimesh(np.array(prim.GetPointsAttr().Get(frame), float), faces, process=False)


def prims(stage: Usd.Stage) -> list[str]:
    """Paths of visible and guide prims."""
    return [str(prim.GetPath()) for prim in stage.Traverse() if prim.IsA(UsdGeom.PointBased)]


def faults(path: Path) -> list[str]:
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    found = UsdValidation.ValidationContext(validators).Validate(Usd.Stage.Open(str(path)))
    return [error.GetErrorAsString() for error in found]


def edges_meet_in_pairs(triangles: np.ndarray) -> bool:
    """Whether a surface is closed, with each edge once in each direction."""
    edges = np.concatenate([triangles[:, [i, j]] for i, j in ((0, 1), (1, 2), (2, 0))])
    ahead, back = {tuple(edge) for edge in edges}, {tuple(edge[::-1]) for edge in edges}
    return len(ahead) == len(edges) and ahead == back


def assert_whole(stage, time, volume):
    """All lengths fit, all indices name points, and the tetrahedra and the boundary fill the region without a crack."""
    tets = UsdGeom.TetMesh.Get(stage, TETS)
    points = np.array(tets.GetPointsAttr().Get(time))
    indices = np.array(tets.GetTetVertexIndicesAttr().Get(time))
    primvars = UsdGeom.PrimvarsAPI(tets)
    rest = np.array(primvars.GetPrimvar("rest").Get(time), float)
    assert len(points) == len(rest) == len(primvars.GetPrimvar("fixed").Get(time))
    assert len(points) == len(tets.GetVelocitiesAttr().Get(time))
    assert len(indices) == len(primvars.GetPrimvar("vonMises").Get(time))
    for name in ("young", "poisson", "density"):
        primvar = primvars.GetPrimvar(name)
        assert np.size(primvar.Get(time)) == (1 if primvar.GetInterpolation() == "constant" else len(indices))
    assert indices.min() == 0
    assert indices.max() == len(points) - 1
    # Conforming: no overlap, no gap, and faces that meet do so wholly.
    volumes = signed_volumes(rest, indices)
    assert volumes.min() > 0.0
    assert volumes.sum() == pytest.approx(volume, rel=1e-5)
    faces = np.array(tets.GetSurfaceFaceVertexIndicesAttr().Get(time))
    assert edges_meet_in_pairs(faces)
    assert np.linalg.det(rest[faces]).sum() / 6.0 == pytest.approx(volume, rel=1e-5)
    surface = UsdGeom.Mesh.Get(stage, SURFACE)
    drawn = np.array(surface.GetPointsAttr().Get(time))
    triangles = np.array(surface.GetFaceVertexIndicesAttr().Get(time)).reshape(-1, 3)
    assert surface.ValidateTopology(
        surface.GetFaceVertexIndicesAttr().Get(time), surface.GetFaceVertexCountsAttr().Get(time), len(drawn)
    )[0]
    assert len(drawn) == len(surface.GetVelocitiesAttr().Get(time))
    np.testing.assert_array_equal(drawn[triangles], points[faces])
    return points, rest, indices
