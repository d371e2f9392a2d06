"""Soft bodies for users: a mesh, a material, and the state of its nodes on a device."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .soft_body import SoftBody

__all__ = ["SoftBody"]


def __getattr__(name: str) -> Any:
    """Import the class on first use, because its parts are in this folder, too."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(".soft_body", __name__), name)
