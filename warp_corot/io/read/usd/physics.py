"""Physics data of a stage that Newton's importer does not report: which values the file gives, and the meaning of
gravity.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from pxr import Usd, UsdGeom, UsdPhysics, UsdShade

from warp_corot.errors import InputError
from warp_corot.io.files.quiet import quietly

EARTH = 9.81
#: Newton's substitute for a Poisson's ratio of one half.
NEARLY_INCOMPRESSIBLE = 0.499
#: Namespaces of the attributes of deformable bodies that Newton's importer reads.
_NAMESPACES = ("physics", "omniphysics", "physxDeformableBody")
_BODY = "PhysicsDeformableBodyAPI"


def material_said(prim: Any) -> dict[str, float]:
    """The values of "young", "poisson", "density" and "friction" that a stage gives for a TetMesh prim, in its units.

    They are the values that Newton uses, except the dynamic friction, which it ignores. They come from the physics
    material bound to the prim. A density may also come from a mass or a density of the deformable body, or from masses
    of points or elements; it is then reported as infinite. In UsdPhysics, a zero density means none.
    """
    found: dict[str, float] = {}
    with quietly():  # about bindings without their schema, which are valid all the same
        material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")[0].GetPrim()
    if material:
        young, poisson = _number(material, "youngsModulus"), _number(material, "poissonsRatio")
        if young is not None and young >= 0.0:
            found["young"] = young
        if poisson is not None and -1.0 < poisson < 1.0:
            found["poisson"] = poisson if poisson < 0.5 else NEARLY_INCOMPRESSIBLE
        density, friction = _number(material, "density"), _number(material, "dynamicFriction")
        if friction is not None and friction >= 0.0:
            found["friction"] = friction
        if density is not None and density > 0.0:
            found["density"] = density
    body = _deformable_body(prim)
    weights = [_number(body, name) for name in ("density", "mass")] if body else []
    if any(value is not None and value > 0.0 for value in weights) or _value(prim, "masses") is not None:
        found["density"] = math.inf
    return found


def settle_gravity(stage: Any, source: Path) -> list[str]:
    """Replace negative gravity in physics scenes, which in UsdPhysics means the Earth's, by its value.

    Newton does so for infinite values only. This changes the edited layer.

    Returns:
        Paths of the physics scenes; the first one is used.

    Raises:
        InputError: Gravity is not a number, or its direction is invalid.
    """
    scenes = [prim for prim in stage.Traverse() if prim.IsA(UsdPhysics.Scene)]
    for prim in scenes:
        scene = UsdPhysics.Scene(prim)
        magnitude, direction = scene.GetGravityMagnitudeAttr().Get(), scene.GetGravityDirectionAttr().Get()
        if magnitude is not None and (math.isnan(magnitude) or magnitude == math.inf):
            raise InputError(f"{source}: {prim.GetPath()}: gravityMagnitude is {magnitude:g}; it must be finite")
        if direction is not None and not all(map(math.isfinite, direction)):
            raise InputError(f"{source}: {prim.GetPath()}: gravityDirection is {direction}; it must be finite")
        if magnitude is not None and magnitude < 0.0:
            scene.GetGravityMagnitudeAttr().Set(EARTH / UsdGeom.GetStageMetersPerUnit(stage))
    return [str(prim.GetPath()) for prim in scenes]


def is_physical(prim: Any) -> bool:
    """Whether a prim, or something under it, is simulated or collides."""
    return any(
        one.IsA(UsdGeom.TetMesh) or one.HasAPI(UsdPhysics.RigidBodyAPI) or one.HasAPI(UsdPhysics.CollisionAPI)
        for one in Usd.PrimRange(prim, Usd.TraverseInstanceProxies())
    )


def _deformable_body(prim: Any) -> Any:
    while prim and not prim.IsPseudoRoot():
        listed = prim.GetMetadata("apiSchemas")  # includes schemas that OpenUSD does not know
        if _BODY in prim.GetAppliedSchemas() or (listed and _BODY in listed.GetAddedOrExplicitItems()):
            return prim
        prim = prim.GetParent()
    return None


def _value(prim: Any, name: str) -> Any:
    for namespace in _NAMESPACES:
        attribute = prim.GetAttribute(f"{namespace}:{name}")
        if attribute and attribute.HasAuthoredValue():
            return attribute.Get()
    return None


def _number(prim: Any, name: str) -> float | None:
    value = _value(prim, name)
    return float(value) if isinstance(value, int | float) and math.isfinite(value) else None
