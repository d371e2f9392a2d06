"""The physics of a written body: its materials, gravity, and the schemas of a deformable body."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from pxr import Gf, Sdf, UsdGeom, UsdPhysics, UsdShade, Vt

from .prims import PHYSICS, ROOT, TETS, Present

#: With more distinct materials than this, only primvars describe the elements' materials.
MOST_MATERIALS = 64
#: Attributes of a deformable material, named as in Newton's importer, and their sources here.
_NAMES = {"youngsModulus": "young", "poissonsRatio": "poisson", "density": "density"}


def declare_physics(
    stage: Any, present: Present, *, with_tets: bool, changing: bool, gravity: Sequence[float] | None
) -> None:
    """Declare a body's materials, in SI units.

    Under ``/SoftBody/physics`` there is a `UsdShade.Material` for each material of the elements, with
    ``PhysicsMaterialAPI`` (its density) and ``PhysicsVolumeDeformableMaterialAPI`` (``physics:youngsModulus`` [Pa],
    ``physics:poissonsRatio``), bound for physics to the TetMesh, or to subsets of its tetrahedra if there are several;
    to the body if the TetMesh is not written. The body is a deformable body whose simulation mesh is the
    TetMesh, and whose surface follows. A physics scene has the gravity.

    Args:
        stage: Stage with the body's prims.
        present: The body.
        with_tets: Whether its TetMesh is written.
        changing: Whether the mesh may change, which would invalidate subsets.
        gravity: Acceleration [m/s^2].
    """
    UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
    UsdGeom.Scope.Define(stage, PHYSICS)
    if gravity is not None:
        _declare_scene(stage, gravity)
    body, tets = stage.GetPrimAtPath(ROOT), stage.GetPrimAtPath(TETS)
    if with_tets:
        body.AddAppliedSchema("PhysicsDeformableBodyAPI")
        tets.AddAppliedSchema("PhysicsVolumeDeformableSimAPI")
        UsdPhysics.CollisionAPI.Apply(tets)
    if present.material is None:
        return
    values = [np.ravel(getattr(present.material, name)) for name in _NAMES.values()]
    kinds, of_element = np.unique(np.stack(np.broadcast_arrays(*values)), axis=1, return_inverse=True)
    if kinds.shape[1] > MOST_MATERIALS:
        return
    made = [_material(stage, number, kind) for number, kind in enumerate(kinds.T.tolist(), start=1)]
    bound = tets if with_tets else body
    if len(made) == 1:
        _bind(bound, made[0])
    elif with_tets and not changing:
        for number, material in enumerate(made):
            own = np.flatnonzero(of_element.ravel() == number).astype(np.int32)
            subset = UsdGeom.Subset.Define(stage, f"{TETS}/{material.GetPrim().GetName()}")
            subset.CreateElementTypeAttr(UsdGeom.Tokens.tetrahedron)
            subset.CreateFamilyNameAttr("physics")
            subset.CreateIndicesAttr(Vt.IntArray.FromNumpy(own))
            _bind(subset.GetPrim(), material)


def _declare_scene(stage: Any, gravity: Sequence[float]) -> None:
    scene = UsdPhysics.Scene.Define(stage, f"{PHYSICS}/scene")
    size = float(np.linalg.norm(gravity))
    scene.CreateGravityMagnitudeAttr(size)
    scene.CreateGravityDirectionAttr(Gf.Vec3f(*(g / size for g in gravity)) if size else Gf.Vec3f(0.0, 0.0, 0.0))


def _material(stage: Any, number: int, values: Sequence[float]) -> Any:
    material = UsdShade.Material.Define(stage, f"{PHYSICS}/material{number}")
    prim = material.GetPrim()
    UsdPhysics.MaterialAPI.Apply(prim)
    prim.AddAppliedSchema("PhysicsVolumeDeformableMaterialAPI")
    for (name, _), value in zip(_NAMES.items(), values, strict=True):
        prim.CreateAttribute(f"physics:{name}", Sdf.ValueTypeNames.Float, custom=False).Set(value)
    return material


def _bind(prim: Any, material: Any) -> None:
    UsdShade.MaterialBindingAPI.Apply(prim).Bind(material, materialPurpose="physics")
