"""A corotational solver for scenes of the Newton physics engine, https://github.com/newton-physics/newton.

``SolverCorotated`` steps the tetrahedra of any ``newton.Model``; ``add_forest`` and ``add_mesh`` put this package's
meshes into a ``newton.ModelBuilder``; ``StageSimulation`` steps the scene of a USD stage. Only Newton's public
interface is used. It is imported when one of these names is first used, and installed by
``pip install "warp-corot[newton]"``.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from warp_corot.inputs.arguments import explained

if TYPE_CHECKING:
    from warp_corot.newton.stages.stage import StageOptions
    from warp_corot.newton.stages.steps import StageSimulation

    from .scene import Added, add_forest, add_mesh, register_custom_attributes
    from .solver import SolverCorotated

__all__ = [
    "Added",
    "SolverCorotated",
    "StageOptions",
    "StageSimulation",
    "add_forest",
    "add_mesh",
    "register_custom_attributes",
]

_MODULES = {
    "Added": ".scene",
    "SolverCorotated": ".solver",
    "StageOptions": ".stages.stage",
    "StageSimulation": ".stages.steps",
    "add_forest": ".scene",
    "add_mesh": ".scene",
    "register_custom_attributes": ".scene",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = explained(getattr(import_module(_MODULES[name], __name__), name))
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted(__all__)
