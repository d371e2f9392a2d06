"""Simulations: bodies in motion."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .simulation import Simulation

__all__ = ["Simulation"]


def __getattr__(name: str) -> Any:
    """Import the class on first use, because its parts are in this folder, too."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(".simulation", __name__), name)
