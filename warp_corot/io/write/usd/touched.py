"""Contact on a body as primvars: the force on each node, and the pressure."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pxr import Sdf, UsdGeom, Vt

from .pieces import Samples

FORCE, PRESSURE = "contactForce", "contactPressure"
#: The attributes of a prim that change with its mesh.
ATTRIBUTES = (f"primvars:{FORCE}", f"primvars:{PRESSURE}")


class Touched(NamedTuple):
    """Contact in a frame: forces on nodes [N], float32 [N, 3], and pressure averaged at nodes [Pa], float32 [N]."""

    forces: NDArray[np.float32]
    pressure: NDArray[np.float32]

    def samples(self, path: str, nodes: NDArray[np.int32] | slice = slice(None)) -> Samples:
        """The primvars of a prim with some of the nodes."""
        return {
            f"{path}.primvars:{FORCE}": Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(self.forces[nodes])),
            f"{path}.primvars:{PRESSURE}": Vt.FloatArray.FromNumpy(np.ascontiguousarray(self.pressure[nodes])),
        }


def declare_touched(prim: Any, *, forces: bool = True) -> None:
    """Declare the primvars, without values."""
    primvars, types, vertex = UsdGeom.PrimvarsAPI(prim), Sdf.ValueTypeNames, UsdGeom.Tokens.vertex
    if forces:
        force = primvars.CreatePrimvar(FORCE, types.Vector3fArray, vertex)
        force.GetAttr().SetDocumentation("Contact force on each node in the last step [N]")
    pressure = primvars.CreatePrimvar(PRESSURE, types.FloatArray, vertex)
    pressure.GetAttr().SetDocumentation("Contact pressure in the last step, averaged over the triangles around [Pa]")
