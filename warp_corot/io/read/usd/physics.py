"""What a stage says of physics that Newton's importer leaves open: which values it gives, and what gravity means."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from pxr import Usd, UsdGeom, UsdPhysics, UsdShade

from warp_corot.errors import InputError
from warp_corot.io.files.quiet import quietly

EARTH = 9.81
#: What Newton takes for a Poisson's ratio of a half.
NEARLY_INCOMPRESSIBLE = 0.499
#: Namespaces of the values of deformable bodies, as Newton's importer takes them.
_NAMESPACES = ("physics", "omniphysics", "physxDeformableBody")
_BODY = "PhysicsDeformableBodyAPI"


def material_said(prim: Any) -> dict[str, float]:
    """What a stage gives of "young", "poisson", "density" and "friction" for a TetMesh prim, in its units.

    It is what Newton takes, but for the dynamic friction, which it passes over. It is of the physics material that is
    bound to the prim; density also by a mass or a density of the deformable body, or by the masses of points or
    elements: then it is there, but infinite. Zero density, by UsdPhysics, is none.
    """
    found: dict[str, float] = {}
    with quietly():  # of bindings without their schema, which count all the same
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
    """Have physics scenes whose gravity is negative, which by UsdPhysics is the Earth's, say so in numbers.

    Newton takes infinite ones so and others as they are. It changes the layer that is edited.

    Returns:
        Paths of the physics scenes, the first of which counts.

    Raises:
        InputError: Gravity is not a number, or has a direction that is none.
    """
    scenes = [prim for prim in stage.Traverse() if prim.IsA(UsdPhysics.Scene)]
    for prim in scenes:
        scene = UsdPhysics.Scene(prim)
        magnitude, direction = scene.GetGravityMagnitudeAttr().Get(), scene.GetGravityDirectionAttr().Get()
        if magnitude is not None and (math.isnan(magnitude) or magnitude == math.inf):
            raise InputError(f"{source}: {prim.GetPath()}: physics:gravityMagnitude is {magnitude:g}, should be finite")
        if direction is not None and not all(map(math.isfinite, direction)):
            raise InputError(f"{source}: {prim.GetPath()}: physics:gravityDirection is {direction}, should be finite")
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
        listed = prim.GetMetadata("apiSchemas")  # has schemas, too, that OpenUSD does not know
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
